"""How far skeletons are from the truth, in the measures of the three papers and of the field."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field

import numpy as np

from hiros_mcap.body.anatomy import ANGLE_NAMES, anatomical_angles
from hiros_mcap.body.angles import ANGLES, flexions, link_angles, wrapped
from hiros_mcap.body.rotations import angle
from hiros_mcap.body.segments import SIDES
from hiros_mcap.evaluate.match import MATCH_DISTANCE, Matches, explain_no_overlap, match
from hiros_mcap.evaluate.mot import TrackingScores, tracking_scores
from hiros_mcap.evaluate.smoothness import distances_at, jitter, lag, lengths_of, limb_variations
from hiros_mcap.evaluate.statistics import (
    AngleStats,
    ErrorStats,
    block_interval,
    blocks_of,
    mean_of,
    parts_of,
)
from hiros_mcap.evaluate.truth import Truth
from hiros_mcap.io.marker_uncertainty import Deviations
from hiros_mcap.skeletons import Floats, Frame, SkeletonModel

PCK_MM = tuple(range(0, 201, 5))
"""Thresholds of the PCK curves, mm."""
FIRST_FRAMES = 5
"""First frames of a new id, which are also scored alone: detectors start in a wrong pose."""
SINGULAR_DEG = 75.0
"""A true joint whose x angle is beyond has no z angle worth scoring: at 90 degrees both axes
coincide, and here an error of 1 degree about y already changes z by 1 / cos 75 = 4 degrees."""


@dataclass(frozen=True, slots=True)
class Scores(ErrorStats):
    """Numbers of one channel against the truth over all frames and people; NaN = unknown.

    Those of :class:`ErrorStats` are of the distances of all joints, mm.

    :data:`hiros_mcap.evaluate.measures.MEASURES` says what each is. Units are mm, degrees, ms.
    """

    angle_rmse: float
    angle_deviation: float
    """SD of the error of each of the eight, degrees, averaged: the error without the constant
    offset of each joint (Hi-ROS eq. 20 and section 4.1)."""
    link_angle_rmse: float
    link_angle_deviation: float
    orientation_error: float
    limb_error: float
    limb_variation: float
    jitter: float
    lag: float
    mean_at_lag: float
    first_frames: float
    missing: int
    false: int | None  # none if the truth is partial
    switches: int
    frames: int
    silent: int
    tracking: TrackingScores
    parts: Mapping[str, ErrorStats] = field(default_factory=dict)
    joints: Mapping[str, ErrorStats] = field(default_factory=dict)
    pck: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    """Share of true joints within each of :data:`PCK_MM`; for all joints and by part."""
    angles: Mapping[str, AngleStats] = field(default_factory=dict)
    """Of the eight unsigned bending angles, by joint."""
    link_angles: Mapping[str, AngleStats] = field(default_factory=dict)
    signed_angles: Mapping[str, AngleStats] = field(default_factory=dict)
    """Of the signed joint angles of body.anatomy, those that the markers give."""
    mean_low: float = np.nan  # lower end of the 95 % interval of the mean, over blocks of a second
    mean_high: float = np.nan

    @property
    def pck_50(self) -> float:
        """Share of joints within 50 mm."""
        return self.pck_at(50)

    @property
    def pck_100(self) -> float:
        """Share of joints within 100 mm."""
        return self.pck_at(100)

    def pck_at(self, threshold_mm: int, part: str = "all") -> float:
        """Share of joints within a threshold of :data:`PCK_MM`."""
        return self.pck[part][PCK_MM.index(threshold_mm)]


def evaluate(
    frames: Iterable[Frame],
    truth: Truth,
    model: SkeletonModel,
    max_distance: float = MATCH_DISTANCE,
) -> Scores:
    """Score the skeletons with an id of one channel.

    Parameters
    ----------
    frames : of the channel, in the truth's coordinate frame, by time.
    truth : the true skeletons; with another model, what both have in common is compared.
    model : of ``frames``.
    max_distance : m, mean over joints; a skeleton farther away is of somebody else.

    Raises ConfigError if the models share no marker; ValueError if there are frames, but none
    within the time of the truth. (Without any frame, everybody is missing.)
    """
    return score_matches(match(frames, truth.seen_by(model), max_distance), truth, model)


def score_matches(matches: Matches, truth: Truth, model: SkeletonModel) -> Scores:
    """Score what :func:`match` found; see :func:`evaluate`."""
    if not matches.frames and (matches.span is not None or not matches.silent):
        raise ValueError(explain_no_overlap(matches, truth))
    truth = truth.seen_by(model)
    model = truth.model or model  # its own where nobody was seen
    poses, true_poses = matches.poses, matches.true_poses
    turns = matches.orientations, matches.true_orientations
    errors = 1000 * np.linalg.norm(poses - true_poses, axis=-1)
    bending = np.degrees(wrapped(flexions(model, poses) - flexions(model, true_poses)))
    angles = {name: AngleStats.of(bending[:, k]) for k, name in enumerate(ANGLES)}
    by_links = _link_angle_stats(model, *turns)
    tracks = matches.tracks.values()
    late_ms = lag(matches, truth)
    rows, columns = np.nonzero(~np.isnan(errors))
    _, low, high, _ = block_interval(errors[rows, columns], blocks_of(matches.stamps[rows]))
    return Scores(
        **asdict(ErrorStats.of(errors)),
        angle_rmse=_pooled_rmse(angles),
        angle_deviation=_mean_deviation(angles),
        link_angle_rmse=_pooled_rmse(by_links),
        link_angle_deviation=_mean_deviation(by_links),
        orientation_error=mean_of(np.degrees(angle(*turns))),
        limb_error=_limb_error(matches, truth, model),
        limb_variation=mean_of(limb_variations(tracks, model)),
        jitter=mean_of(jitter(tracks)),
        lag=late_ms,
        mean_at_lag=mean_of(1000 * distances_at(matches, truth, late_ms)),
        first_frames=mean_of(errors[_first_rows(matches)]),
        missing=len(matches.missed),
        false=None if truth.partial else matches.false,
        switches=matches.switches,
        frames=matches.frames,
        silent=matches.silent,
        tracking=tracking_scores(matches.similarities),
        parts={
            part: ErrorStats.of(errors[:, columns]) for part, columns in parts_of(model).items()
        },
        joints=ErrorStats.by_name(model.marker_names, errors),
        pck=pck_curves(errors, model, _unplaced(matches)),
        angles=angles,
        link_angles=by_links,
        signed_angles=_signed_angle_stats(model, poses, true_poses),
        mean_low=low,
        mean_high=high,
    )


def _link_angle_stats(
    model: SkeletonModel, orientations: Floats, true_orientations: Floats
) -> dict[str, AngleStats]:
    """Errors of the z angles of eq. 21, without those of a true joint that is near-singular.

    Only the truth decides, so that every result is scored at the same instants.
    """
    angles, true = link_angles(model, orientations), link_angles(model, true_orientations)
    errors = np.degrees(wrapped(angles[..., 0] - true[..., 0]))
    singular = (np.abs(np.degrees(true[..., 1])) > SINGULAR_DEG) & ~np.isnan(errors)
    errors[singular] = np.nan
    left_out = singular.sum(axis=0).tolist()
    return {name: AngleStats.of(errors[:, k], left_out[k]) for k, name in enumerate(ANGLES)}


def _signed_angle_stats(
    model: SkeletonModel, poses: Floats, true_poses: Floats
) -> dict[str, AngleStats]:
    """Errors of the signed angles, without those that are near-singular.

    These are flexion and rotation of a limb that is held sideways (docs/angles.md).
    """
    angles, true = (anatomical_angles(model, p, unwrapped=False) for p in (poses, true_poses))
    errors = np.degrees(wrapped(angles - true))
    left_out = np.zeros(len(ANGLE_NAMES), int)
    for joint in (f"{side} {limb}" for side in SIDES for limb in ("hip", "shoulder")):
        abduction = np.degrees(true[:, ANGLE_NAMES.index(f"{joint} abduction")])
        for k in (ANGLE_NAMES.index(f"{joint} {name}") for name in ("flexion", "rotation")):
            singular = (np.abs(abduction) > SINGULAR_DEG) & ~np.isnan(errors[:, k])
            errors[singular, k] = np.nan
            left_out[k] = singular.sum()
    columns = zip(ANGLE_NAMES, errors.T, left_out.tolist(), strict=True)
    stats = {name: AngleStats.of(column, n) for name, column, n in columns}
    return {name: stat for name, stat in stats.items() if stat.count or stat.singular}


def _pooled_rmse(angles: Mapping[str, AngleStats]) -> float:
    """Hi-ROS eq. 20, where N is the number of all angles."""
    counted = [a for a in angles.values() if a.count]
    squares = sum(a.count * a.rmse**2 for a in counted)
    return float(np.sqrt(squares / sum(a.count for a in counted))) if counted else np.nan


def _mean_deviation(angles: Mapping[str, AngleStats]) -> float:
    """Mean over all angles of their joint's SD: each joint has an offset of its own (4.1).

    Without angles that are left out, it is the plain mean over the joints.
    """
    counted = [a for a in angles.values() if a.count]
    total = sum(a.count * a.deviation for a in counted)
    return total / sum(a.count for a in counted) if counted else np.nan


def _unplaced(matches: Matches) -> Floats:
    """(M,) How often the truth has a marker and the result, which has it elsewhere, lacks it."""
    lacks = np.isnan(matches.poses[..., 0]) & ~np.isnan(matches.true_poses[..., 0])
    count = lacks.sum(axis=0) + np.sum(matches.missed, axis=0, initial=0)
    shown = [~np.isnan(t.poses[..., 0]).all(axis=0) for t in matches.tracks.values()]
    return np.where(np.any(shown, axis=0), count, 0) if shown else np.asarray(count)


def pck_curves(
    errors: Floats, model: SkeletonModel, unplaced: Floats
) -> dict[str, tuple[float, ...]]:
    """Share of true joints that are within each threshold; all joints, and by part.

    Parameters
    ----------
    errors : (R, M) mm, NaN where unknown.
    unplaced : (M,) how many true joints the result does not have; they are within no threshold.
    """
    within = np.stack([(errors <= mm).sum(axis=0) for mm in PCK_MM], axis=1)
    true = (~np.isnan(errors)).sum(axis=0) + unplaced
    groups = {"all": np.ones(model.n_markers, bool), **parts_of(model)}
    return {
        name: tuple((within[columns].sum(axis=0) / (true[columns].sum() or np.nan)).tolist())
        for name, columns in groups.items()
    }


def _first_rows(matches: Matches) -> list[int]:
    """Rows of the first frames of each id, but for those that begin with the log."""
    start = min((track.stamps[0] for track in matches.tracks.values()), default=0)
    first = {
        (i, stamp)
        for i, track in matches.tracks.items()
        if track.stamps[0] > start
        for stamp in track.stamps[:FIRST_FRAMES].tolist()
    }
    pairs = zip(matches.ids.tolist(), matches.stamps.tolist(), strict=True)
    return [k for k, pair in enumerate(pairs) if pair in first]


def _limb_error(matches: Matches, truth: Truth, model: SkeletonModel) -> float:
    """Per row, against the median length of the true person."""
    lengths = lengths_of(truth.positions, model)
    medians = np.full(lengths.shape[1:], np.nan)
    seen = ~np.isnan(lengths).all(axis=0)
    medians[seen] = np.nanmedian(lengths[:, seen], axis=0)
    of_result = lengths_of(matches.poses, model)
    return mean_of(1000 * np.abs(of_result - medians[matches.people]))


# Quantiles of chi square with three degrees of freedom.
_SQUARE_68, _SQUARE_95 = 3.5059, 7.8147


@dataclass(frozen=True, slots=True)
class EllipsoidCoverage:
    """Shares of the true joints; right are 0.68 and 0.95."""

    within_68: float  # share inside the ellipsoid that holds 68 % of a normal distribution
    within_95: float

    def __str__(self) -> str:
        return (
            f"68 % ellipsoids hold {100 * self.within_68:.0f} % of the true joints, 95 % "
            f"ellipsoids {100 * self.within_95:.0f} %"
        )


def coverage_of(
    matches: Matches, given: Deviations, model: SkeletonModel
) -> EllipsoidCoverage | None:
    """Compare errors with stated deviations; None if no joint has both."""
    keys = zip(matches.stamps.tolist(), matches.ids.tolist(), strict=True)
    stated = (given.get(key, {}) for key in keys)
    rows = [[one.get(marker, np.nan) for marker in model.marker_ids] for one in stated]
    deviations = np.array(rows).reshape(-1, model.n_markers)
    squares = ((matches.poses - matches.true_poses) ** 2).sum(axis=2) / deviations**2
    squares = squares[np.isfinite(squares)]
    if not len(squares):
        return None
    return EllipsoidCoverage(
        float((squares < _SQUARE_68).mean()), float((squares < _SQUARE_95).mean())
    )
