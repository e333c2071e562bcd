"""Association of detections and tracks by centroids (Malaguti et al. 2019, III-A).

Each track has a Kalman filter of its centroid's position and velocity on the floor. The cost of a
detection is the squared Mahalanobis distance of the state that it would lead to. The Hungarian
algorithm minimises the sum.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np

from hiros_mcap.events import Events
from hiros_mcap.kernels.assignment import assign
from hiros_mcap.skeletons import UNTRACKED, Floats, Frame, SkeletonModel, Stamps, widened
from hiros_mcap.stages.bank import Bank
from hiros_mcap.stages.malaguti.malaguti_params import NOISE_RATE, STARTING_SPEED, AssociateParams
from hiros_mcap.stages.point_filter import correct, predict, seconds, white_acceleration


def associate(
    frames: Iterable[Frame], model: SkeletonModel, params: AssociateParams | None = None,
    events: Events | None = None,
) -> Iterator[Frame]:  # fmt: skip
    """Give each detection the id of a person, message by message.

    Parameters
    ----------
    frames : detections in time order in the fixed frame, whose z points up; ids are ignored.
    model : of the frames. params, events : parameters; where births, losses and counts go.

    Yields
    ------
    The frames with ids; UNTRACKED where a track is not confirmed.
    """
    params = params or AssociateParams()
    associator = _Associator(params, Events() if events is None else events)
    for frame in frames:
        states = {"markers": widened(frame.markers), "links": widened(frame.links)}
        yield associator.update(frame.replace(**states))  # with room for velocities


class Centroids(NamedTuple):
    """The filters K_i of T tracks."""

    stamps: Stamps  # (T,) time of the state, ns
    states: Floats  # (T, 2, 2) position, m, and velocity, m/s, on the floor
    covariances: Floats  # (T, 2, 2) of position and velocity along an axis
    detections: Stamps  # (T,) how many detections were associated


class _Associator:
    """The tracks, tentative until they are confirmed."""

    def __init__(self, params: AssociateParams, events: Events) -> None:
        self._params, self._events = params, events
        zero, none = np.zeros(0, np.int64), np.zeros((0, 2, 2))
        self._bank = Bank(Centroids(zero, none, none, zero), params.max_gap)
        self._tracks, self._people = itertools.count(), itertools.count()
        self._ids: dict[int, int] = {}  # confirmed track -> id

    def update(self, frame: Frame) -> Frame:
        """Give every detection of one message its id (III-A)."""
        self._end_lost_tracks(frame.stamp)
        tracks, rows = list(self._bank.rows), np.array(list(self._bank.rows.values()), np.int64)
        past, centroids = self._bank.past, centroids_of(frame)
        predict_tracks(past, rows, frame.stamp, self._params)  # z^, without a new detection
        cost = association_cost(past, rows, centroids, self._params)  # eq 2 and 3, epsilon
        matches = [tracks[k] if k >= 0 else None for k in assign(cost).tolist()]  # Hungarian
        for centroid, track in zip(centroids, matches, strict=True):
            if track is not None:
                correct_track(past, self._bank.row(track, frame.stamp), centroid, self._params)
        for d, track in enumerate(matches):
            if track is None:  # a person never seen before
                matches[d] = self._start(centroids[d], frame)
        ids = np.array([self._id(track, frame) for track in matches], np.int32)
        return frame.replace(ids=ids)

    def _end_lost_tracks(self, now: int) -> None:
        last_seen = self._bank.last_seen.copy()
        for track in self._bank.expire(now):
            if track in self._ids:
                person = self._ids.pop(track)
                self._events.note(last_seen[track], "track lost", person=person)

    def _start(self, centroid: Floats, frame: Frame) -> int | None:
        """Start a track, unless a person was reported twice."""
        if np.isnan(centroid[0]):
            return None
        places = self._bank.past.states[list(self._bank.rows.values()), 0]
        distances = np.hypot(*(places - centroid[:2]).T)
        if distances.min(initial=np.inf) < self._params.min_distance:
            self._events.count("duplicate", frame.source)
            return None
        track = next(self._tracks)
        row = self._bank.row(track, frame.stamp)
        start_track(self._bank.past, row, frame.stamp, centroid, self._params)
        return track

    def _id(self, track: int | None, frame: Frame) -> int:
        """Id of a track, UNTRACKED until it is confirmed."""
        if track is None:
            return UNTRACKED
        if track not in self._ids:
            row = self._bank.rows[track]
            if self._bank.past.detections[row] < self._params.confirm_detections:
                self._events.count("not confirmed", frame.source)
                return UNTRACKED
            person = self._ids[track] = next(self._people)
            self._events.note(frame.stamp, "track born", person=person, source=frame.source)
        return self._ids[track]


def centroids_of(frame: Frame) -> Floats:
    """(P, 3) Means of the known markers, m; NaN where none is known."""
    known = ~np.isnan(frame.positions[..., :1])
    total, n = np.where(known, frame.positions, 0.0).sum(axis=1), known.sum(axis=1)
    return np.where(n > 0, total / np.maximum(n, 1), np.nan)


def start_track(
    tracks: Centroids, row: int, now: int, centroid: Floats, params: AssociateParams
) -> None:
    """Start a track at a centroid (3,), m, at ``now``, ns."""
    tracks.states[row] = centroid[:2], (0.0, 0.0)
    tracks.covariances[row] = np.diag([params.position_noise**2, STARTING_SPEED**2])
    tracks.stamps[row], tracks.detections[row] = now, 1


def predict_tracks(tracks: Centroids, rows: Stamps, now: int, params: AssociateParams) -> None:
    """Carry the tracks in ``rows`` on to ``now``, ns."""
    dt = seconds(now - tracks.stamps[rows])
    process = white_acceleration(dt, params.acceleration**2 / NOISE_RATE)
    tracks.states[rows], tracks.covariances[rows] = predict(  # z^ of eq 2
        tracks.states[rows], tracks.covariances[rows], dt, process
    )
    tracks.stamps[rows] = now


def association_cost(
    tracks: Centroids, rows: Stamps, centroids: Floats, params: AssociateParams
) -> Floats:
    """(T, D) Cost of every track in ``rows`` and centroid (D, 3).

    The vector of eq 2 is the gain times the innovation. With the gain K = P H' / (p00 + r), its
    Mahalanobis distance by P is the squared innovation times p00 / (p00 + r)^2.
    """
    p00, r = tracks.covariances[rows, 0, 0], params.position_noise**2
    apart = centroids[:, :2] - tracks.states[rows, None, 0]
    distance = (apart**2).sum(axis=-1) * (p00 / (p00 + r) ** 2)[:, None]  # eq 2 and 3
    return np.where(distance <= params.gate, distance, np.inf)  # epsilon


def correct_track(tracks: Centroids, row: int, centroid: Floats, params: AssociateParams) -> None:
    """Correct a track by the centroid (3,) of its detection."""
    x, p, variance = tracks.states[row], tracks.covariances[row], params.position_noise**2
    tracks.states[row], tracks.covariances[row] = correct(x, p, centroid[:2], np.array(variance))
    tracks.detections[row] += 1
