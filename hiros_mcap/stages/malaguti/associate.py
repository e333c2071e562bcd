"""Association of detections and tracks by centroids (Malaguti et al. 2019, III-A).

Each track has a Kalman filter of its centroid's position and velocity on the floor. The cost of a
detection is the squared Mahalanobis distance of the state that it would lead to. The Hungarian
algorithm minimises the sum.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator

import numpy as np

from hiros_mcap.events import Events
from hiros_mcap.kernels.array_types import settings_of
from hiros_mcap.kernels.assignment import assign
from hiros_mcap.skeletons import UNTRACKED, Floats, Frame, SkeletonModel, widened
from hiros_mcap.stages.bank import Bank
from hiros_mcap.stages.malaguti import centroid_filter as kernels
from hiros_mcap.stages.malaguti.malaguti_params import AssociateParams


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


class _Associator:
    """The tracks, tentative until they are confirmed."""

    def __init__(self, params: AssociateParams, events: Events) -> None:
        self._params, self._events = params, events
        self._bank = Bank(kernels.Centroids.empty(), params.max_gap)
        self._settings = settings_of(kernels.CentroidSettings, params)
        self._tracks, self._people = itertools.count(), itertools.count()
        self._ids: dict[int, int] = {}
        """Confirmed track -> id."""

    def update(self, frame: Frame) -> Frame:
        """Give every detection of one message its id (III-A)."""
        self._end_lost_tracks(frame.stamp)
        settings, past = self._settings, self._bank.past
        tracks, rows = list(self._bank.rows), np.array(list(self._bank.rows.values()), np.int64)
        centroids, cost = np.empty((frame.n_people, 3)), np.empty((len(rows), frame.n_people))
        kernels.find_centroids(frame.markers, centroids)
        kernels.predict_tracks(past, rows, frame.stamp, settings)  # z^, without a new detection
        kernels.association_cost(past, rows, centroids, settings, cost)  # eq 2 and 3, epsilon
        matches = [tracks[k] if k >= 0 else None for k in assign(cost).tolist()]  # Hungarian
        seen = [-1 if k is None else self._bank.row(k, frame.stamp) for k in matches]
        kernels.correct_tracks(past, np.array(seen, np.int64), centroids, settings)
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
        kernels.start_track(self._bank.past, row, frame.stamp, centroid, self._settings)
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
