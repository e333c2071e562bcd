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
from hiros_mcap.evaluate.smoothness import jitter, lag, lengths_of, limb_variations
from hiros_mcap.evaluate.statistics import AngleStats, ErrorStats, mean_of
from hiros_mcap.evaluate.truth import Truth
from hiros_mcap.skeletons import Floats, Frame, SkeletonModel

PCK_MM = tuple(range(0, 201, 5))
"""Thresholds of the PCK curves, mm."""
FIRST_FRAMES = 5
"""First frames of a new id, which are also scored alone: detectors start in a wrong pose."""


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
    """Standard deviation of the angles' errors, degrees: the error without the bias."""
    link_angle_rmse: float
    """The same eight by the links' orientations (eq. 21)."""
    link_angle_deviation: float
    orientation_error: float
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
        raise ValueError("the truth covers no frame of the result; check --shift")
    truth = truth.seen_by(model)
    markers, links = (model.n_markers, 3), (model.n_links, 4)
    poses, true_poses = _stack(matches.poses, markers), _stack(matches.true_poses, markers)
    orientations = _stack(matches.orientations, links)
    true_orientations = _stack(matches.true_orientations, links)
    errors = 1000 * np.linalg.norm(poses - true_poses, axis=-1)
    flexion = np.degrees(wrapped(flexions(model, poses) - flexions(model, true_poses)))
    by_links = link_flexions(model, orientations) - link_flexions(model, true_orientations)
    link_flexion = np.degrees(wrapped(by_links))
    all_errors, all_angles = ErrorStats.of(errors), AngleStats.of(flexion)
    all_link_angles = AngleStats.of(link_flexion)
    tracks = matches.tracks.values()
    return Scores(
        mean=all_errors.mean,
        deviation=all_errors.deviation,
        rmse=all_errors.rmse,
        percentile_95=all_errors.percentile_95,
        angle_rmse=all_angles.rmse,
        angle_deviation=all_angles.deviation,
        link_angle_rmse=all_link_angles.rmse,
        link_angle_deviation=all_link_angles.deviation,
        orientation_error=mean_of(np.degrees(angle(orientations, true_orientations))),
        limb_error=_limb_error(matches, truth, model),
        limb_variation=mean_of(limb_variations(tracks, model)),
        jitter=mean_of(jitter(tracks)),
        lag=lag(matches, truth),
        first_frames=mean_of(errors[_first_rows(matches)]),
        missing=matches.missing,
        false=matches.false,
        switches=matches.switches,
        frames=matches.frames,
        tracking=tracking_scores(matches.similarities),
        parts={part: ErrorStats.of(errors[:, own]) for part, own in parts_of(model).items()},
        joints=ErrorStats.by_name(model.marker_names, errors),
        pck=pck_curves(errors, model),
        angles={name: AngleStats.of(flexion[:, k]) for k, name in enumerate(ANGLES)},
        link_angles={name: AngleStats.of(link_flexion[:, k]) for k, name in enumerate(ANGLES)},
    )


def pck_curves(errors: Floats, model: SkeletonModel) -> dict[str, tuple[float, ...]]:
    """Share of joints with an error, mm, of at most each threshold; all joints, and by part."""
    groups = {"all": np.ones(model.n_markers, bool), **parts_of(model)}
    return {name: _pck(errors[:, own]) for name, own in groups.items()}


def _pck(errors: Floats) -> tuple[float, ...]:
    known = errors[~np.isnan(errors)]
    return tuple(float((known <= t).mean()) if known.size else np.nan for t in PCK_MM)


def _stack(rows: list[Floats], shape: tuple[int, int]) -> Floats:
    return np.stack(rows) if rows else np.full((0, *shape), np.nan)


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
