"""Where the cameras stand: transforms of a log, or of a file, to one fixed frame.

ROS publishes a tree: every message on /tf_static and /tf gives the pose of a child frame in its
parent. hiros walks it in both directions, so that cameras may hang anywhere in it.

A static pose may change once in a while: somebody calibrates the cameras anew while the recorder
runs. The new pose counts from its log time on, for detections with that log time or a later one.
The stamp of a static transform would not do: most publishers write the time at which they started,
or 0, and repeat it.
"""

from __future__ import annotations

import math
import struct
from array import array
from bisect import bisect_right
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from hiros_mcap.body.foreign_cameras import read_calibration
from hiros_mcap.body.rotations import Rigid, to_matrix
from hiros_mcap.errors import ConfigError, LogError
from hiros_mcap.frames import Block
from hiros_mcap.kernels.array_types import joined
from hiros_mcap.kernels.people_rows import PoseArrays, move_messages
from hiros_mcap.outside import parse, read_text
from hiros_mcap.params import explain
from hiros_mcap.skeletons import Frame

_REMEDY = "mend the transforms, or pass others with --extrinsics FILE"
_DENORMALISED = 1e-3
_ZERO = 1e-6
_LISTED = 12
_SAME_M, _SAME_DEG = 1e-4, 0.01  # what rounding may change
_FARTHEST_M = 100.0  # nobody is seen by cameras that are so far apart


@dataclass(frozen=True, slots=True)
class Transform:
    """One sentence of a tf message: the pose of ``child`` in ``parent`` at ``stamp``."""

    stamp: int
    parent: str
    child: str
    translation: tuple[float, float, float]
    xyzw: tuple[float, float, float, float]


TimedPoses = Mapping[int, Rigid]
"""Poses of one frame by the log times, ns, from which on they hold; the first holds before, too."""


class PoseChange(NamedTuple):
    """Two poses of one frame in its parent, one after the other."""

    child: str
    parent: str
    log_time: int  # from when on the new pose counts, ns
    metres: float
    degrees: float

    @property
    def distance(self) -> str:
        """How far apart the poses are, in words."""
        return f"{100 * self.metres:.1f} cm and {self.degrees:.1f} degrees"


class _Edge:
    """The pose of a frame in its parent.

    Of a moving frame, samples at their stamps. Of a static one, the pose, and what it changed to
    at which log times.
    """

    def __init__(self, parent: str, *, static: bool, topic: str = "") -> None:
        self.parent = parent
        self.static = static
        self.topic = topic  # where it was published, if in a namespace
        self.changes: list[PoseChange] = []
        self._stamps = array("q")
        self._numbers = array("d")  # 7 per stamp: x y z w, x y z. An hour of /tf has millions.
        self._in_order = True

    @property
    def constant(self) -> bool:
        """Whether the pose never changes."""
        return self.static and len(self._stamps) < 2

    def fix(self, child: str, log_time: int, numbers: tuple[float, ...]) -> str:
        """Take note of a static pose, log times in order; return its contradiction, "" if none.

        Publishers repeat themselves. A pose that comes back was never replaced: then two
        publishers contradict each other.
        """
        new, count = Rigid(np.array(numbers[:4]), np.array(numbers[4:])), len(self._stamps)
        apart = [new.apart(self._pose(k)) for k in range(max(0, count - 2), count)]
        same = [metres < _SAME_M and degrees < _SAME_DEG for metres, degrees in apart]
        if same and same[-1]:
            return ""
        if apart:
            now = max(log_time, self._stamps[-1])
            change = PoseChange(child, self.parent, now, *apart[-1])
            if log_time <= self._stamps[-1] or any(same):
                then = "at one time" if log_time <= self._stamps[-1] else "in turns"
                return (
                    f"has two static transforms in {self.parent!r} {then} that disagree by "
                    f"{change.distance}: {_at(self._pose(-1))}; and {_at(new)}"
                )
            self.changes.append(change)
        self.add(log_time, numbers)
        return ""

    def add(self, stamp: int, numbers: tuple[float, ...]) -> None:
        self._in_order = self._in_order and (not self._stamps or stamp > self._stamps[-1])
        self._stamps.append(stamp)
        self._numbers.extend(numbers)

    def at(self, stamp: int, log_time: int) -> Rigid:
        """Pose at a time: linear and spherical between samples, the nearest one beyond them.

        A static pose holds until it changes.
        """
        if not self._in_order:
            self._sort()
        k = bisect_right(self._stamps, log_time if self.static else stamp)
        if k == 0 or k == len(self._stamps) or self.static:
            return self._pose(max(k - 1, 0))
        before, after = self._stamps[k - 1], self._stamps[k]
        return self._pose(k - 1).towards(self._pose(k), (stamp - before) / (after - before))

    def samples(self) -> Iterator[tuple[int, Rigid]]:
        """Yield every stamp, of a static pose the log time from which it holds, and pose."""
        for k, stamp in enumerate(self._stamps):
            yield stamp, self._pose(k)

    def _pose(self, k: int) -> Rigid:
        k %= len(self._stamps)
        numbers = np.array(self._numbers[7 * k : 7 * k + 7])
        return Rigid(numbers[:4], numbers[4:])

    def _sort(self) -> None:
        """Put the samples in order of time; of those of the same time, the last one stays."""
        rows = np.array(self._numbers).reshape(-1, 7)
        backwards = np.array(self._stamps)[::-1]
        stamps, last = np.unique(backwards, return_index=True)
        self._stamps = array("q", stamps.tobytes())
        self._numbers = array("d", rows[::-1][last].tobytes())
        self._in_order = True


def _at(pose: Rigid) -> str:
    translation, xyzw = (", ".join(f"{x:.3f}" for x in part) for part in reversed(pose))
    return f"translation ({translation}), xyzw ({xyzw})"


class TransformTree:
    """Poses of frames in one another.

    A fault of one frame (two parents, no rotation, a loop, static poses that contradict each other)
    is an error only for those who need that frame: a robot's tree may be full of frames that no
    camera hangs on.

    Parameters
    ----------
    begin : log time of the first detection, ns. Static transforms that are logged before it are
        all meant to count from the start, so they must agree.
    """

    def __init__(self, begin: int = 0) -> None:
        self._begin = begin
        self._edges: dict[str, _Edge] = {}
        self._faults: dict[str, str] = {}
        self._parents: set[str] = set()
        self._rivals: dict[str, list[str]] = {}  # child -> its parents, where it has several
        self._fixed: dict[tuple[str, str], Rigid] = {}
        self.normalised: Counter[str] = Counter()
        """Quaternions of a length off by more than 1e-3 that were put right, by child frame."""
        self.takes_namespaces = False
        """Whether transforms in a namespace count for frames without a global one. Otherwise they
        count for frames of which nothing else is known."""
        self.look_alikes: Sequence[str] = ()  # topics that may hold transforms, and are not read
        self.unheard = ""
        """Warning that static transforms were sent, but not kept; "" if there is none."""
        self.source = ""  # the file that the poses are from, "" if they are the log's
        self.clocks: Mapping[str, float] = {}
        """Camera -> seconds to add to its stamps, as the file says."""
        self.negated: Mapping[str, str] = {}
        """Camera -> axis of its detections whose sign is changed, as the file says."""
        self.renamed: dict[str, str] = {}
        """Name of a frame in the file -> the frame of the camera that it means."""
        self.remarks: list[str] = []
        """Notes: guesses about the names of frames, and entries of the file that are not used."""

    def __len__(self) -> int:
        return len(self._edges)

    @property
    def frames(self) -> list[str]:
        """Names of all frames."""
        return sorted(self._parents | self._edges.keys())

    def add(
        self, transform: Transform, *, static: bool, log_time: int = 0, namespace: str = ""
    ) -> None:
        """Take note of a transform; of static ones in the order of their log times, ns.

        ``namespace`` is the topic of a transform that is not on /tf_static or /tf. It does not
        count where there is a global one.
        """
        child, parent = transform.child.lstrip("/"), transform.parent.lstrip("/")
        edge = self._edges.get(child)
        if namespace and not self._takes_of_namespace(child):
            return
        numbers = self._checked(child, transform)
        if edge is None:
            edge = self._edges[child] = _Edge(parent, static=static, topic=namespace)
            self._parents.add(parent)
        if edge.parent != parent:
            self._add_rival(child, parent)
        elif edge.static != static:
            self._faults[child] = "is on /tf_static and on /tf"
        elif numbers and static:
            if fault := edge.fix(child, max(log_time, self._begin), numbers):
                self._faults.setdefault(child, fault)
        elif numbers:
            edge.add(transform.stamp, numbers)

    def _takes_of_namespace(self, child: str) -> bool:
        edge = self._edges.get(child)
        if edge is not None:
            return bool(edge.topic)
        return self.takes_namespaces or child not in self._parents

    def _add_rival(self, child: str, parent: str) -> None:
        """Take note that a frame has one more parent, which is a fault of it."""
        parents = self._rivals.setdefault(child, [self._edges[child].parent])
        if parent not in parents:
            parents.append(parent)
            self._parents.add(parent)
        count = "two" if len(parents) == 2 else "several"
        self._faults[child] = (
            f"has {count} parents, {_quoted(parents)}; a frame has one, so parent and child may be "
            "exchanged"
        )

    def _checked(self, child: str, transform: Transform) -> tuple[float, ...]:
        """Rotation of length 1 and translation; nothing, and a fault, if they make no sense."""
        length = math.hypot(*transform.xyzw)
        if not all(map(math.isfinite, (length, *transform.translation))):
            self._faults[child] = "has a transform that is not finite"
            return ()
        if length < _ZERO:
            self._faults[child] = "has a rotation of length 0"
            return ()
        if abs(length - 1) > _DENORMALISED:
            self.normalised[child] += 1
        return (*(x / length for x in transform.xyzw), *transform.translation)

    def root(self, frame: str) -> str:
        """Return the frame that everything above ``frame`` hangs on, itself when nothing is."""
        return self._path(frame)[-1]

    def common_root(self, frames: Iterable[str]) -> str:
        """Return the one root of all ``frames``; raises LogError when there are several."""
        by_root: dict[str, list[str]] = {}
        for frame in dict.fromkeys(frames):
            by_root.setdefault(self.root(frame), []).append(frame)
        if len(by_root) == 1:
            return next(iter(by_root))
        unread = "".join(f". {text}" for text in self._unread())
        if not self.frames:
            raise LogError(
                "the log has no /tf or /tf_static, so the camera poses are unknown; pass them with "
                f"--extrinsics cameras.toml, or find them with hiros calibrate people{unread}"
            )
        for text in self._exchanged(by_root):
            raise LogError(text)
        groups = "; ".join(
            f"{', '.join(sorted(names))} in {root}" for root, names in by_root.items()
        )
        raise LogError(
            f"no transforms connect the cameras' frames ({groups}); the log has transforms of "
            f"{_listing(self.frames)}. Record /tf_static, pass the camera poses with "
            f"--extrinsics FILE, or choose cameras with --topic{unread}"
        )

    def doubts(self, frames: Iterable[str]) -> list[str]:
        """Return why transforms that are there may not join ``frames``."""
        roots = {self._top(frame) for frame in frames}
        return [*self._exchanged(roots), *self._unread()]

    def _exchanged(self, roots: Collection[str]) -> Iterator[str]:
        """Yield which frames are children of several of the ``roots``."""
        for child, parents in self._rivals.items():
            if len(set(roots) & {self._top(parent) for parent in parents}) > 1:
                yield (
                    f"the frame {child!r} {self._faults[child]}: publish the cameras as children "
                    f"of {child!r}, or pass their poses with --extrinsics FILE"
                )

    def _unread(self) -> Iterator[str]:
        """Yield which topics have static transforms that nobody kept, or are not read."""
        if self.unheard:
            yield self.unheard
        if self.look_alikes:
            yield (
                f"Not read, though they look like transforms: {', '.join(self.look_alikes)}; hiros "
                "reads TFMessage on /tf_static and /tf, also in a namespace"
            )

    def _top(self, frame: str) -> str:
        """Return the root above a frame, "" where a fault is in between."""
        try:
            return self.root(frame)
        except LogError:
            return ""

    def joins(self, frames: Collection[str]) -> bool:
        """Whether all ``frames`` are known and hang on one root; a faulty one counts as joined."""
        try:
            roots = {self.root(frame) for frame in frames}
        except LogError:
            return True
        return len(roots) <= 1 and set(self.frames).issuperset(frames)

    def namespaces_above(self, frames: Iterable[str]) -> list[str]:
        """Return the topics in namespaces that give transforms of ``frames``, in order."""
        above = {name for frame in frames for name in self._path(frame)[:-1]}
        return sorted({self._edges[name].topic for name in above} - {""})

    def children_above(self, frames: Iterable[str]) -> set[str]:
        """Return which frames with a parent ``frames`` hang on, themselves included."""
        return {name for frame in frames for name in self._path(frame)[:-1]}

    @property
    def names(self) -> list[str]:
        """Names of all frames, as the file has them."""
        before = {new: old for old, new in self.renamed.items()}
        return [before.get(name, name) for name in self.frames]

    @property
    def children(self) -> list[str]:
        """Names of the frames that have a parent, in the order in which they came."""
        return list(self._edges)

    def remark(self, text: str) -> None:
        """Take note of something that a user should know, once."""
        if text not in self.remarks:
            self.remarks.append(text)

    def rename(self, old: str, new: str) -> None:
        """Give a frame another name, which no frame has yet."""
        if old in self._edges:
            self._edges = {new if k == old else k: edge for k, edge in self._edges.items()}
        for edge in self._edges.values():
            edge.parent = new if edge.parent == old else edge.parent
        self._parents = {new if name == old else name for name in self._parents}
        self._fixed.clear()
        self.renamed[old] = new

    @property
    def only_root(self) -> str:
        """The one frame that everything hangs on; "" if there are several or none."""
        with suppress(LogError):
            return self.common_root(self.frames)
        return ""

    def lookup(self, frame: str, fixed: str, stamp: int, log_time: int | None = None) -> Rigid:
        """Return the pose of ``frame`` in ``fixed`` at ``stamp``, ns, as logged by ``log_time``.

        Raises LogError when the frames are not joined, or by a faulty transform only.
        """
        key = (frame, fixed)
        if key in self._fixed:
            return self._fixed[key]
        down, up = self._path(frame), self._path(fixed)
        if down[-1] != up[-1]:
            raise LogError(
                f"there is no transform from the frame {frame!r} to {fixed!r}; known frames: "
                f"{_listing(self.frames)}. Check the names, or pass the camera poses with "
                "--extrinsics FILE"
            )
        while len(down) > 1 and len(up) > 1 and down[-2] == up[-2]:
            down.pop()
            up.pop()
        times = stamp, stamp if log_time is None else log_time
        pose = self._chain(up[:-1], times).inverse() @ self._chain(down[:-1], times)
        if all(self._edges[name].constant for name in down[:-1] + up[:-1]):
            self._fixed[key] = pose
        return pose

    def at_rest(self, frame: str, fixed: str) -> Rigid | None:
        """Return the pose of ``frame`` in ``fixed`` if it is known and never changes."""
        try:
            self.lookup(frame, fixed, 0)
        except LogError:
            return None
        return self._fixed.get((frame, fixed))

    def with_poses(self, poses: Mapping[str, TimedPoses], fixed: str) -> TransformTree:
        """Return the tree with other static poses of some frames in ``fixed``.

        A frame keeps its parent if that is joined to ``fixed``; it must be at rest then, and
        ``fixed`` must not hang on the frame itself.
        """
        tree = TransformTree(self._begin)
        tree.__dict__.update(self.__dict__)
        tree._edges, tree._parents = dict(self._edges), self._parents | {fixed}
        tree._faults = {name: fault for name, fault in self._faults.items() if name not in poses}
        tree._fixed = {}
        for name in sorted(poses, key=lambda name: len(tree._path(name))):
            edge = tree._edges.get(name)
            joined = edge is not None and tree.root(edge.parent) == tree.root(fixed)
            parent = edge.parent if edge is not None and joined else fixed
            above = tree.lookup(parent, fixed, 0).inverse()
            new = tree._edges[name] = _Edge(parent, static=True)
            for log_time, pose_of_time in sorted(poses[name].items()):
                pose = above @ pose_of_time
                new.add(log_time, (*pose.xyzw, *pose.translation))
            tree._fixed.clear()
        return tree

    def static_poses(self) -> Iterator[tuple[int, str, str, Rigid]]:
        """Yield log time (0 for the start), parent, child and pose of all static transforms."""
        for child, edge in self._edges.items():
            if edge.static and child not in self._faults:
                yield from ((time, edge.parent, child, pose) for time, pose in edge.samples())

    def changes_above(self, frames: Iterable[str]) -> list[PoseChange]:
        """Return how static poses between ``frames`` and their roots change, in order of time."""
        above = dict.fromkeys(name for frame in frames for name in self._path(frame)[:-1])
        changes = [change for name in above for change in self._edges[name].changes]
        return sorted(changes, key=lambda change: (change.log_time, change.child))

    def change_times(self, frames: Iterable[str]) -> list[int]:
        """Return the log times, ns, at which static poses between ``frames`` and roots change.

        Unlike :meth:`changes_above` they include changes that :meth:`with_poses` brought.
        """
        above = {name for frame in frames for name in self._path(frame)[:-1]}
        static = (self._edges[name] for name in above if self._edges[name].static)
        return sorted({time for edge in static for time, _ in list(edge.samples())[1:]})

    def _chain(self, names: list[str], times: tuple[int, int]) -> Rigid:
        """Pose of the first frame in the parent of the last, at a stamp and a log time."""
        pose = Rigid.identity()
        for name in names:
            pose = self._edges[name].at(*times) @ pose
        return pose

    def _path(self, frame: str) -> list[str]:
        """Return the frame, its parent, and so on up to a root."""
        path = [frame.lstrip("/")]
        while path[-1] in self._edges:
            name = path[-1]
            if name in self._faults:
                raise LogError(f"the frame {name!r} {self._faults[name]}; {_REMEDY}")
            path.append(self._edges[name].parent)
            if path[-1] in path[:-1]:
                loop = " -> ".join(path[path.index(path[-1]) :])
                raise LogError(f"the transforms form a loop: {loop}; {_REMEDY}")
        return path


def _quoted(names: Sequence[str]) -> str:
    """Return two or more names as a list in words."""
    return f"{', '.join(map(repr, names[:-1]))} and {names[-1]!r}"


def _listing(names: list[str]) -> str:
    if not names:
        return "none"
    more = f" and {len(names) - _LISTED} more" if len(names) > _LISTED else ""
    return ", ".join(names[:_LISTED]) + more


_MOST_ROWS, _LEAST_ROW = 2000, 64
"""Frames of a message, which all robots, cameras and people of a room do not have; bytes of one."""


def parse_tf(data: bytes | bytearray | memoryview) -> list[Transform]:
    """Read a tf2_msgs/TFMessage in CDR; raises LogError for damaged bytes.

    Written by hand because the generic library takes a millisecond for each, and a minute of /tf
    has thousands.
    """
    try:
        order = {b"\0\0": ">", b"\0\1": "<"}[bytes(data[:2])]
        content = memoryview(data)[4:]
        (count,) = struct.unpack_from(order + "I", content, 0)
        if _MOST_ROWS < count <= len(content) // _LEAST_ROW:
            raise LogError(f"a tf message has {count} frames; at most {_MOST_ROWS} are read")
        at, transforms = 4, []
        for _ in range(count):
            transform, at = _parse_transform(content, at, order)
            transforms.append(transform)
    except (KeyError, struct.error, UnicodeDecodeError, ValueError):
        raise LogError("a tf message is damaged or not plain CDR") from None
    if len(content) - at > 3:
        raise LogError("a tf message is longer than its content")
    return transforms


def _parse_transform(content: memoryview, at: int, order: str) -> tuple[Transform, int]:
    at += -at % 4
    sec, nanosec = struct.unpack_from(order + "iI", content, at)
    parent, at = _parse_string(content, at + 8, order)
    child, at = _parse_string(content, at, order)
    at += -at % 8
    numbers = struct.unpack_from(order + "7d", content, at)
    stamp = sec * 1_000_000_000 + nanosec
    return Transform(stamp, parent, child, numbers[:3], numbers[3:]), at + 56


def _parse_string(content: memoryview, at: int, order: str) -> tuple[str, int]:
    at += -at % 4
    (length,) = struct.unpack_from(order + "I", content, at)
    raw = bytes(content[at + 4 : at + 4 + length])
    if not length or len(raw) != length or raw[-1]:
        raise ValueError("a string without its final NUL")
    return str(raw[:-1], "utf-8"), at + 4 + length


class CameraEntry(BaseModel):
    """One pose in a file of cameras, and what a calibration tells about it."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, strict=True)

    frame: Annotated[str, Field(min_length=1)]
    parent: Annotated[str, Field(min_length=1)] = "world"  # frame that the pose is in
    translation: Annotated[list[float], Field(min_length=3, max_length=3)]
    quaternion_xyzw: Annotated[list[float], Field(min_length=4, max_length=4)]
    negate: Literal["", "x", "y", "z"] = ""
    """Axis of its detections whose sign is changed, because they are left-handed."""
    verdict: str = ""  # good, doubtful, ...; "" in a file that somebody else wrote
    reason: str = ""  # why it is doubtful, "" otherwise
    error_deg: float | None = None
    error_mm: float | None = None
    residual_mm: float | None = None

    @classmethod
    def of(cls, frame: str, pose: Rigid) -> CameraEntry:
        """Return the entry of a frame with a pose in the room."""
        place, turn = pose.translation.tolist(), pose.xyzw.tolist()
        return cls(frame=frame, translation=place, quaternion_xyzw=turn)

    @property
    def pose(self) -> Rigid:
        """In the parent."""
        return Rigid(np.array(self.quaternion_xyzw), np.array(self.translation))

    @property
    def errors(self) -> tuple[float, ...]:
        """Standard errors, degrees and mm, and residual, mm; NaN where the file has none."""
        errors = self.error_deg, self.error_mm, self.residual_mm
        return tuple(math.nan if error is None else error for error in errors)


class RoomTable(BaseModel):
    """The table ``[room]`` of a file with poses, as ``hiros plan`` writes it."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    area: tuple[float, float, float, float]  # least x and y, greatest x and y, m
    fov: tuple[float, float]  # field of view of each camera, across and upright, degrees
    range: tuple[float, float]  # nearest and farthest depth that a camera sees, m


class _Extrinsics(BaseModel):
    """An extrinsics file."""

    model_config = ConfigDict(extra="forbid")

    camera: Annotated[list[CameraEntry], Field(min_length=1)]
    clock: dict[str, Annotated[float, Field(allow_inf_nan=False)]] = {}
    room: RoomTable | None = None


def read_extrinsics(path: str | Path) -> TransformTree:
    """Read the cameras' poses from a TOML or JSON file.

    ::

        [[camera]]
        frame = "camera_0"                        # as in the detections' headers
        parent = "world"                          # the default
        translation = [0.0, 0.0, 2.5]             # m, position of the camera in its parent
        quaternion_xyzw = [0.0, 0.0, 0.0, 1.0]
        negate = "x"                              # if its detections have left-handed axes

    The calibrations of other programs are read, too; see :mod:`.foreign_cameras`.

    What a calibration tells about a pose may follow it; see :func:`read_camera_entries`. A table
    ``[clock]`` may follow, too: seconds to add to the stamps of each camera.

    Raises ConfigError naming the file and the key.
    """
    file = _extrinsics(path)
    cameras, tree = file.camera, TransformTree()
    tree.source, tree.clocks = str(path), file.clock
    tree.negated = {camera.frame: camera.negate for camera in cameras if camera.negate}
    for camera in cameras:
        _add_camera(tree, camera, f"{path}: {camera.frame}")
    for camera in cameras:
        try:
            tree.root(camera.frame)
        except LogError as error:
            raise ConfigError(f"{path}: {error.fault}") from None
    return tree


def read_room(path: str | Path) -> RoomTable | None:
    """Read the table ``[room]`` of a file with poses; raises as :func:`read_extrinsics` does."""
    return _extrinsics(path).room


def read_camera_entries(path: str | Path) -> list[CameraEntry]:
    """Read what a file tells about each pose; raises as :func:`read_extrinsics` does."""
    return _extrinsics(path).camera


def _extrinsics(path: str | Path) -> _Extrinsics:
    """Read a file with the cameras' poses; raises ConfigError naming the file and the key."""
    path = Path(path)
    calibrated = read_calibration(path)
    if entries := [CameraEntry.of(c.name, c.pose) for c in calibrated if c.pose is not None]:
        return _Extrinsics(camera=entries)
    if calibrated:
        raise ConfigError(f"{path}: has no poses of cameras; it tells their lenses only")
    raw = parse(read_text(path), "JSON" if path.suffix.lower() == ".json" else "TOML", path)
    try:
        return _Extrinsics.model_validate(raw)
    except ValidationError as error:
        where, message = explain(error)
        raise ConfigError(f"{path}: {'.'.join(where) or 'file'}: {message}") from None


def _add_camera(tree: TransformTree, camera: CameraEntry, where: str) -> None:
    length = math.hypot(*camera.quaternion_xyzw)
    if abs(length - 1) > _DENORMALISED:
        raise ConfigError(f"{where}: quaternion_xyzw: its length is {length:g}, not 1")
    if camera.frame in tree._edges:
        raise ConfigError(f"{where}: this frame occurs twice")
    numbers: Any = tuple(camera.translation), tuple(camera.quaternion_xyzw)
    transform = Transform(0, camera.parent, camera.frame, *numbers)
    tree.add(transform, static=True)


def transform_to_fixed(
    frames: Iterable[Frame], tree: TransformTree, fixed_frame: str
) -> Iterator[Frame]:
    """Express frames in the fixed frame (Hi-ROS eq. 5); those that already are pass unchanged.

    Where a camera moves, its pose is that of the frame's stamp; where it was calibrated anew, that
    of the frame's log time. A moving camera's own motion is not added to
    the velocities and accelerations that it measured: they stay relative to the camera, in the
    directions of the fixed frame.

    Raises LogError for a frame that no transform joins to the fixed frame.
    """
    mover = Mover(tree, fixed_frame)
    for frame in frames:
        is_there = frame.frame_id == fixed_frame
        yield frame if is_there else mover.move_block(Block.of(frame)).frame(0)


class Mover:
    """Expresses blocks in the fixed frame; see :func:`transform_to_fixed`."""

    def __init__(self, tree: TransformTree, fixed_frame: str) -> None:
        self._tree = tree
        self._fixed = fixed_frame
        self._prepared: dict[str, tuple[Rigid, PoseArrays]] = {}

    def move_block(self, block: Block) -> Block:
        """Return a block in the fixed frame, itself if it already is."""
        is_moving = np.array([name != self._fixed for name in block.names])[block.frame_ids]
        if not is_moving.any():
            return block
        # Who is nowhere needs no transform: a message of nobody may name any frame, or none.
        frames = np.flatnonzero(is_moving & (block.sizes > 0))
        people, poses = block.people.copy(), list[PoseArrays]()
        for i in frames.tolist():
            stamp, log_time = int(block.stamps[i]), int(block.log_times[i])
            poses.append(self._pose(block.names[block.frame_ids[i]], stamp, log_time))
        if poses:
            move_messages(joined(poses), block.rows[frames], people)
        names, fixed = (*block.names, self._fixed), np.full(len(block), len(block.names))
        return replace(block, people=people, names=names, frame_ids=fixed)

    def _pose(self, name: str, stamp: int, log_time: int) -> PoseArrays:
        pose = self._tree.lookup(name, self._fixed, stamp, log_time)
        prepared = self._prepared.get(name)
        if prepared is None or prepared[0] is not pose:
            prepared = self._prepared[name] = (pose, pose_arrays([pose]))
        return prepared[1]


def pose_arrays(poses: Sequence[Rigid]) -> PoseArrays:
    """Return K poses as the kernels take them."""
    xyzw = np.array([pose.xyzw for pose in poses], np.float64).reshape(-1, 4)
    matrices = np.array([to_matrix(pose.xyzw) for pose in poses], np.float64).reshape(-1, 3, 3)
    shifts = np.array([pose.translation for pose in poses], np.float64).reshape(-1, 3)
    return PoseArrays(xyzw, matrices, shifts)


def same_place(poses: Mapping[str, Rigid]) -> list[list[str]]:
    """Return groups of names whose poses are the same to the rounding."""
    groups: list[list[str]] = []
    for name, pose in poses.items():
        for group in groups:
            metres, degrees = poses[group[0]].apart(pose)
            if metres < _SAME_M and degrees < _SAME_DEG:
                group.append(name)
                break
        else:
            groups.append([name])
    return [group for group in groups if len(group) > 1]


def far_apart(poses: Mapping[str, Rigid]) -> dict[str, float]:
    """Return the cameras that are so far from all others that their poses are not in m, and how."""
    places = np.array([pose.translation for pose in poses.values()]).reshape(-1, 3)
    distances = np.linalg.norm(places[:, None] - places, axis=-1)
    np.fill_diagonal(distances, np.inf)
    nearest = dict(zip(poses, distances.min(axis=1, initial=np.inf).tolist(), strict=True))
    return {name: apart for name, apart in nearest.items() if _FARTHEST_M < apart < np.inf}
