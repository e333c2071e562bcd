"""Who is who by where they are (Malaguti et al. 2019, section III-A).

Each track has a Kalman filter of its centroid's position and velocity on the floor; the cost of a
detection is the squared Mahalanobis distance of the state that it would lead to, and the Hungarian
algorithm minimises the sum.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np
from pydantic import Field

from hiros_mcap.events import Events
from hiros_mcap.params import Params
from hiros_mcap.skeletons import UNTRACKED, Floats, Frame, SkeletonModel

_STARTING_SPEED = 1.0
"""m/s, SD per axis of somebody who was just seen for the first time."""


class AssociateParams(Params):
    """Parameters of the association by centroids."""

    gate: float = Field(
        18.467,
        gt=0,
        description="Largest squared Mahalanobis distance of a match (epsilon): 99.9 % of a "
        "chi-squared distribution of 4 degrees of freedom, as in OpenPTrack; the paper gives none.",
    )
    position_noise: float = Field(
        0.1, gt=0, description="m, SD per axis of a detection's centroid about the person's."
    )
    acceleration: float = Field(
        3.0, gt=0, description="m/s2, SD per axis: how fast a person's walk changes."
    )
    max_gap: float = Field(
        1.5, gt=0, description="s without a detection after which a track ends (not in the paper)."
    )
    confirm_detections: int = Field(
        3,
        ge=1,
        description="Detections until a new track counts: OpenPTrack's number; the paper says 1.",
    )
    min_distance: float = Field(
        0.3,
        ge=0,
        description="m: a second body of a camera this near to a track is no new person "
        "(not in the paper; detectors see double).",
    )
    reorder: float = Field(
        1.0, ge=0, description="s: frames wait this long for older ones of slower cameras."
    )


@dataclass(slots=True)
class Centroid:
    """A track on the floor. Its two axes share one 2x2 covariance: nothing ever couples them."""

    name: int
    stamp: int
    x: float
    """m."""
    y: float
    vx: float
    """m/s."""
    vy: float
    p00: float
    """Variance of the position, m2."""
    p01: float
    p11: float
    """Variance of the velocity, m2/s2."""
    seen: int = 0
    """ns: when a detection was matched last."""
    detections: int = 1
    confirmed: bool = False

    @classmethod
    def at(cls, stamp: int, x: float, y: float, noise: float) -> Centroid:
        """Start a track at a detection."""
        return cls(UNTRACKED, stamp, x, y, 0.0, 0.0, noise**2, 0.0, _STARTING_SPEED**2, stamp)

    def predict(self, stamp: int, acceleration: float) -> None:
        """Carry on to another time, by constant velocity."""
        dt = (stamp - self.stamp) * 1e-9
        if dt <= 0:
            return
        self.x += dt * self.vx
        self.y += dt * self.vy
        noise = acceleration**2 / 30.0  # per second as much as white steps at 30 Hz
        self.p00 += dt * (2 * self.p01 + dt * self.p11) + noise * dt**3 / 3
        self.p01 += dt * self.p11 + noise * dt**2 / 2
        self.p11 += noise * dt
        self.stamp = stamp

    def cost(self, x: float, y: float, noise: float) -> float:
        """Squared Mahalanobis distance of the state that a detection would lead to (eq 2, 3).

        With the gain K = P H' / s, the difference of the states is K times the innovation, and
        its distance by P comes down to this.
        """
        return ((x - self.x) ** 2 + (y - self.y) ** 2) * self.p00 / (self.p00 + noise**2) ** 2

    def correct(self, x: float, y: float, noise: float) -> None:
        """Take a detection at the track's time."""
        gain0, gain1 = (p / (self.p00 + noise**2) for p in (self.p00, self.p01))
        dx, dy = x - self.x, y - self.y
        self.x, self.y = self.x + gain0 * dx, self.y + gain0 * dy
        self.vx, self.vy = self.vx + gain1 * dx, self.vy + gain1 * dy
        self.p11 -= gain1 * self.p01
        self.p01 *= 1 - gain0
        self.p00 *= 1 - gain0
        self.seen = self.stamp
        self.detections += 1


@dataclass(slots=True)
class _Associator:
    params: AssociateParams
    events: Events
    tracks: list[Centroid] = field(default_factory=list)
    next_name: int = 0

    def step(self, frame: Frame) -> Frame:
        """Give every detection of one message its id."""
        self._forget(frame.stamp)
        places = centroids(frame.positions).tolist()
        usable = [row for row, (x, _) in enumerate(places) if not math.isnan(x)]
        ids = np.full(frame.n_people, UNTRACKED, np.int32)
        match = self._match([places[row] for row in usable], frame.stamp)
        for row, found in zip(usable, match, strict=True):
            x, y = places[row]
            track = found or self._start(x, y, frame)
            if track is not None:
                ids[row] = self._name(track, frame)
        return frame.replace(ids=ids)

    def _forget(self, stamp: int) -> None:
        limit = round(self.params.max_gap * 1e9)
        for track in self.tracks:
            if stamp - track.seen > limit and track.confirmed:
                self.events.note(track.seen, "track lost", person=track.name)
        self.tracks = [track for track in self.tracks if stamp - track.seen <= limit]

    def _match(self, places: list[list[float]], stamp: int) -> list[Centroid | None]:
        """Track of each place, None for those that have none."""
        from hiros_mcap.kernels.assignment import assign

        noise, gate = self.params.position_noise, self.params.gate
        for track in self.tracks:
            track.predict(stamp, self.params.acceleration)
        cost = np.full((len(self.tracks), len(places)), np.inf)
        for i, track in enumerate(self.tracks):
            for j, (x, y) in enumerate(places):
                distance = track.cost(x, y, noise)
                if distance <= gate:
                    cost[i, j] = distance
        matched = [self.tracks[i] if i >= 0 else None for i in assign(cost).tolist()]
        for found, (x, y) in zip(matched, places, strict=True):
            if found is not None:
                found.correct(x, y, noise)
        return matched

    def _start(self, x: float, y: float, frame: Frame) -> Centroid | None:
        """Start a track, unless it is a second body of somebody who is there."""
        nearest = min((math.hypot(t.x - x, t.y - y) for t in self.tracks), default=math.inf)
        if nearest < self.params.min_distance:
            self.events.count("duplicate", frame.source)
            return None
        track = Centroid.at(frame.stamp, x, y, self.params.position_noise)
        self.tracks.append(track)
        return track

    def _name(self, track: Centroid, frame: Frame) -> int:
        """Id of a track, UNTRACKED until it is confirmed."""
        if not track.confirmed:
            if track.detections < self.params.confirm_detections:
                self.events.count("not confirmed", frame.source)
                return UNTRACKED
            track.confirmed, track.name = True, self.next_name
            self.next_name += 1
            self.events.note(frame.stamp, "track born", person=track.name, source=frame.source)
        return track.name


def centroids(positions: Floats) -> Floats:
    """(P, 2) Mean over the known markers of x and y, m, of bodies (P, M, 3); NaN without any."""
    known = np.asarray(~np.isnan(positions).any(axis=-1))
    total = np.where(known[:, :, np.newaxis], positions[..., :2], 0.0).sum(axis=1)
    count = known.sum(axis=1, keepdims=True)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def associate(
    frames: Iterable[Frame],
    model: SkeletonModel,
    params: AssociateParams | None = None,
    events: Events | None = None,
) -> Iterator[Frame]:
    """Give each detection the id of a person, message by message.

    Parameters
    ----------
    frames : detections in the fixed frame, whose z points up; ids are ignored.
    model : of the frames. params, events : parameters; where births, losses and counts go.

    Yields
    ------
    The frames, in the order of their times, with ids; UNTRACKED where a track is not confirmed.
    """
    from hiros_mcap.stages.time_order import in_time_order

    params = params or AssociateParams()
    associator = _Associator(params, Events() if events is None else events)
    for frame in in_time_order(frames, params.reorder):
        yield associator.step(frame)
