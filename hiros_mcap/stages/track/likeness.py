"""Whether a track is a copy: another camera's displaced or mirrored view of a person.

A copy becomes the person by one rotation and one shift, or by one reflection, over all instants.
Least squares find it (Kabsch 1976). The distance that remains is compared with how far the person
moved. :mod:`hiros_mcap.stages.track.displaced` gathers the instants.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hiros_mcap.calibrate.registration import kabsch
from hiros_mcap.skeletons import Floats, Ints

DISPLACED = "displaced"  # counts detections, by camera, that were left out as copies
ALIKE, ALIKE_IF_DISPLACED = 0.085, 0.12
"""Largest mean marker distance, m, of a copy after the fit. Copies have 0.02 to 0.08, other people
over 0.13, or 0.10 after a reflection. The second is for a camera that is displaced for certain."""
UNSEEN = 0.7  # share of the time in which a displaced camera does not show the person in place
FEWEST = 6  # instants that are compared

_FEWEST_MARKERS = 6  # that both have at an instant
_MOTION = 0.07  # m: SD of the person's markers over time; less is no evidence
_CLEARLY = 1.7  # motion over distance after the fit
_PURE_ANGLE, _PURE_SHIFT = np.radians(15.0), 0.3  # rad and m besides a mirror's reflection
_ROUNDS, _OUTLYING = 3, 1.7  # fits; instants this many medians off are left out of the next one


class Displacement(NamedTuple):
    """What takes the people whom a camera shows to where other cameras see them."""

    rotation: Floats  # (3, 3); improper if it mirrors
    shift: Floats  # (3,) m
    mirrors: bool
    swaps: bool  # whether left and right are swapped as well

    def inverse(self) -> Displacement:
        """Return what takes people from where the other cameras see them to where this one does."""
        back = self.rotation.T
        return self._replace(rotation=back, shift=-back @ self.shift)

    def undo(self, poses: Floats, mirror: Ints) -> Floats:
        """Return where the people of (..., M, 3) markers are, m."""
        poses = poses[..., mirror, :] if self.swaps else poses
        return np.asarray(poses @ self.rotation.T + self.shift)


class Likeness(NamedTuple):
    """How much a track looks like a displaced view of a person."""

    distance: float  # median over time of the mean marker distance after the fit, m
    motion: float  # SD of the person's markers over time, m
    apart: float  # median distance of the two before the fit, m
    by: Displacement
    pure: bool  # whether it is a reflection, and that explains how far apart the two are

    def is_copy(self, limit: float, unseen: float) -> bool:
        """Whether it is a copy, with a limit of the distance, m.

        ``unseen`` is the share of time in which the camera does not show the person in place.
        """
        alike = self.distance < min(limit, self.motion / _CLEARLY) and self.motion > _MOTION
        return alike and (self.pure if self.by.mirrors else unseen >= UNSEEN)


def likeness(track: Floats, person: Floats, mirror: Ints) -> Likeness | None:
    """Compare a track with a person; None if there is no evidence.

    Parameters
    ----------
    track, person : (K, M, 3) markers of both at K instants, m. mirror : (M,) slot of the
        marker on the other side.
    """
    both = np.isfinite(track[..., 0] + person[..., 0])
    enough = np.count_nonzero(both, axis=1) >= _FEWEST_MARKERS
    if np.count_nonzero(enough) < FEWEST:
        return None
    track, person, both = track[enough], person[enough], both[enough]
    often = np.count_nonzero(both, axis=0) >= FEWEST
    if not often.any():
        return None
    motion = float(np.sqrt(np.mean(np.nanvar(person[:, often], axis=0).sum(axis=-1))))
    if motion <= _MOTION:
        return None
    by, distance = _best_fit(track, person, mirror, mirrors=False)
    if distance > ALIKE:  # a body that is almost flat looks like its mirror image, too
        by, distance = min(
            (by, distance), _best_fit(track, person, mirror, mirrors=True), key=lambda each: each[1]
        )
    away = np.nanmean(track - person, axis=1)
    apart = float(np.median(np.linalg.norm(away, axis=-1)))
    pure = by.mirrors and _only_reflects(by.rotation, away.mean(axis=0))
    return Likeness(distance, motion, apart, by, pure)


def _best_fit(
    track: Floats, person: Floats, mirror: Ints, *, mirrors: bool
) -> tuple[Displacement, float]:
    """Return the better of the fits with sides as they are and with sides swapped."""
    sides = (False, True) if (mirror != np.arange(len(mirror))).any() else (False,)
    fits = [fit(track, person, mirror, mirrors, swaps) for swaps in sides]
    return min(fits, key=lambda each: each[1])


def fit(
    track: Floats, person: Floats, mirror: Ints, mirrors: bool, swaps: bool
) -> tuple[Displacement, float]:
    """Return the displacement that fits best, and the median over time of the distance left, m.

    Instants that fit much worse than most are left out; inf if too few are left. Parameters: see
    :func:`likeness`.
    """
    source = track[:, mirror] if swaps else track
    both = np.isfinite(source[..., 0] + person[..., 0])
    used = np.count_nonzero(both, axis=1) >= _FEWEST_MARKERS
    if np.count_nonzero(used) < FEWEST:
        return Displacement(np.eye(3), np.zeros(3), mirrors, swaps), np.inf
    for _ in range(_ROUNDS):
        rows = both & used[:, None]
        rotation, shift = kabsch(source[rows], person[rows], mirrors=mirrors)
        by = Displacement(rotation, shift, mirrors, swaps)
        distances = mean_marker_distances(by.undo(track, mirror), person)
        distance = float(np.median(distances))
        if distance > 2.0 * ALIKE_IF_DISPLACED:  # nothing that is left out would mend it
            break
        used = distances <= _OUTLYING * distance
    return by, distance


def median_distance(by: Displacement, track: Floats, person: Floats, mirror: Ints) -> float:
    """Median over time of the distance, m, of a track from a person, the displacement undone."""
    return float(np.median(mean_marker_distances(by.undo(track, mirror), person)))


def mean_marker_distances(some: Floats, others: Floats) -> Floats:
    """Mean distance, m, of the markers (..., M, 3) that both have; inf if there is none."""
    apart = np.sqrt(np.sum((some - others) ** 2, axis=-1))
    n = np.count_nonzero(np.isfinite(apart), axis=-1)
    return np.where(n > 0, np.nansum(apart, axis=-1) / np.maximum(n, 1), np.inf)


def _only_reflects(rotation: Floats, away: Floats) -> bool:
    """Whether an improper rotation is a reflection that explains how far apart two people are."""
    normal = np.linalg.eigh(rotation + rotation.T)[1][:, 0]
    beside = away - (away @ normal) * normal
    angle = np.arccos(np.clip((np.trace(rotation) + 1.0) / 2.0, -1.0, 1.0))
    return bool(angle < _PURE_ANGLE and np.linalg.norm(beside) < _PURE_SHIFT)
