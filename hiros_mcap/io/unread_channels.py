"""Channels that are not read, and that may be cameras: a user should hear that these are missing.

A detector may publish a type that hiros does not know. Its name or its rate gives it away: those of
the cameras that are read.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Sequence

from hiros_mcap.io.channels import CameraChannel, ChannelInfo, is_transform_topic
from hiros_mcap.wording import quantity

_NEVER = re.compile(
    r"(sensor|std|stereo|diagnostic|nav|map|trajectory|shape|actionlib|action|lifecycle|bond|"
    r"rosgraph|tf2?|statistics|ffmpeg_image_transport|theora_image_transport|foxglove)_msgs/|"
    r"(rcl_interfaces|builtin_interfaces|roscpp|rosout|tf|dynamic_reconfigure)/|"
    r"\w+/(srv|action)/"
)
"""Types of which no camera's people are."""
_OF_PEOPLE = re.compile(
    r"skelet|bod(y|ies)|people|person|human|keypoint|detection|pose_?array|body_?track",
    re.IGNORECASE,
)
_GEOMETRY = re.compile(r"(geometry|visualization)_msgs/(?!(msg/)?PoseArray)")
"""Types of many uses: their rate tells nothing."""
_FEWEST = 5  # messages of a camera


def unread_cameras(
    channels: Iterable[ChannelInfo],
    cameras: Sequence[CameraChannel],
    selects: Callable[[str], bool],
) -> Iterator[ChannelInfo]:
    """Yield the channels that are not read though they look like another camera.

    No camera that is read has its name: its topic up to the segment that tells cameras apart. It
    differs from one of these names by numbers only, or it has about as many messages as they have,
    and a type that is not of many uses.
    """
    read = [camera.channel for camera in cameras if camera.channel.count]
    if not read:
        return
    depth = _depth([info.topic for info in read])
    names = {_name(info.topic, depth) for info in read}
    patterns = {_pattern(name) for name in names}
    counts = sorted(info.count for info in read)
    for info in channels:
        name = _name(info.topic, depth)
        plain = _NEVER.match(info.schema) or is_transform_topic(info.topic)
        if plain or not selects(info.topic) or name in names or info.count < _FEWEST:
            continue
        speaks = _OF_PEOPLE.search(info.schema) or _OF_PEOPLE.search(info.topic)
        if _pattern(name) in patterns - {""}:
            if speaks or 0.5 * counts[0] <= info.count <= 2.0 * counts[-1]:
                yield info
        elif (speaks or not _GEOMETRY.match(info.schema)) and (
            0.8 * counts[0] <= info.count <= 1.25 * counts[-1]
        ):
            yield info


def _depth(topics: Sequence[str]) -> int:
    """Return how many segments of a topic name a camera: up to where the topics differ."""
    segments = [topic.strip("/").split("/") for topic in topics]
    for depth, parts in enumerate(zip(*segments, strict=False), 1):
        if len(set(parts)) > 1 or (len(topics) == 1 and re.search(r"\d", parts[0])):
            return depth
    return 1


def _name(topic: str, depth: int) -> str:
    return "/".join(topic.strip("/").split("/")[:depth])


def _pattern(name: str) -> str:
    """Return the name with # for each number; "" if it has none."""
    return re.sub(r"\d+", "#", name) if re.search(r"\d", name) else ""


def not_read(info: ChannelInfo) -> str:
    """Return a warning that nothing of a channel is used, because of its type."""
    return (
        f"{info.topic}: {quantity(info.count, 'message')} of {info.schema or 'no type'} not read, "
        "since hiros finds no people in them; by name or rate it may be another camera. Record a "
        "type that hiros reads (docs/detectors.md), write a reader of your own, or name the other "
        "channels with --topic"
    )
