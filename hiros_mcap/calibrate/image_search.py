"""Depth and colour images of each camera, joined by time, and what is found in them."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from itertools import takewhile
from typing import Any, NamedTuple

from hiros_mcap.body.rotations import Rigid
from hiros_mcap.body.transforms import TransformTree
from hiros_mcap.calibrate.ball_image import DepthCamera
from hiros_mcap.errors import LogError
from hiros_mcap.io.camera_frames import add_transforms
from hiros_mcap.io.channels import is_static_topic, namespace_of
from hiros_mcap.io.detectors.detector_reader import nanoseconds
from hiros_mcap.io.ros_cdr import RosMessage
from hiros_mcap.io.ros_messages import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    IMAGE,
    TRANSFORMS,
    Bytes,
    RosMessages,
    colour_image,
    depth_image,
    intrinsics_of,
    is_colour,
    is_depth,
)
from hiros_mcap.skeletons import Floats

MAX_DELTA_S = 0.017
"""Between the colour and the depth image; half a period of a 30 Hz camera."""
WAITING = 8
"""Images that wait for their partner."""

Finder = Callable[[Bytes, Floats, DepthCamera], Any]
"""Finds something in a colour image (H, W, 3) and a depth image (h, w); None if it is not seen."""


def is_chosen(topic: str, globs: Sequence[str]) -> bool:
    """Whether a topic is among the globs; without any, all are."""
    return not globs or any(fnmatchcase(topic, glob) for glob in globs)


def static_transforms(log: RosMessages) -> TransformTree:
    """Gather the static transforms; cameras that move cannot be calibrated by a ball."""
    tree = TransformTree()
    tree.takes_namespaces = True
    wanted = [t for t, kind in log.types.items() if kind == TRANSFORMS and is_static_topic(t)]
    spaced = [topic for topic in wanted if namespace_of(topic)]
    for topics in ([topic for topic in wanted if topic not in spaced], spaced):
        for message in log.read(topics) if topics else ():
            add_transforms(tree, message.topic, message.data, message.log_time)
    return tree


def stamp_of(content: Any, message: RosMessage) -> int:
    """Return header.stamp, ns; the log time if there is none."""
    return nanoseconds(content.header.stamp) or message.log_time


def search_images(
    log: RosMessages, cameras: Sequence[ImageChannels], tree: TransformTree, find: Finder
) -> list[ImageSearch]:
    """Look for something in all images, in one pass through the log."""
    searches = [ImageSearch(channels, tree, find) for channels in cameras]
    by_topic = {t: s for s in searches for t in (s.channels.depth, s.channels.colour)}
    for message in log.read(by_topic.keys()):
        search = by_topic[message.topic]
        try:
            content = log.decode(message)
        except LogError:
            search.skipped["damaged"] += message.topic == search.channels.depth
        else:
            search.take(message.topic, stamp_of(content, message), content)
    for search in searches:
        search.finish()
    return searches


class ImageSearch:
    """Joins the depth and colour images of one camera, and looks for something in them.

    Stamps of a channel increase. A depth image waits for a colour image that is not older.

    Attributes
    ----------
    hits : stamp, ns, and what was found, of each depth image.
    skipped : depth images without a result, by reason.
    """

    def __init__(self, channels: ImageChannels, tree: TransformTree, find: Finder) -> None:
        self.channels = channels
        self.hits: list[tuple[int, Any]] = []
        self.skipped: Counter[str] = Counter()
        self._tree, self._find = tree, find
        self._camera: DepthCamera | None = None
        self._depths: deque[tuple[int, Any]] = deque()
        self._colours: deque[tuple[int, Any]] = deque(maxlen=2 * WAITING)

    def take(self, topic: str, stamp: int, content: Any) -> None:
        """Take an image of the camera."""
        queue = self._depths if topic == self.channels.depth else self._colours
        queue.append((stamp, content))
        depths, colours = self._depths, self._colours
        while depths and ((colours and colours[-1][0] >= depths[0][0]) or len(depths) > WAITING):
            self._join(*depths.popleft())

    def finish(self) -> None:
        """Use the depth images that still wait."""
        while self._depths:
            self._join(*self._depths.popleft())

    def _join(self, stamp: int, depth: Any) -> None:
        nearest = min(self._colours, key=lambda colour: abs(colour[0] - stamp), default=None)
        if nearest is None or abs(nearest[0] - stamp) > MAX_DELTA_S * 1e9:
            self.skipped["no colour image at that time"] += 1
            return
        try:
            images = depth_image(depth), colour_image(nearest[1])
        except LogError:
            self.skipped["damaged"] += 1
            return
        self._search(stamp, *images)

    def _search(self, stamp: int, depth: Floats, colour: Bytes) -> None:
        if self._camera is None:
            self._camera = _camera(self.channels, self._tree, depth.shape, colour.shape[:2])
        if self._camera.rays.shape[:2] != depth.shape:
            self.skipped["of another size"] += 1
            return
        target = self._find(colour, depth, self._camera)
        if target is None:
            self.skipped["not seen"] += 1
        else:
            self.hits.append((stamp, target))


def _camera(
    channels: ImageChannels, tree: TransformTree, depth: Sequence[int], colour: Sequence[int]
) -> DepthCamera:
    """Return how depth and colour images belong together.

    Raises LogError if nothing in the log tells it.
    """
    lens = intrinsics_of(channels.depth_info, channels.depth)
    to_colour: Rigid | None = Rigid.identity()
    if channels.depth_frame != channels.colour_frame:
        to_colour = tree.at_rest(channels.depth_frame, channels.colour_frame)
    if to_colour is None:
        raise LogError(
            f"is in the frame {channels.depth_frame!r}, the colour images are in "
            f"{channels.colour_frame!r}, and /tf_static does not join them; record depth that is "
            "registered to the colour image",
            topic=channels.depth,
        )
    aligned = channels.depth_frame == channels.colour_frame and tuple(depth) == tuple(colour)
    colour_lens = None if aligned else intrinsics_of(channels.colour_info, channels.colour)
    return DepthCamera(lens.rays(*depth), float(lens.matrix[0, 0]), colour_lens, to_colour)


@dataclass(frozen=True, slots=True)
class ImageChannels:
    """The channels of one camera, and the first CameraInfo of each image."""

    name: str
    colour: str  # topic of the colour images
    depth: str  # topic of the depth images
    colour_frame: str
    depth_frame: str
    colour_info: Any
    depth_info: Any


class _Channel(NamedTuple):
    topic: str
    frame: str
    content: Any  # the first message


def pair_channels(log: RosMessages, types: Mapping[str, str]) -> list[ImageChannels]:
    """Find the cameras among the channels ``types`` (topic -> type) of a log.

    A depth image goes with that colour image which is in the same frame, if there is one, and whose
    topic has most in common with its own. If a camera has several depth images, the one that is
    registered to the colour image is taken. Raises LogError if there is no camera.
    """
    wanted = {t for t, kind in types.items() if kind in (IMAGE, COMPRESSED_IMAGE, CAMERA_INFO)}
    first = _first_messages(log, wanted)
    images = [c for c in first.values() if types[c.topic] != CAMERA_INFO]
    infos = [c for c in first.values() if types[c.topic] == CAMERA_INFO]
    # The same pictures may also be there in a compressed form, which is slower to read.
    images.sort(key=lambda c: (types[c.topic] != IMAGE, c.topic))
    colours = [c for c in images if is_colour(c.content)]
    depths = [c for c in images if is_depth(c.content)]
    if not colours or not depths:
        what = "depth" if colours else "colour"
        raise LogError(f"has no {what} images that can be read; it has {_listing(images, types)}")
    cameras: dict[str, tuple[_Channel, _Channel]] = {}
    for depth in depths:
        colour = max(colours, key=lambda c: _kinship(c, depth))
        other = cameras.get(_place(colour.topic))
        if other is None or _kinship(colour, depth) > _kinship(*other):
            cameras[_place(colour.topic)] = colour, depth
    return [_channels_of(*cameras[place], infos) for place in sorted(cameras)]


def _first_messages(log: RosMessages, topics: Collection[str]) -> dict[str, _Channel]:
    channels: dict[str, _Channel] = {}
    left = set(topics)
    for message in log.read(left):
        if message.topic in left:
            content = log.decode(message)
            frame = content.header.frame_id.lstrip("/")
            channels[message.topic] = _Channel(message.topic, frame, content)
            left.discard(message.topic)
            if not left:
                break
    return channels


def _kinship(one: _Channel, other: _Channel) -> tuple[bool, int, int]:
    """How much two channels seem to belong together: the frame, parts of the topic, its start."""
    common = Counter(_parts(one.topic)) & Counter(_parts(other.topic))
    start = _common_start(one.topic, other.topic)
    return bool(one.frame) and one.frame == other.frame, common.total(), len(start)


def _common_start(one: Sequence[str], other: Sequence[str]) -> list[str]:
    return [a for a, _ in takewhile(lambda pair: pair[0] == pair[1], zip(one, other, strict=False))]


def _parts(topic: str) -> list[str]:
    return topic.strip("/").split("/")


def _place(topic: str) -> str:
    """Return the topic that an image transport derives its own from."""
    return topic.removesuffix("/compressed").removesuffix("/compressedDepth")


def _channels_of(colour: _Channel, depth: _Channel, infos: list[_Channel]) -> ImageChannels:
    name = _common_start(_parts(colour.topic), _parts(depth.topic))
    return ImageChannels(
        name="/".join(name) or colour.frame or colour.topic,
        colour=colour.topic,
        depth=depth.topic,
        colour_frame=colour.frame,
        depth_frame=depth.frame,
        colour_info=_info_of(colour, infos),
        depth_info=_info_of(depth, infos),
    )


def _info_of(image: _Channel, infos: list[_Channel]) -> Any:
    """Return the CameraInfo beside an image; raises LogError if there is none in its frame."""
    same = [info for info in infos if info.frame == image.frame]
    if not same:
        raise LogError(
            f"no CameraInfo is in the frame {image.frame!r} of these images; record the "
            "camera_info channels, too",
            topic=image.topic,
        )
    return max(same, key=lambda info: _kinship(info, image)).content


def _listing(images: list[_Channel], types: Mapping[str, str]) -> str:
    listed = [f"{c.topic} ({getattr(c.content, 'encoding', types[c.topic])})" for c in images]
    return ", ".join(sorted(listed)) or "no images"
