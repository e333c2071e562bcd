"""How far skeletons are from the truth, in the measures of the three papers and of the field."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

from hiros_mcap.body.angles import ANGLES, flexions, link_flexions, wrapped
from hiros_mcap.body.rotations import angle
from hiros_mcap.evaluate.match import MATCH_DISTANCE, Matches, match
from hiros_mcap.evaluate.mot import TrackingScores, tracking_scores
from hiros_mcap.evaluate.parts import parts_of
from hiros_mcap.evaluate.smoothness import column_mean, jitter, lag, lengths_of, limb_variations
from hiros_mcap.evaluate.truth import Truth
from hiros_mcap.skeletons import Floats, Frame, SkeletonModel

PCK_MM = tuple(range(0, 201, 5))
"""Thresholds of the PCK curves, mm."""
FIRST_FRAMES = 5
"""Frames of a new id that are also scored apart: detectors start bodies in a wrong pose."""


@dataclass(frozen=True, slots=True)
class ErrorStats:
    """Distances to the truth, mm."""

    mean: float
    deviation: float
    rmse: float
    percentile_95: float
    count: int

    @classmethod
    def of(cls, errors: Floats) -> ErrorStats:
        """Summarise errors in mm, whatever their shape; NaN does not count."""
        known = errors[~np.isnan(errors)]
        if not known.size:
            return cls(np.nan, np.nan, np.nan, np.nan, 0)
        return cls(
            float(known.mean()),
            float(known.std()),
            float(np.sqrt((known * known).mean())),
            float(np.percentile(known, 95)),
            known.size,
        )


@dataclass(frozen=True, slots=True)
class AngleStats:
    """Errors of a joint's flexion, degrees (Hi-ROS eq. 20, with the mean and SD of the error)."""

    rmse: float
    deviation: float
    """Without the constant offset that two conventions may have."""
    bias: float
    count: int

    @classmethod
    def of(cls, errors: Floats) -> AngleStats:
        """Summarise errors in degrees; NaN does not count."""
        known = errors[~np.isnan(errors)]
        if not known.size:
            return cls(np.nan, np.nan, np.nan, 0)
        return cls(
            float(np.sqrt((known * known).mean())),
            float(known.std()),
            float(known.mean()),
            known.size,
        )


@dataclass(frozen=True, slots=True)
class Scores:
    """Measures over all frames and people of one channel against the truth."""

    mean: float
    """Mean joint error, mm."""
    deviation: float
    """Standard deviation of the joint error, mm."""
    rmse: float
    percentile_95: float
    """95 % of the joint errors are below, mm."""
    angle_rmse: float
    """Root mean square error of the eight flexions from marker positions, degrees (eq. 20)."""
    angle_deviation: float
    """Standard deviation of the angles' errors, degrees (the bias-free error)."""
    link_angle_rmse: float
    """The same eight by the links' orientations (eq. 21)."""
    link_angle_deviation: float
    turn_error: float
    """Mean angle between a link's orientation and the true one (eq. 10), degrees."""
    limb_error: float
    """Mean absolute difference of a link's length from the person's true one, mm."""
    limb_variation: float
    """Mean over people and links of the coefficient of variation of the length."""
    jitter: float
    """Mean norm of the second difference of joint positions between frames, mm."""
    lag: float
    """By how many ms the result is late: the shift that fits the truth best."""
    first_frames: float
    """Mean joint error in the first five frames of an id, mm."""
    missing: int
    """True people that no skeleton was matched to, summed over frames."""
    false: int
    """Skeletons with an id that are of nobody, or of somebody twice, summed over frames."""
    switches: int
    """How often a true person's nearest skeleton had another id than before."""
    frames: int
    tracking: TrackingScores
    parts: Mapping[str, ErrorStats] = field(default_factory=dict)
    joints: Mapping[str, ErrorStats] = field(default_factory=dict)
    pck: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    """Share of joints within each of :data:`PCK_MM`; for all joints and by part."""
    angles: Mapping[str, AngleStats] = field(default_factory=dict)
    link_angles: Mapping[str, AngleStats] = field(default_factory=dict)

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

    Raises
    ------
    ConfigError
        The models share no marker.
    ValueError
        No frame lies within the time of the truth.
    """
    return score_matches(match(frames, truth.seen_by(model), max_distance), truth, model)


def score_matches(matches: Matches, truth: Truth, model: SkeletonModel) -> Scores:
    """Score what :func:`match` found; see :func:`evaluate`."""
    if not matches.frames:
        raise ValueError("no frame lies within the time of the truth")
    truth = truth.seen_by(model)
    poses, true_poses = _stack(matches.poses, model), _stack(matches.true_poses, model)
    errors = 1000 * np.linalg.norm(poses - true_poses, axis=-1)
    bends = np.degrees(wrapped(flexions(model, poses) - flexions(model, true_poses)))
    turns, true_turns = _stack_turns(matches.turns, model), _stack_turns(matches.true_turns, model)
    link_bends = np.degrees(wrapped(link_flexions(model, turns) - link_flexions(model, true_turns)))
    every, bend, link_bend = ErrorStats.of(errors), AngleStats.of(bends), AngleStats.of(link_bends)
    tracks = matches.tracks.values()
    return Scores(
        mean=every.mean,
        deviation=every.deviation,
        rmse=every.rmse,
        percentile_95=every.percentile_95,
        angle_rmse=bend.rmse,
        angle_deviation=bend.deviation,
        link_angle_rmse=link_bend.rmse,
        link_angle_deviation=link_bend.deviation,
        turn_error=mean_of(np.degrees(angle(turns, true_turns))),
        limb_error=_limb_error(matches, truth, model),
        limb_variation=mean_of(limb_variations(tracks, model)),
        jitter=mean_of(jitter(tracks)),
        lag=lag(matches, truth),
        first_frames=mean_of(errors[_first_rows(matches)]),
        missing=matches.missing,
        false=matches.false,
        switches=matches.switches,
        frames=matches.frames,
        tracking=tracking_scores(matches.instants),
        parts={part: ErrorStats.of(errors[:, own]) for part, own in parts_of(model).items()},
        joints=_by_name(model.marker_names, errors),
        pck=pck_curves(errors, model),
        angles={name: AngleStats.of(bends[:, k]) for k, name in enumerate(ANGLES)},
        link_angles={name: AngleStats.of(link_bends[:, k]) for k, name in enumerate(ANGLES)},
    )


def pck_curves(errors: Floats, model: SkeletonModel) -> dict[str, tuple[float, ...]]:
    """Share of joints with an error, mm, of at most each threshold; all joints, and by part."""
    groups = {"all": np.ones(model.n_markers, bool), **parts_of(model)}
    return {name: _pck(errors[:, own]) for name, own in groups.items()}


def mean_of(values: Floats) -> float:
    """Mean without NaN; NaN if there is nothing else."""
    return float(column_mean(np.asarray(values).reshape(-1, 1))[0]) if values.size else np.nan


def _pck(errors: Floats) -> tuple[float, ...]:
    known = errors[~np.isnan(errors)]
    return tuple(float((known <= t).mean()) if known.size else np.nan for t in PCK_MM)


def _stack(poses: list[Floats], model: SkeletonModel) -> Floats:
    return np.stack(poses) if poses else np.full((0, model.n_markers, 3), np.nan)


def _stack_turns(turns: list[Floats], model: SkeletonModel) -> Floats:
    return np.stack(turns) if turns else np.full((0, model.n_links, 4), np.nan)


def _by_name(names: tuple[str, ...], errors: Floats) -> dict[str, ErrorStats]:
    stats = {name: ErrorStats.of(errors[:, k]) for k, name in enumerate(names)}
    return {name: joint for name, joint in stats.items() if joint.count}


def _first_rows(matches: Matches) -> list[int]:
    """Rows of the first frames of each id, but for those that begin with the log."""
    start = min((track.stamps[0] for track in matches.tracks.values()), default=0)
    first = {
        (i, stamp)
        for i, track in matches.tracks.items()
        if track.stamps[0] > start
        for stamp in track.stamps[:FIRST_FRAMES]
    }
    pairs = zip(matches.ids, matches.stamps, strict=True)
    return [k for k, pair in enumerate(pairs) if pair in first]


def _limb_error(matches: Matches, truth: Truth, model: SkeletonModel) -> float:
    """Per row, against the median length of the true person."""
    if not matches.poses:
        return np.nan
    lengths = lengths_of(truth.positions, model)
    own = np.full(lengths.shape[1:], np.nan)
    seen = ~np.isnan(lengths).all(axis=0)
    own[seen] = np.nanmedian(lengths[:, seen], axis=0)
    found = lengths_of(np.stack(matches.poses), model)
    return mean_of(1000 * np.abs(found - own[matches.people]))
