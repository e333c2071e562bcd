"""Which colour image, depth image and CameraInfo of a log belong to one camera."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import takewhile
from typing import Any, NamedTuple

from hiros_mcap.errors import LogError
from hiros_mcap.io.images import is_colour, is_depth
from hiros_mcap.io.ros_messages import CAMERA_INFO, COMPRESSED_IMAGE, IMAGE, RosMessages


@dataclass(frozen=True, slots=True)
class ImageChannels:
    """The channels of one camera, and the first CameraInfo of each image."""

    name: str
    colour: str
    """Topic of the colour images."""
    depth: str
    """Topic of the depth images."""
    colour_frame: str
    depth_frame: str
    colour_info: Any
    depth_info: Any


class _Channel(NamedTuple):
    topic: str
    frame: str
    content: Any
    """The first message."""


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
    return [_camera(*cameras[place], infos) for place in sorted(cameras)]


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


def _camera(colour: _Channel, depth: _Channel, infos: list[_Channel]) -> ImageChannels:
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
