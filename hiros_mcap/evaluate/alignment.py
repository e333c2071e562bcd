"""Where a truth of motion capture lies in the frame of a result, and when: found from the people.

A laboratory's system has an origin, axes and a clock of its own. The truth is turned, moved and, if
asked for, shifted in time as a whole, so that its people lie nearest to the result's:

    result(t) = R truth(t - seconds) + T

1. Every pair of a true person and a track gives a candidate for R and T: the rigid transform of
   all their common joints (Kabsch 1976). For the time, the candidates are tried at shifts over
   the whole log. The person's motion decides, since everybody fits somebody who stands still.
2. The candidate that leaves people nearest to each other, over everybody, wins. Of shifts that
   fit alike, because somebody repeats a motion, the one that covers more of the track wins.
3. From then on, matched skeletons are the pairs. R and T are fitted to them with Cauchy weights;
   the lag of the result is added to the time.

What is constant in the error of a result is lost by that: an alignment hides it.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence

import numpy as np

from hiros_mcap.body.rotations import Rigid, from_matrix, rotate
from hiros_mcap.calibrate.registration import rigid_fit, robust_kabsch
from hiros_mcap.errors import ConfigError, RegistrationError
from hiros_mcap.evaluate.logs import Channel
from hiros_mcap.evaluate.match import Matches, Track, match, skeleton_distances, tracks_of
from hiros_mcap.evaluate.smoothness import lag
from hiros_mcap.evaluate.truth import Alignment, Truth
from hiros_mcap.skeletons import Floats

_INSTANTS = 60  # instants of a track on which candidates are compared
_FRAMES = 3000  # frames of the result on which the winner is refined
_TRACKS = 6  # longest tracks that candidates are made of
_STEP, _FINE_STEP = 0.25, 0.05
"""s between the shifts that are tried: a walking person moves 30 cm in the first."""
_BEST = 5  # shifts of a pair that are tried finely
_LEAST_OVERLAP = 0.5  # of the shorter of truth and track, that they have in common at a shift
_STILL_M = 0.03  # RMS by which joints move about their mean, below which only noise moves
_UNEXPLAINED = 0.5  # share of a person's motion that the right shift leaves at most
_NEAR_M = 0.5  # median distance of a joint beyond which the truth is of something else


def aligned(truth: Truth, channels: Mapping[str, Channel], parts: Collection[str]) -> Truth:
    """Return the truth where :func:`align` finds it; as it is if ``parts`` is empty.

    ``parts`` are "pose", and "time", which includes it.
    """
    if not parts:
        return truth
    return truth.aligned(align(truth, channels, time="time" in parts))


def align(truth: Truth, channels: Mapping[str, Channel], *, time: bool = False) -> Alignment:
    """Find where a truth lies in the frame of the last of some channels; see the module.

    Parameters
    ----------
    truth : in any frame; its times as good as known if ``time`` is not asked for.
    time : also find the shift of the times.

    Returns
    -------
    What :meth:`Truth.aligned` takes.

    Raises
    ------
    ConfigError
        Truth and result share no marker or no time, nobody moves enough to show the time, or no
        pose brings their people near to each other.
    """
    topic, channel = list(channels.items())[-1]
    where = f"{channel.path}: {topic}"
    tracks = tracks_of(channel.frames)
    try:
        visible = truth.seen_by(channel.model)
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from None
    candidates = list(_candidates(visible, list(tracks.values()), time=time))
    if not candidates:
        still = "nobody moves so that the time shows"
        apart = "they have no person at one time; --align-time looks for the time"
        raise ConfigError(f"{where}: the truth cannot be aligned: {still if time else apart}")
    _, found = min(
        (
            (factor * _left_m(visible.aligned(candidate), tracks), candidate)
            for candidate, factor in candidates
        ),
        key=lambda pair: pair[0],
    )
    frames = channel.frames[:: max(1, len(channel.frames) // _FRAMES)]
    for _ in range(4):
        matches = match(frames, visible.aligned(found))
        if not len(matches.people):
            break
        late = lag(matches, visible.aligned(found)) if time else np.nan
        if not np.isnan(late):
            found = found._replace(seconds=found.seconds + late / 1000)
            matches = match(frames, visible.aligned(found))
        found = found._replace(pose=_refined(matches, found.pose))
    left = _left_m(visible.aligned(found), tracks)
    if not left < _NEAR_M:
        remedy = "" if time else ", at the right time? --align-time looks for the time"
        raise ConfigError(
            f"{where}: the truth cannot be aligned: at best its joints are {left:.2f} m from the "
            f"result's (median). Is it of this log{remedy or '?'}"
        )
    return found


def _candidates(
    truth: Truth, tracks: Sequence[Track], *, time: bool
) -> Iterator[tuple[Alignment, float]]:
    """Yield the best transform of each true person to each of the longest tracks, and its malus."""
    longest = sorted(tracks, key=lambda track: -len(track.stamps))[:_TRACKS]
    for person in range(truth.positions.shape[1]):
        for track in longest:
            every = max(1, len(track.stamps) // _INSTANTS)
            sample = Track(track.stamps[::every], track.poses[::every])
            if not time:
                best, shift = 0.0, 0.0
            else:
                rough = sorted(_unexplained(truth, person, sample, _shifts(truth, track)))[:_BEST]
                near = [s + k * _FINE_STEP for _, s in rough for k in range(-5, 6)]
                best, shift = min(_unexplained(truth, person, sample, near), default=(1.0, 0.0))
            fit = _fit(truth, person, sample, shift)
            if fit is not None and best < _UNEXPLAINED:
                pose, _, _, malus = fit
                yield Alignment(pose, seconds=shift), malus


def _shifts(truth: Truth, track: Track) -> Floats:
    """Shifts of the truth's times, s, at which enough of it and of a track are at one time."""
    first, last = truth.stamps[[0, -1]] / 1e9
    start, end = track.stamps[[0, -1]] / 1e9
    common = _LEAST_OVERLAP * min(last - first, end - start)
    return np.arange(start + common - last, end - common - first + _STEP, _STEP)


def _unexplained(
    truth: Truth, person: int, track: Track, shifts: Sequence[float] | Floats
) -> Iterator[tuple[float, float]]:
    """Yield (share of the motion that a shift leaves, with its malus; shift)."""
    for shift in shifts:
        fit = _fit(truth, person, track, float(shift))
        if fit is not None:
            _, left, moves, malus = fit
            if moves > _STILL_M:
                yield malus * left / moves, float(shift)


def _fit(
    truth: Truth, person: int, track: Track, shift: float
) -> tuple[Rigid, float, float, float] | None:
    """Return how a person lies on a track at some shift; None if they have too little in common.

    That is the pose; what remains, m RMS; how much the joints of the track move about their mean, m
    RMS; and a malus of 1 to 2: what remains counts so much more, the less of the track is covered.
    """
    rows = np.full(len(track.stamps), person)
    true = truth.positions_of(rows, track.stamps - round(shift * 1e9))
    known = np.asarray(~np.isnan(true + track.poses).any(axis=-1))  # (T, M)
    instants = known.any(axis=1)
    if instants.sum() < 3:
        return None
    try:
        pose = rigid_fit(true[known], track.poses[known])
    except RegistrationError:  # all on a line
        return None
    left = track.poses[known] - rotate(pose.xyzw, true[known]) - pose.translation
    moves = np.where(known[..., None], track.poses, np.nan)[:, known.any(axis=0)]
    moves -= np.nanmean(moves, axis=0)
    malus = 2 - float(instants.mean())
    return pose, _rms(left), _rms(moves[~np.isnan(moves[..., 0])]), malus


def _rms(vectors: Floats) -> float:
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=-1))))


def _left_m(truth: Truth, tracks: Mapping[int, Track]) -> float:
    """Median over true people and instants of the distance, m, to the nearest track."""
    nearest = []
    every = max(1, len(truth.stamps) // (2 * _INSTANTS))
    for stamp, people in zip(truth.stamps[::every], truth.positions[::every], strict=True):
        poses = [
            track.poses[k]
            for track in tracks.values()
            if abs(track.stamps[k := int(np.argmin(np.abs(track.stamps - stamp)))] - stamp) < 5e7
        ]
        present = ~np.isnan(people).all(axis=(1, 2))
        if poses and present.any():
            distances = skeleton_distances(people[present], np.stack(poses))
            nearest += np.where(np.isnan(distances), np.inf, distances).min(axis=1).tolist()
    return float(np.median(nearest)) if nearest else np.inf


def _refined(matches: Matches, found: Rigid) -> Rigid:
    """Return the pose that brings joints nearest, which were matched with the last one."""
    known = ~np.isnan(matches.true_poses + matches.poses).any(axis=-1)
    source, target = found.inverse().moved(matches.true_poses[known]), matches.poses[known]
    rotation, shift = robust_kabsch(source, target, np.ones(len(source)))
    return Rigid(from_matrix(rotation), shift)
