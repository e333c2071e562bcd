"""One Kalman filter per person, updated by every camera's message (Malaguti 2019, III-B to III-D).

Nothing is buffered: each message moves its people at once, whenever it comes. A detection counts by
its confidence, and less if it lies farther from the prediction than others lately did.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from operator import attrgetter

import numpy as np

from hiros_mcap.events import TOO_LATE, Events
from hiros_mcap.kernels.array_types import settings_of
from hiros_mcap.skeletons import UNTRACKED, Floats, Frame, People, SkeletonModel, Stamps
from hiros_mcap.stages.bank import Bank
from hiros_mcap.stages.malaguti import joint_filter
from hiros_mcap.stages.malaguti.centroid_filter import find_centroids
from hiros_mcap.stages.malaguti.malaguti_params import KalmanParams

_PEOPLE = attrgetter(*People._fields)


def kalman(
    frames: Iterable[Frame], model: SkeletonModel, params: KalmanParams | None = None,
    events: Events | None = None, fixed_frame: str = "",
    cameras: Mapping[str, Floats] | None = None,
) -> Iterator[Frame]:  # fmt: skip
    """Fuse tracked detections, one message at a time (Malaguti 2019, III-B to III-D).

    Parameters
    ----------
    frames : with ids, in the fixed frame, in the order of their times. A frame that is older than
        the one before is counted and left out.
    model : of the frames. params, events : parameters; where counts go.
    fixed_frame : source of the output; empty = that of the frames.
    cameras : source -> (3,) position, m; for ``range_noise``.

    Yields
    ------
    Everybody detected within ``hold``, at the time of each message or at ``rate``, with velocities.
    Link orientations and confidences are those of the person's newest detection.
    """
    fusion = _Fusion(model, params or KalmanParams(), fixed_frame, cameras or {})
    events = Events() if events is None else events
    newest = 0
    for frame in frames:
        if frame.stamp < newest:
            events.count(TOO_LATE, frame.source)
            continue
        newest = frame.stamp
        for due in fusion.due_times(frame.stamp):
            yield fusion.people_at(due, frame)
        events.count("outlier", frame.source, fusion.update(frame))
        if not fusion.params.rate:
            yield fusion.people_at(frame.stamp, frame)


class _Fusion:
    """The filters of all people."""

    def __init__(
        self, model: SkeletonModel, params: KalmanParams, fixed_frame: str,
        cameras: Mapping[str, Floats],
    ) -> None:  # fmt: skip
        self.params, self._model = params, model
        self._fixed, self._cameras = fixed_frame, cameras
        empty = joint_filter.FilteredPeople.empty(model.n_markers, model.n_links, params.history)
        self._bank = Bank(empty, params.max_gap)
        self._settings = settings_of(joint_filter.JointFilterSettings, params)
        self._due = 0

    def update(self, frame: Frame) -> int:
        """Predict and correct everybody whom a message shows; return how many joints are outliers.

        The kernel has the steps of sections III-B to III-D in their order.
        """
        self._bank.expire(frame.stamp)
        rows = [
            -1 if person == UNTRACKED else self._bank.row(person, frame.stamp)
            for person in frame.ids.tolist()
        ]
        return int(
            joint_filter.update(
                self._bank.past, People(*_PEOPLE(frame)), np.array(rows, np.int64), frame.stamp,
                self._range_variances(frame), self._settings,
            )
        )  # fmt: skip

    def _range_variances(self, frame: Frame) -> Floats:
        """(P,) Variance that the distance from the camera adds, m2, as in OpenPTrack."""
        if not self.params.range_noise or frame.source not in self._cameras:
            return np.zeros(frame.n_people)
        centroids = np.empty((frame.n_people, 3))
        find_centroids(frame.markers, centroids)
        distances = ((centroids - self._cameras[frame.source]) ** 2).sum(axis=1)
        return np.asarray((self.params.range_noise * np.nan_to_num(distances)) ** 2)

    def due_times(self, now: int) -> Iterator[int]:
        """Yield the times before ``now``, ns, at which a fixed rate wants a result."""
        if self.params.rate:
            self._due = self._due or now
            while self._due < now:
                yield self._due
                self._due += round(1e9 / self.params.rate)

    def people_at(self, stamp: int, cause: Frame) -> Frame:
        """Return everybody who was detected lately, predicted to ``stamp``, ns."""
        hold, last_seen = self.params.hold * 1e9, self._bank.last_seen
        people = sorted(p for p, seen in last_seen.items() if stamp - seen <= hold)
        fixed = self._fixed or cause.frame_id
        out = Frame.empty(
            len(people), self._model, stamp=stamp, log_time=cause.log_time, source=fixed,
            frame_id=fixed,
        )  # fmt: skip
        out.ids[:] = people
        rows: Stamps = np.array([self._bank.rows[person] for person in people], np.int64)
        joint_filter.write(self._bank.past, rows, stamp, People(*_PEOPLE(out)))
        return out
