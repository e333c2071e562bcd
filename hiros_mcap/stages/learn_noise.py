"""Learns the noise of cameras and the motion of joints from the best stretch of a log.

1. The stretch with most views of people in motion is chosen.
2. White noise, from third differences of a camera's own stream, which slow motion hardly enters:
   log variance = joint + camera + 2 p log(distance), larger for a guess, by medians.
3. Accelerations, offsets and their time constant, by the likelihood of the innovations, one after
   the other on geometric grids.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from hiros_mcap.body.symmetry import symmetry_of
from hiros_mcap.events import Events
from hiros_mcap.frames import Block
from hiros_mcap.kernels import fusing
from hiros_mcap.kernels.fusing import FusionWork, JointStates, Sightings, Steps
from hiros_mcap.skeletons import Flags, Floats, SkeletonModel
from hiros_mcap.stages.fusion_noise import FusionNoise, distances
from hiros_mcap.stages.merge_params import MergeParams
from hiros_mcap.stages.sightings import SightingGatherer, chosen, joined

_STRETCH = 10_000_000_000  # ns
_FEWEST_VIEWS = 90
_MOST_VIEWS = 3000  # that the likelihood is computed for
_BIN = 30  # third differences that give one variance
_BIAS = 0.089  # of the log of a mean over a bin
_LEAST_WHITE = 0.001  # m; a detector that filters its output hides its noise
_LEAST_ACCELERATION = 2.0  # m2/s3; the same
_COARSE = 2.0 ** np.arange(-3.0, 4.0)
_FINE = 2.0 ** np.arange(-1.0, 1.5, 0.5)


def learn_noise(
    blocks: Iterable[Block],
    model: SkeletonModel,
    merging: MergeParams,
    cameras: Mapping[str, Floats],
) -> FusionNoise:
    """Return what tracked blocks show of noise; the defaults as far as they show nothing.

    ``cameras`` are their positions, m, as far as known. Of the log, only the best stretch is kept.
    """
    noise = FusionNoise.default(model)
    gathered = SightingGatherer(model, merging).run(blocks, Events())
    best = max(_stretches(gathered), key=lambda stretch: score_of(stretch[0]), default=None)
    if best is None or len(best[0].people) < _FEWEST_VIEWS:
        return noise
    views, names = best
    noise = learn_white(views, names, cameras, noise)
    return learn_motion(views, noise.variances(views, names, cameras), len(names), model, noise)


def _stretches(
    gathered: Iterable[tuple[Block, Sightings, tuple[str, ...]]],
) -> Iterator[tuple[Sightings, tuple[str, ...]]]:
    """Cut what was seen into stretches of equal length."""
    held: list[Sightings] = []
    names: tuple[str, ...] = ()
    for _, views, names in gathered:
        held.append(views)
        rest = joined(held)
        while len(rest.stamps) and rest.stamps[-1] - rest.stamps[0] >= _STRETCH:
            inside = rest.stamps - rest.stamps[0] < _STRETCH
            yield chosen(rest, inside), names
            rest = chosen(rest, ~inside)
        held = [rest]
    if held and len(held[0].stamps):
        yield held[0], names


def _streams(views: Sightings) -> Iterator[Sightings]:
    """Yield each camera's views of each person, in the order of time."""
    for person, camera in {*zip(views.people.tolist(), views.cameras.tolist(), strict=True)}:
        own = chosen(views, (views.people == person) & (views.cameras == camera))
        yield chosen(own, np.argsort(own.stamps, kind="stable"))


def score_of(views: Sightings) -> float:
    """Count views, weighted by how far markers move, m; a person who stands teaches little."""
    total = 0.0
    for stream in _streams(views):
        if len(stream.stamps) >= _BIN:
            spread = np.sqrt(np.nanvar(stream.positions[:, ~_never(stream)], axis=0).sum(axis=1))
            total += len(stream.stamps) * min(float(np.mean(spread)), 1.0)
    return total


def _never(stream: Sightings) -> Flags:
    """(M,) Whether a marker is never seen."""
    return np.asarray(np.isnan(stream.positions[:, :, 0]).all(axis=0))


def learn_white(
    views: Sightings, names: Sequence[str], places: Mapping[str, Floats], noise: FusionNoise
) -> FusionNoise:
    """Return ``noise`` with the white noise that third differences show."""
    upper = np.nanquantile(views.confidences, 0.9) if np.isfinite(views.confidences).any() else 1.0
    noise = replace(noise, guessed_below=0.6 * float(upper))
    away = np.log(distances(views, names, places) / 2.0)
    seen, guessed = [], []
    for source, found, distance, share in binned(views, away, noise.guessed_below):
        seen.append((source, distance, np.where(share == 0, found, np.nan)))
        guessed.append(np.where(share == 1, found, np.nan))
    if not seen:
        return noise
    camera = np.array([row[0] for row in seen])
    mean_away = np.array([row[1] for row in seen])
    logs = np.stack([row[2] for row in seen])
    slope = 2 * noise.power
    joint, factor = np.log(noise.joints), np.zeros(len(names))
    for _ in range(4):
        left = logs - slope * mean_away[:, None]
        joint = _medians(left - factor[camera][:, None], joint)
        for k in range(len(names)):
            own = (left - joint)[camera == k]
            factor[k] = np.nanmedian(own) if np.isfinite(own).any() else 0.0
        factor -= factor[np.unique(camera)].mean()
        if np.ptp(mean_away) > 0.3:
            residual = logs - joint - factor[camera][:, None]
            slope = float(np.clip(_slope(mean_away, residual), 0.0, 4.0))
    expected = joint + factor[camera][:, None] + slope * mean_away[:, None]
    excess = np.stack(guessed) - expected
    ratio = noise.guessed
    if np.isfinite(excess).sum() >= _BIN:
        ratio = float(np.clip(np.exp(np.nanmedian(excess) / 2), 1.0, 10.0))
    return replace(
        noise,
        joints=np.maximum(np.exp(joint), _LEAST_WHITE**2),
        cameras=dict(zip(names, np.exp(factor).tolist(), strict=True)),
        power=slope / 2,
        guessed=ratio,
    )


def binned(
    views: Sightings, away: Floats, guessed_below: float
) -> Iterator[tuple[int, Floats, float, Floats]]:
    """Yield camera, (M,) log variances, log distance / 2 m and (M,) share of guesses of bins."""
    for person, camera in {*zip(views.people.tolist(), views.cameras.tolist(), strict=True)}:
        rows = np.flatnonzero((views.people == person) & (views.cameras == camera))
        rows = rows[np.argsort(views.stamps[rows], kind="stable")]
        gaps = np.diff(views.stamps[rows])
        if len(rows) < _BIN + 3:
            continue
        even = np.abs(gaps / np.median(gaps) - 1) < 0.3
        # Half of the norm has the mean of |D| along an axis, and does not depend on the axes.
        third = np.linalg.norm(np.diff(views.positions[rows], n=3, axis=0), axis=2) / 2
        third[~(even[:-2] & even[1:-1] & even[2:])] = np.nan
        guesses = views.confidences[rows] < guessed_below
        for start in range(0, len(third) - _BIN + 1, _BIN):
            part = third[start : start + _BIN]
            known = np.isfinite(part)
            enough = (known.sum(axis=0) >= _BIN // 2) & (np.nan_to_num(part).sum(axis=0) > 0)
            mean = np.nan_to_num(part).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
            logs = np.full(len(mean), np.nan)
            # The mean of |D| of a normal D with variance 20 R is sqrt(40 R / pi).
            logs[enough] = np.log(mean[enough] ** 2 * np.pi / 40) + _BIAS
            share = guesses[start : start + _BIN + 3].mean(axis=0)
            yield camera, logs, float(away[rows[start : start + _BIN]].mean()), share


def _medians(values: Floats, otherwise: Floats) -> Floats:
    """(M,) Medians of the columns; shifted defaults where a column has no number."""
    known = np.isfinite(values).any(axis=0)
    found = otherwise.copy()
    if known.any():
        found[known] = np.nanmedian(values[:, known], axis=0)
        found[~known] += np.median(found[known] - otherwise[known])
    return found


def _slope(x: Floats, y: Floats) -> float:
    """Slope of the medians of rows (N, M) over x (N,)."""
    known = np.isfinite(y).any(axis=1)
    rows = np.nanmedian(y[known], axis=1)
    return float(np.polyfit(x[known], rows, 1)[0]) if known.sum() > 1 else 0.0


def learn_motion(
    views: Sightings, variances: Floats, cameras: int, model: SkeletonModel, noise: FusionNoise
) -> FusionNoise:
    """Return ``noise`` with the most likely accelerations, offsets and time constant."""
    people = list(_steps(views, variances))
    mirror = symmetry_of(model).mirror

    def score(candidate: FusionNoise) -> Floats:
        found = _likelihoods(people, cameras, candidate)
        return np.where(mirror == np.arange(len(mirror)), found, found + found[mirror])

    for grid in (_COARSE, _FINE):
        tries = [replace(noise, accelerations=noise.accelerations * f) for f in grid]
        best = np.argmax([score(each) for each in tries], axis=0)
        found = np.maximum(noise.accelerations * grid[best], _LEAST_ACCELERATION)
        noise = replace(noise, accelerations=found)
        tries = [replace(noise, offsets=noise.offsets * f) for f in grid]
        best = np.argmax([score(each) for each in tries], axis=0)
        noise = replace(noise, offsets=noise.offsets * grid[best])
        tries = [replace(noise, time=noise.time * f) for f in grid[1:-1]]
        noise = max(tries, key=lambda each: score(each).sum())
    return noise


def _steps(views: Sightings, variances: Floats) -> Iterator[Steps]:
    """Yield the measurements of people, those who are seen most first, up to a total."""
    people, counts = np.unique(views.people, return_counts=True)
    left = _MOST_VIEWS
    for person in people[np.argsort(-counts, kind="stable")]:
        rows = np.flatnonzero(views.people == person)
        rows = rows[np.lexsort((views.cameras[rows], views.stamps[rows]))][: max(left, 0)]
        if len(rows):
            times = (views.stamps[rows] - views.stamps[rows[0]]) * 1e-9
            yield Steps(times, views.cameras[rows], views.positions[rows], variances[rows])
        left -= len(rows)


def _likelihoods(people: Sequence[Steps], cameras: int, noise: FusionNoise) -> Floats:
    """(M,) Log likelihood of the measurements of each joint."""
    m, n = len(noise.offsets), fusing.OFFSETS + cameras
    out, wanted = np.zeros(m), np.ones(m, np.bool_)
    states = JointStates.unknown(1, m, cameras)
    for steps in people:
        work = FusionWork.of(len(steps.times), n)
        fusing.likelihoods(steps, noise.motion(), states, wanted, out, work)
    return out
