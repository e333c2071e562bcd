"""Messages of ROS's standard types from a log of any kind, and images of them as arrays.

A log of skeletons is read by :mod:`hiros_mcap.io.log`, which is much faster.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

import hiros_schemas
from hiros_mcap.body.intrinsics import COUNTS, FISHEYE, PLUMB_BOB, Intrinsics, opencv
from hiros_mcap.errors import LogError, naming
from hiros_mcap.io.bag_files import files_of
from hiros_mcap.io.container import McapReader
from hiros_mcap.io.joining import Part, channels_in, messages_in, open_part
from hiros_mcap.io.ros_cdr import Bytes as Cdr
from hiros_mcap.io.ros_cdr import RosMessage, decoder_of, ros2_types
from hiros_mcap.skeletons import SECOND, Floats

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
POINT = "geometry_msgs/msg/PointStamped"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
VIDEO = "foxglove_msgs/msg/CompressedVideo"
_VIDEO_TEXT = "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format\n"
KINDS = (
    *(IMAGE, COMPRESSED_IMAGE, VIDEO, CAMERA_INFO, POINT, TRANSFORMS),
    hiros_schemas.UNCERTAINTY,
)
"""The types that can be read; their definitions are the same in every release of ROS 2."""


Reader = Callable[[Collection[str]], Iterator[RosMessage]]
"""Yields the messages of some topics in the order of their log times."""


class RosMessages:
    """The messages of an open log; made by :func:`open_messages`.

    Attributes
    ----------
    types : topic -> type of its messages, of those in ``KINDS``. read : see :data:`Reader`.
    """

    def __init__(self, types: Mapping[str, str], read: Reader, store: Any) -> None:
        self.types, self.read, self._store = types, read, store

    def decode(self, message: RosMessage) -> Any:
        """Return a message's fields as attributes, arrays as numpy arrays.

        Raises LogError for damaged bytes.
        """
        with naming(None, message.topic):
            return decoder_of(self._store, message.type)(message.data)


def _of_files(parts: Sequence[Part], store: Any) -> RosMessages:
    """Return those of the files of a recording, in their order."""
    kinds = {name: kind for kind in KINDS for name in (kind, kind.replace("/msg/", "/"))}
    chosen = [
        [i for i in channels_in(part) if i.encoding in ("cdr", "ros1") and i.schema in kinds]
        for part in parts
    ]

    def read(topics: Collection[str]) -> Iterator[RosMessage]:
        for part, infos in zip(parts, chosen, strict=True):
            for info, time, data in messages_in(part, [i for i in infos if i.topic in topics]):
                kind, is_old = kinds[info.schema], info.encoding == "ros1"
                cdr = store.ros1_to_cdr(data, kind) if is_old else data
                yield RosMessage(info.topic, kind, time, cdr)

    return RosMessages({i.topic: kinds[i.schema] for infos in chosen for i in infos}, read, store)


@contextmanager
def open_messages(path: Path | McapReader) -> Iterator[RosMessages]:
    """Open an MCAP file, also one that is open, a ROS 1 bag, a SQLite bag or a rosbag2 folder.

    Raises LogError if it cannot be read.
    """
    ours = hiros_schemas.UNCERTAINTY
    store = ros2_types({ours: hiros_schemas.text(ours), VIDEO: _VIDEO_TEXT})
    with ExitStack() as stack:
        if isinstance(path, McapReader):
            yield _of_files([path], store)
        else:
            parts = [stack.enter_context(open_part(part)) for part in files_of(path).parts]
            yield _of_files(parts, store)


Bytes = npt.NDArray[np.uint8]


class FilmFrame(NamedTuple):
    """An image of a log, or a frame of its video."""

    frame_id: str
    stamp: int  # ns
    log_time: int  # ns
    format: str  # as the message names it; "" of an image that is not compressed
    data: bytes  # the compressed image or frame
    pixels: Bytes | None = None  # (H, W, 3) blue, green, red of an image that is not compressed
    is_video: bool = False


def read_pictures(
    messages: RosMessages, unread: Counter[tuple[str, str, str]]
) -> Iterator[FilmFrame]:
    """Yield the colour images, or frames of a video, of one topic for each coordinate frame.

    Those in other encodings, but for depths, are counted in ``unread`` by coordinate frame, topic
    and encoding. Raises LogError for a damaged one.
    """
    kinds, topics = (IMAGE, COMPRESSED_IMAGE, VIDEO), dict[str, str]()
    for raw in messages.read([t for t, kind in messages.types.items() if kind in kinds]):
        message, is_video = messages.decode(raw), raw.type == VIDEO
        head = message if is_video else message.header
        stamp, frame_id = head.timestamp if is_video else head.stamp, head.frame_id
        if not (message.format in VIDEO_CODECS if is_video else is_colour(message)):
            if is_video or not is_depth(message):
                unread[frame_id, raw.topic, getattr(message, "encoding", "") or message.format] += 1
            continue
        if topics.setdefault(frame_id, raw.topic) != raw.topic:
            continue
        times = stamp.sec * SECOND + stamp.nanosec, raw.log_time
        if raw.type == IMAGE:
            with naming(None, raw.topic):
                pixels = colour_image(message)
            yield FilmFrame(frame_id, *times, "", b"", pixels)
        else:
            data = bytes(message.data)
            yield FilmFrame(frame_id, *times, message.format, data, is_video=is_video)


VIDEO_CODECS = ("h264", "h265", "vp9", "av1")
"""Formats of foxglove's CompressedVideo."""
CHANNELS = {
    "bgr8": (0, 1, 2),
    "8UC3": (0, 1, 2),
    "rgb8": (2, 1, 0),
    "bgra8": (0, 1, 2, 3),
    "8UC4": (0, 1, 2, 3),
    "rgba8": (2, 1, 0, 3),
}
"""Encoding of a colour image -> where blue, green and red are."""
_DEPTHS = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
_CONFIG_BYTES = 12
"""Before the picture of a compressedDepth image: its kind, and two numbers that scale it."""


def intrinsics_of(info: Any, topic: str) -> Intrinsics:
    """Read the CameraInfo of a topic; raises LogError if the lens is not usable."""
    name = info.distortion_model or PLUMB_BOB
    model = FISHEYE if name == "fisheye" else name
    distortion = np.asarray(info.d, np.float64)
    if len(distortion) not in COUNTS.get(model, ()) or not np.isfinite(distortion).all():
        known = ", ".join(COUNTS)
        n = np.isfinite(distortion).sum()
        fault = f"its CameraInfo has {n} coefficients of the lens model {name!r}"
        raise LogError(f"{fault}; hiros reads {known}", topic=topic)
    matrix = np.asarray(info.k, np.float64).reshape(3, 3)
    lens = Intrinsics((int(info.width), int(info.height)), matrix, distortion, model)
    if lens.fault:
        raise LogError(f"its CameraInfo {lens.fault}", topic=topic)
    return lens


_STAMPED = 12
"""Bytes of a message before what is the same in every CameraInfo of a lens."""
_ZOOM = 0.02
"""Share of a focal length by which no focusing changes it."""


class SeenLenses:
    """What messages of CameraInfo tell.

    Attributes
    ----------
    lenses : the first lens of each optical frame.
    changes : how it changes later, if it does, as a warning.
    faults : why a frame has no lens, though there is CameraInfo of it.
    """

    def __init__(self) -> None:
        self.lenses: dict[str, Intrinsics] = {}
        self.changes: dict[str, str] = {}
        self.faults: dict[str, str] = {}
        self._firsts: dict[str, Intrinsics] = {}
        self._latest: dict[str, tuple[bytes, int]] = {}
        """Topic -> content, and when another one is looked at: an autofocus changes it always."""

    def take(self, topic: str, log_time: int, data: Cdr, decode: Callable[[], Any]) -> None:
        """Take a message, which is decoded if it tells something new."""
        content, due = self._latest.get(topic, (b"", 0))
        if log_time < due or bytes(data[_STAMPED:]) == content:
            return
        self._latest[topic] = bytes(data[_STAMPED:]), log_time + SECOND
        with suppress(LogError):  # damaged
            info = decode()
            name = info.header.frame_id
            try:
                lens = intrinsics_of(info, topic)
            except LogError as error:
                self.faults[name] = str(error)
                return
            self.faults.pop(name, None)
            if topic not in self._firsts:
                self._firsts[topic] = self.lenses[name] = lens
            elif name not in self.changes and (text := _change(self._firsts[topic], lens)):
                self.changes[name] = (
                    f"{topic}: the lens of {name} changes, {text}; hiros takes the first one "
                    "throughout, so split the log there"
                )


def _change(first: Intrinsics, lens: Intrinsics) -> str:
    """Say how a lens differs from the first one; "" if that is a detail of focusing."""
    if lens.size != first.size:
        return "its image from {} x {} to {} x {} px".format(*first.size, *lens.size)
    if abs(lens.focal - first.focal) > _ZOOM * first.focal:
        return f"its focal length from {first.focal:.0f} to {lens.focal:.0f} px"
    return ""


def is_depth(message: Any) -> bool:
    """Whether an Image or CompressedImage holds depths."""
    if hasattr(message, "encoding"):
        return message.encoding in _DEPTHS
    return "compressedDepth" in message.format


def is_colour(message: Any) -> bool:
    """Whether an Image or CompressedImage has colours."""
    if hasattr(message, "encoding"):
        return message.encoding in CHANNELS
    grey = message.format.split(";")[0].strip() in ("mono8", "mono16", "8UC1", "16UC1", "32FC1")
    return not is_depth(message) and not grey


def colour_image(message: Any) -> Bytes:
    """(H, W, 3) blue, green, red; raises LogError for a damaged image."""
    if not hasattr(message, "encoding"):
        return _picture(message.data, colour=True)
    order = CHANNELS[message.encoding]
    pixels = _pixels(message, np.dtype("u1"), len(order))
    return np.ascontiguousarray(pixels[:, :, order[:3]])


def depth_image(message: Any) -> Floats:
    """(H, W) distance along z, m, NaN = unknown; raises LogError for a damaged image.

    Integers are mm, floating-point numbers m (REP 118).
    """
    if hasattr(message, "encoding"):
        order = ">" if message.is_bigendian else "<"
        raw = _pixels(message, np.dtype(order + _DEPTHS[message.encoding]), 1)[:, :, 0]
        in_mm = raw.dtype.kind == "u"
        depth = raw.astype(np.float64) * (1e-3 if in_mm else 1.0)
    else:
        depth = _compressed_depth(message)
    with np.errstate(invalid="ignore"):
        depth[~(np.isfinite(depth) & (depth > 0.0))] = np.nan
    return depth


def _compressed_depth(message: Any) -> Floats:
    """Undo ROS's compressed_depth_image_transport, whose floats are quantised as 1 / depth."""
    if "rvl" in message.format.lower():
        raise LogError("RVL compression cannot be read; record depth as raw images or PNG")
    raw = _picture(message.data[_CONFIG_BYTES:], colour=False).astype(np.float64)
    if raw.ndim != 2:
        raise LogError("a depth image has several channels")
    if not message.format.strip().startswith("32FC1"):
        return np.asarray(raw * 1e-3)
    a, b = np.frombuffer(message.data[:_CONFIG_BYTES], "<f4")[1:]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(raw > 0.0, a / (raw - b), np.nan)


def _pixels(message: Any, kind: np.dtype[Any], channels: int) -> npt.NDArray[Any]:
    """(H, W, channels) of an image whose rows may be padded."""
    height, width, step = message.height, message.width, message.step
    used = width * channels * kind.itemsize
    if step < used or len(message.data) < height * step or not used * height:
        raise LogError(
            f"an image of {width} x {height} pixels has only {len(message.data)} bytes, in rows of "
            f"{step}; record the images again"
        )
    rows = np.asarray(message.data, np.uint8)[: height * step].reshape(height, step)[:, :used]
    return np.ascontiguousarray(rows).view(kind).reshape(height, width, channels)


def _picture(data: Bytes, *, colour: bool) -> npt.NDArray[Any]:
    cv2 = opencv()

    flag = cv2.IMREAD_COLOR if colour else cv2.IMREAD_UNCHANGED
    try:
        picture = cv2.imdecode(np.ascontiguousarray(data), flag)
    except cv2.error:
        picture = None
    if picture is None:
        raise LogError("a compressed image cannot be decoded")
    return np.asarray(picture)
