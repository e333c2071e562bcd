"""Left and right in a result, checked without a truth: people seldom walk backwards."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from hiros_mcap.body.forward_cues import CUES, FacingMarkers
from hiros_mcap.frames import Block, join
from hiros_mcap.skeletons import UNTRACKED, Floats, Frame, People, SkeletonModel, Stamps
from hiros_mcap.stages.bank import Bank
from hiros_mcap.stages.detections.facing_evidence import (
    FacingPast,
    FacingTables,
    MeasuredViews,
    measure,
)

WALKING = 0.5
"""m/s: somebody who is faster walks."""
ALONG = 0.5
"""Cosine: a facing within 60 degrees of a direction lies along it."""
UPRIGHT = 0.72  # cosine of a tilt of 44 degrees
_SPAN = 250_000_000  # ns before and after an instant in which the velocity is measured
_GAP = 100_000_000  # ns: a longer step interrupts a track
_FEWEST = 5  # frames that show a velocity
_CLEAR = np.array([0.01, 0.04, 0.04, 0.01])
"""m, in the order of body.forward_cues.CUES: a shorter cue says nothing. An elbow or a knee is this
far from its line when it is bent by about 15 degrees; a straight one points anywhere."""


@dataclass(frozen=True, slots=True, eq=False)
class FacingTrack:
    """Where one person was and faced at T instants."""

    stamps: Stamps  # (T,) ns, increasing
    facing: Floats  # (T, 3) unit vectors at a right angle to the trunk; NaN = not known
    velocity: Floats
    """(T, 3) at a right angle to the trunk, m/s; NaN = not known, or the trunk is not upright."""
    cues: Floats  # (T, CUES, 3) m, in the order of body.forward_cues.CUES; 0 or NaN = not known

    def along(self) -> tuple[Floats, Floats]:
        """(T,) Speed, m/s, and cosine between facing and walking direction."""
        speed = np.linalg.norm(self.velocity, axis=1)
        dots = (self.facing * self.velocity).sum(axis=1)
        return speed, dots / np.where(speed > 0, speed, np.nan)


@dataclass(frozen=True, slots=True)
class SideScores:
    """Signs that left and right of a result are wrong."""

    walking: int  # frames, summed over people, in which somebody is faster than WALKING
    backwards: int  # those of them in which he faces away from where he goes
    jumps: int  # how often the facing turns by more than 100 degrees from one frame to the next
    contradicting: Mapping[str, float]
    """Cue -> share of the frames that show it in which it points backwards."""
    mirrored: Mapping[str, int]
    """Camera -> detections that fit the result better with left and right exchanged."""


def facing_tracks(frames: Iterable[Frame], model: SkeletonModel) -> list[FacingTrack]:
    """Measure where everybody with an id goes and faces."""
    blocks = [Block.of(frame) for frame in frames]
    if not blocks:
        return []
    block = join(blocks)
    stamps = np.repeat(block.stamps, np.diff(block.rows, axis=1)[:, 0])
    bodies = _measured(block.people, stamps, model)
    across = bodies.axes[:, :2]
    facing = np.einsum("nk,nkc->nc", bodies.facing, across)
    cues = np.einsum("nqk,nkc->nqc", bodies.cues.reshape(-1, len(CUES), 2), across)
    centres = np.nanmean(block.people.markers[..., :3], axis=1)
    ids, velocity, rows = block.people.ids, np.full((len(stamps), 3), np.nan), []
    for person in np.unique(ids[ids != UNTRACKED]).tolist():
        places = np.flatnonzero(ids == person)
        places = places[np.argsort(stamps[places], kind="stable")]
        places = places[np.diff(stamps[places], prepend=stamps[places[0]] - 1) > 0]
        velocity[places] = _velocities(stamps[places], centres[places])
        rows.append(places)
    walking = _walking(velocity, bodies.axes)
    return [
        FacingTrack(stamps[places], facing[places], walking[places], cues[places])
        for places in rows
    ]


def _measured(people: People, stamps: Stamps, model: SkeletonModel) -> MeasuredViews:
    """Measure everybody in axes of his own."""
    markers, bodies = FacingMarkers.of(model), MeasuredViews.allocate(len(stamps))
    bank = Bank(FacingPast.empty())
    bodies.stamps[:] = stamps
    bodies.rows[:] = [bank.row(person, 0) for person in people.ids.tolist()]
    tables = FacingTables.make()
    measure(people, np.arange(len(stamps)), markers, bodies, bank.past, tables)
    return bodies


def _walking(velocity: Floats, axes: Floats) -> Floats:
    """(N, 3) What of the velocity is at a right angle to an upright trunk, m/s; NaN for others.

    Most trunks are upright: their mean points up.
    """
    trunk = axes[:, 2]
    up = np.nanmean(trunk, axis=0)
    is_upright = trunk @ up > UPRIGHT * np.linalg.norm(up)
    across = velocity - (velocity * trunk).sum(axis=1, keepdims=True) * trunk
    return np.where(is_upright[:, None], across, np.nan)


def side_scores(
    frames: Iterable[Frame], model: SkeletonModel, mirrored: Mapping[str, int] | None = None
) -> SideScores:
    """Count what speaks against left and right of a result; ``mirrored`` is passed on."""
    walking = backwards = jumps = 0
    against, shown = np.zeros(len(CUES)), np.zeros(len(CUES))
    for track in facing_tracks(frames, model):
        speed, along = track.along()
        walks = (speed > WALKING) & ~np.isnan(along)
        walking += int(walks.sum())
        backwards += int((walks & (along < -ALONG)).sum())
        turns = (track.facing[1:] * track.facing[:-1]).sum(axis=1)
        steps = np.diff(track.stamps) < _GAP
        jumps += int((steps & (turns < np.cos(np.radians(100)))).sum())
        faces = ~np.isnan(track.facing[:, 0])
        forwards = np.einsum("tkc,tc->tk", track.cues[faces], track.facing[faces])
        shown += (np.abs(forwards) > _CLEAR).sum(axis=0)
        against += (forwards < -_CLEAR).sum(axis=0)
    shares = zip(CUES, against.tolist(), shown.tolist(), strict=True)
    contradicting = {cue: a / n for cue, a, n in shares if n}
    return SideScores(walking, backwards, jumps, contradicting, mirrored or {})


def _velocities(stamps: Stamps, centres: Floats) -> Floats:
    """(T, 3) Slope of a line through the centres of half a second round each instant, m/s."""
    out = np.full((len(stamps), 3), np.nan)
    firsts = np.searchsorted(stamps, stamps - _SPAN)
    ends = np.searchsorted(stamps, stamps + _SPAN, side="right")
    for k, (first, end) in enumerate(zip(firsts.tolist(), ends.tolist(), strict=True)):
        x, t = centres[first:end], (stamps[first:end] - stamps[k]) * 1e-9
        if end - first >= _FEWEST and np.ptp(t) * 1e9 > _SPAN:
            t = t - t.mean()
            out[k] = t @ x / (t @ t)
    return out
