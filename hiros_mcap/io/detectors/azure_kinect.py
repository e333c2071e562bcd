"""Bodies of the Azure Kinect ROS driver: one sphere per joint in a MarkerArray.

The driver publishes a message per capture on ``body_tracking_data``, with the positions in metres
in the frame of the depth camera; one without markers if it sees nobody. The id of a marker is the
body's id times 100 plus the joint's number in the Body Tracking SDK
(``K4AROSDevice::getBodyMarker`` in src/k4a_ros_device.cpp). There are no confidences. Forks for
ROS 2 publish the same; some leave out joints that they do not trust, or delete the markers of the
capture before. Old SDKs have 26 joints: the same without hands, hand tips and thumbs, numbered
without gaps (``k4abt_joint_id_t`` in k4abttypes.h).

Nodes behind the driver add text and lines, which are left out, or number the joints of each body
from 0, mostly in a namespace of its own.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from hiros_mcap.io.detectors.body_models import body_model
from hiros_mcap.io.detectors.detector_reader import (
    DetectorMessage,
    DetectorReader,
    SeenPeople,
    nanoseconds,
    seen_people,
)
from hiros_mcap.skeletons import ORIENTATION, SECOND, Flags, Floats, Stamps
from hiros_mcap.wording import quantity

TOPIC = "body_tracking_data"
_SPHERE, _ADD = 2, 0
_DELETIONS = (2, 3)
"""Actions that take away a marker, or all."""
_LITTLE = b"\0\1"
_FIRST = 8  # byte of the first marker, behind the encapsulation and the number of markers
_LONGEST = 256  # bytes of a marker's namespace
_FACTOR = 100
"""Between the ids of two bodies."""
_OF_BODIES = 10_000 * _FACTOR
"""Between the ids of two bodies whose joints have the same ids."""
_FEWEST = 20
"""Joints of a body, on a topic of any name, that tell it from other spheres."""
_HANDS = np.array([8, 9, 10, 15, 16, 17])
_OLD = np.setdiff1d(np.arange(32), _HANDS)
"""Joint of today's SDK by its number in an SDK of 26 joints."""
_TELLING = 10
"""Links of which both ends are there, that tell the SDKs apart."""


class Spheres(NamedTuple):
    """N markers of a capture, and at last its spheres."""

    stamp: int
    """ns."""
    frame_id: str
    spaces: npt.NDArray[np.bytes_]
    """(N,) namespaces."""
    ids: Stamps
    """(N,)."""
    kinds: Stamps
    """(N, 2) types and actions."""
    poses: Floats
    """(N, 7) positions, m, and orientations x y z w."""


class AzureKinectMarkers(DetectorReader):
    """Any other MarkerArray is declined: its ids or its markers are of another kind."""

    types = ("visualization_msgs/MarkerArray",)

    def __init__(self) -> None:
        self._model = body_model("azure-kinect")
        self._known: set[str] = set()
        """Topics that have shown bodies."""
        self._numbers: dict[str, dict[tuple[bytes, int], int]] = {}
        """Of bodies by namespace and which one it is there, on topics whose ids do not tell."""
        self._old: dict[str, bool] = {}
        """Topic -> whether its joints are numbered as those of an SDK of 26."""
        self._bodies: Counter[str] = Counter()
        self._fewer: Counter[str] = Counter()
        """Bodies by topic: all, and those with fewer joints than the SDK has."""
        self._others: Counter[str] = Counter()
        """Markers by topic that are no spheres."""

    def read(self, message: DetectorMessage) -> Iterable[SeenPeople] | None:
        """Group the markers by body; a message without markers is of a camera that sees nobody.

        On a topic that may be of any use it tells nothing. Raises LogError for a message that is
        cut off.
        """
        data = bytes(message.cdr)
        known = message.topic in self._known or message.topic.rpartition("/")[2] == TOPIC
        empty = np.empty((0, self._model.n_markers, 3))
        nobody = [seen_people(self._model, message, "", empty)] if known else []
        if data[4:_FIRST] == bytes(4):  # no markers
            return nobody
        spheres = _added(_gathered(data) or _decoded(message.fields.markers))
        if not len(spheres.ids):
            return nobody
        is_sphere = spheres.kinds[:, 0] == _SPHERE
        spheres = self._numbered(message.topic, _chosen(spheres, is_sphere))
        if not self._are_joints(spheres, 1 if known else _FEWEST):
            self.hint = self.hint or _hint(message.topic, spheres)
            return None
        self._others[message.topic] += int((~is_sphere).sum())
        bodies, joints = self._joints(message.topic, spheres)
        people = seen_people(
            self._model,
            message,
            spheres.frame_id,
            joints[:, :, :3],
            stamp=spheres.stamp,
            ids=bodies.tolist(),
        )
        turned = (joints[:, :, 3:] != 0).any(axis=-1)
        people.frame.markers[turned, ORIENTATION] = joints[turned, 3:]
        return [people]

    def _are_joints(self, spheres: Spheres, fewest: int) -> bool:
        """Whether spheres have the ids of joints, and a body has ``fewest`` of them."""
        ids, n_bodies = spheres.ids, len(np.unique(spheres.ids // _FACTOR))
        return bool(
            len(ids) >= max(1, fewest * n_bodies)
            and len(np.unique(ids)) == len(ids)
            and (ids >= 0).all()
            and (ids % _FACTOR < self._model.n_markers).all()
        )

    def _numbered(self, topic: str, spheres: Spheres) -> Spheres:
        """Give bodies ids of their own where joints are numbered from 0 in each.

        Then namespaces tell them apart, or that a joint comes again.
        """
        if topic not in self._numbers and len(np.unique(spheres.ids)) == len(spheres.ids):
            return spheres
        numbers, seen, offsets = (
            self._numbers.setdefault(topic, {}),
            Counter[tuple[bytes, int]](),
            [],
        )
        for joint in zip(spheres.spaces.tolist(), spheres.ids.tolist(), strict=True):
            offsets.append(numbers.setdefault((joint[0], seen[joint]), len(numbers)))
            seen[joint] += 1
        return spheres._replace(ids=spheres.ids + _OF_BODIES * np.array(offsets, np.int64))

    def _joints(self, topic: str, spheres: Spheres) -> tuple[Stamps, Floats]:
        """Ids of the bodies (P,), and the poses of their joints (P, M, 7); NaN where one lacks."""
        bodies, rows = np.unique(spheres.ids // _FACTOR, return_inverse=True)
        joints = np.full((len(bodies), self._model.n_markers, 7), np.nan)
        joints[rows, spheres.ids % _FACTOR] = spheres.poses
        self._known.add(topic)
        self._bodies[topic] += len(bodies)
        self._fewer[topic] += int(np.isnan(joints[:, :, 0]).any(axis=1).sum())
        renumbered = np.full_like(joints, np.nan)
        renumbered[:, _OLD] = joints[:, : len(_OLD)]
        if not np.isnan(joints[:, len(_OLD) :]).all():
            self._old[topic] = False
        elif topic not in self._old:
            # By wrong numbers, links join joints that are far from each other.
            new, old = (self._lengths(each[:, :, :3]) for each in (joints, renumbered))
            if min(len(new), len(old)) < _TELLING:
                return bodies, joints
            self._old[topic] = bool(old.mean() < new.mean())
        return bodies, renumbered if self._old[topic] else joints

    def _lengths(self, positions: Floats) -> Floats:
        """(K,) lengths of the links of which both ends are there, m."""
        parents, children = self._model.links.T
        lengths = np.linalg.norm(positions[:, parents] - positions[:, children], axis=-1).ravel()
        return np.asarray(lengths[~np.isnan(lengths)])

    def remarks(self) -> Iterator[str]:
        """Say which bodies have fewer joints than the SDK knows."""
        for topic, n in self._fewer.items():
            if self._old.get(topic):
                yield f"{topic}: {len(_OLD)} joints a body, as old SDKs number them, without hands"
            elif n:
                yield (
                    f"{topic}: {quantity(n, 'skeleton')} of {self._bodies[topic]} with fewer than "
                    f"{self._model.n_markers} joints; the others are taken as not seen"
                )
        for topic in sorted(self._numbers.keys() & self._known):
            yield (
                f"{topic}: the ids of joints do not tell bodies apart; their namespaces do, or "
                "that a joint comes again"
            )
        for topic, n in self._others.items():
            if n:
                yield f"{topic}: {quantity(n, 'marker')} left out that are no spheres"


def _hint(topic: str, spheres: Spheres) -> str:
    """Return why spheres are no bodies; "" if there are none."""
    n, n_bodies = len(spheres.ids), len(np.unique(spheres.ids // _FACTOR))
    if not n:
        return ""
    return (
        f"{topic}: no bodies of the Azure Kinect driver: {n / n_bodies:.0f} markers a body, 32 are "
        f"read, or {_FEWEST} and more; ids should be body * {_FACTOR} + joint, the joint 0 to 31. "
        f"Fewer are read on a topic that ends in {TOPIC}"
    )


def _added(spheres: Spheres) -> Spheres:
    """Leave out the markers that only take others away."""
    return _chosen(spheres, ~np.isin(spheres.kinds[:, 1], _DELETIONS))


def _chosen(markers: Spheres, kept: Flags) -> Spheres:
    """Return some of the markers."""
    stamp, frame_id, *columns = markers
    return Spheres(stamp, frame_id, *(np.asarray(column)[kept] for column in columns))


def _decoded(markers: Sequence[Any]) -> Spheres:
    """Return the markers of a capture; the header is that of the first that adds something."""
    header = next((marker.header for marker in markers if marker.action == _ADD), markers[0].header)
    places = ((marker.pose.position, marker.pose.orientation) for marker in markers)
    return Spheres(
        nanoseconds(header.stamp),
        header.frame_id,
        np.array([marker.ns.encode() for marker in markers]),
        np.array([marker.id for marker in markers], np.int64),
        np.array([(marker.type, marker.action) for marker in markers], np.int64),
        np.array([(p.x, p.y, p.z, q.x, q.y, q.z, q.w) for p, q in places], np.float64),
    )


def _gathered(data: bytes) -> Spheres | None:
    """Find the markers of a capture, which all have one header; None where that does not hold.

    The header's bytes show where each marker begins. What stands behind the pose differs between
    the versions of ROS and is passed over. Decoding the fields takes fifty times as long.
    """
    if len(data) < _FIRST + 16 or data[:2] != _LITTLE:
        return None
    n, sec, nanosec, length = struct.unpack_from("<IiII", data, 4)
    header = data[_FIRST : _FIRST + 12 + length]
    if not n or length < 1 or len(header) < 12 + length:
        return None
    begins = [_FIRST]
    while (at := data.find(header, begins[-1] + len(header))) >= 0 and len(begins) <= n:
        begins.append(at)
    starts = np.array(begins, np.int64)
    if len(starts) != n or (starts % 4).any():
        return None
    content = np.frombuffer(data, np.uint8)
    name = starts + len(header) + -(len(header)) % 4
    if name[-1] + 4 > len(data):
        return None
    lengths = _numbers(content, name, "<u4", 1)[:, 0].astype(np.int64)
    ids = name + 4 + lengths + -lengths % 4
    poses = ids + 12 + -(ids + 12 - 4) % 8
    if lengths.max() > _LONGEST or poses.max() + 56 > len(data):
        return None
    heads = _numbers(content, ids, "<i4", 3).astype(np.int64)
    frame_id = str(header[12 : 11 + length], "utf-8", "replace")
    stamp = sec * SECOND + nanosec
    spans = zip((name + 4).tolist(), (name + 4 + lengths).tolist(), strict=True)
    spaces = np.array([data[begin:end] for begin, end in spans])  # the NUL at the end is dropped
    placed = _numbers(content, poses, "<f8", 7)
    return Spheres(stamp, frame_id, spaces, heads[:, 0], heads[:, 1:], placed)


def _numbers(content: npt.NDArray[np.uint8], places: Stamps, kind: str, n: int) -> Any:
    """(N, n) numbers of a kind that stand at N places."""
    size = n * np.dtype(kind).itemsize
    return np.ascontiguousarray(content[places[:, None] + np.arange(size)]).view(kind)
