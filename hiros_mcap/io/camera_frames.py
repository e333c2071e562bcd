"""Which coordinate frame each camera is in, and where the log or a file says that it stands.

Transforms are those on /tf_static and /tf. Where these do not join the cameras, those in namespaces
count, too. A frame that is called as a camera's topic is the camera's, whatever frame its messages
name: so cameras that publish in one frame get poses of their own.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Sequence

import hiros_schemas
from hiros_mcap.body.transforms import Transform, TransformTree, parse_tf
from hiros_mcap.errors import ConfigError, naming
from hiros_mcap.io.channels import (
    TF_TOPICS,
    CameraChannel,
    ChannelInfo,
    channels_of,
    is_ours,
    is_static_topic,
    is_transform_topic,
    namespace_of,
)
from hiros_mcap.io.container import McapReader
from hiros_mcap.io.log_accounts import LATEST

_LIKE_TRANSFORMS = "TFMessage", "tfMessage", "TransformStamped", "FrameTransform", "FrameTransforms"
"""Names of types, without the package."""


def transforms_of(
    reader: McapReader, begin: int, cameras: Sequence[CameraChannel]
) -> tuple[TransformTree, list[CameraChannel]]:
    """Gather the transforms of a log, and name the cameras' frames as they do.

    Only the chunks that hold transforms are read. ``begin`` is the log time, ns, of the first
    detection. Raises LogError for transforms that are damaged.
    """
    infos = [i for i in channels_of(reader) if is_read(i) and i.count]
    topics = {info.topic for info in infos}
    tree, seen = TransformTree(begin), {name for c in cameras for name in c.frames} - {""}
    _add(tree, reader, [info for info in infos if info.topic in TF_TOPICS])
    spaced = [info for info in infos if info.topic not in TF_TOPICS]
    if spaced and not tree.joins(seen):
        cameras = list(_of_namespaces(reader, begin, cameras, infos, tree))
        tree.takes_namespaces = True
        _add(tree, reader, spaced)
    tree.look_alikes = sorted(_look_alikes(reader, topics))
    cameras = as_transforms_say(cameras, tree)
    names = [name for c in cameras for name in c.frames if tree.joins([name])]
    if used := tree.namespaces_above(names):
        tree.remark(
            f"transforms in a namespace: {', '.join(used)}; hiros reads them because /tf_static "
            "and /tf do not join the cameras"
        )
    return tree, cameras


def is_read(info: ChannelInfo) -> bool:
    """Whether a channel holds transforms that are read."""
    is_tf = info.has_type(hiros_schemas.TF_MESSAGE) and info.encoding == "cdr"
    return is_tf and is_transform_topic(info.topic)


def _look_alikes(reader: McapReader, read: set[str]) -> Iterator[str]:
    """Yield the topics, with their types, that look like transforms and are not ``read``."""
    # A part of a split recording declares /tf_static, and another part has it.
    kinds = {info.topic: info.schema for info in channels_of(reader) if not is_read(info)}
    kinds |= {topic: kind for topic, (kind, _) in reader.left_out.items()}
    for topic, kind in kinds.items():
        name = kind.replace(".", "/").rpartition("/")[2]
        if topic not in read and (name in _LIKE_TRANSFORMS or is_transform_topic(topic)):
            yield f"{topic} ({name or 'no type'})"


def _add(tree: TransformTree, reader: McapReader, infos: Iterable[ChannelInfo]) -> None:
    """Add the transforms of some channels."""
    topics = {info.id: info.topic for info in infos}
    for message in reader.messages(topics) if topics else ():
        topic, logged = topics[message.channel_id], min(message.log_time, LATEST)
        with naming(reader.path, topic):
            add_transforms(tree, topic, message.data, logged)


def add_transforms(
    tree: TransformTree, topic: str, data: bytes | memoryview, log_time: int
) -> None:
    """Add the transforms of a message; raises LogError if it is damaged."""
    for transform in parse_tf(data):
        tree.add(
            transform,
            static=is_static_topic(topic),
            log_time=log_time,
            namespace=namespace_of(topic),
        )


def _of_namespaces(
    reader: McapReader,
    begin: int,
    cameras: Sequence[CameraChannel],
    infos: Sequence[ChannelInfo],
    tree: TransformTree,
) -> Iterator[CameraChannel]:
    """Yield the cameras; those that share a frame have that of their namespace.

    Robots of one kind all have a ``camera_link``, each in the transforms of its own namespace. The
    pose goes into ``tree``, for the frame called as the topic.
    """
    owners = Counter(name for camera in cameras for name in camera.frames)
    for camera in cameras:
        own = [i for i in infos if _is_beside(i.topic, camera.channel.topic)]
        if len(camera.frames) != 1 or owners[camera.frames[0]] < 2 or not own:
            yield camera
            continue
        frame, alone = camera.frames[0], TransformTree(begin)
        _add(alone, reader, [info for info in infos if info.topic in TF_TOPICS])
        alone.takes_namespaces = True
        _add(alone, reader, own)
        root = alone.root(frame)
        pose = alone.at_rest(frame, root)
        if root == frame or pose is None:
            yield camera
            continue
        place = tuple(pose.translation.tolist()), tuple(pose.xyzw.tolist())
        tree.add(Transform(0, root, camera.topic_frame, *place), static=True)
        tree.remark(
            f"{camera.channel.topic}: its frame {frame!r} is that of {own[0].topic}, since other "
            "cameras have a frame of this name, too"
        )
        yield camera.in_frame(camera.topic_frame)


def _is_beside(topic: str, camera: str) -> bool:
    """Whether transforms are in a namespace of a camera."""
    space = topic.rpartition("/")[0]
    return bool(space) and camera.startswith(f"{space}/")


def as_transforms_say(cameras: Iterable[CameraChannel], tree: TransformTree) -> list[CameraChannel]:
    """Return the cameras in the frames that the log's transforms have for them."""
    return [_as_transforms_say(camera, tree) for camera in cameras]


def _as_transforms_say(camera: CameraChannel, tree: TransformTree) -> CameraChannel:
    if camera.topic_frame in tree.children and len(camera.frames) < 2:
        return camera.in_frame(camera.topic_frame)
    if len(camera.frames) != 1 or camera.frames[0] in ("", *tree.frames):
        return camera
    frame = camera.frames[0]
    same = [n for n in tree.frames if n.endswith(f"/{frame}") or frame.endswith(f"/{n}")]
    if len(same) != 1:
        return camera
    tree.remark(
        f"{camera.channel.topic}: its frame {frame!r} is taken to be {same[0]!r} of the "
        "transforms, since nothing but a prefix differs (tf_prefix)"
    )
    return camera.in_frame(same[0])


def as_file_says(cameras: Iterable[CameraChannel], tree: TransformTree) -> list[CameraChannel]:
    """Return the cameras in the frames that a file with poses has for them.

    The file may call a camera as its topic, as the frame in its messages, as ``hiros info`` does,
    or as a part of the topic that no other topic has, in this order.

    Raises ConfigError if the file has no pose for a camera of which there are people.
    """
    known = list(cameras)
    owners = Counter(name for camera in known for name in camera.frames)
    named = [_as_file_says(camera, tree, known, owners) for camera in known]
    seeing = [camera for camera in named if camera.frames and not is_ours(camera.channel.topic)]
    if lacking := [c for c in seeing if not set(c.frames) <= set(tree.frames)]:
        raise ConfigError(
            f"{tree.source}: has no pose of {', '.join(c.channel.topic for c in lacking)}; the "
            f"file has {', '.join(tree.names)}, the log {_in_words(seeing)}. Correct the names, "
            "which are topics or frames, or choose other cameras with --topic"
        )
    return named


def _in_words(cameras: Iterable[CameraChannel]) -> str:
    return ", ".join(
        f"{camera.channel.topic} ({f'frame {frames}' if frames else 'without a frame'})"
        for camera in cameras
        for frames in [", ".join(camera.frames)]
    )


def _as_file_says(
    camera: CameraChannel,
    tree: TransformTree,
    cameras: Sequence[CameraChannel],
    owners: Counter[str],
) -> CameraChannel:
    """Return a camera in the frame that the file has for it; see :func:`as_file_says`."""
    if len(camera.frames) > 1 or is_ours(camera.channel.topic):
        return camera
    if camera.topic_frame in tree.frames:
        return camera.in_frame(camera.topic_frame)
    frame = next(iter(camera.frames), "")
    if frame in tree.frames:
        return camera
    taken = {*owners, *(other.topic_frame for other in cameras)}
    free = [name for name in tree.frames if name not in taken]
    found = [name for name in free if cameras_called(name, cameras) == [camera]]
    if not found:
        return camera
    tree.remark(f"{tree.source}: {found[0]} is taken to be {camera.channel.topic}")
    is_own = frame and owners[frame] == 1
    tree.rename(found[0], frame if is_own else camera.topic_frame)
    return camera if is_own else camera.in_frame(camera.topic_frame)


def cameras_called(name: str, cameras: Sequence[CameraChannel]) -> list[CameraChannel]:
    """Return the cameras that a name means: a topic, a frame, a camera or a part of a topic."""
    bare = name.strip("/")
    return (
        [c for c in cameras if bare == c.topic_frame]
        or [c for c in cameras if bare in c.frames]
        or [c for c in cameras if name in c.sources.values()]
        or [c for c in cameras if f"/{bare}/" in f"/{c.topic_frame}/"]
    )


def note_unused(
    tree: TransformTree, cameras: Sequence[CameraChannel], others: Collection[str] = ()
) -> None:
    """Note which poses and clocks of a file are of no camera; ``others`` are used frames, too."""
    homes = [name for camera in cameras for name in camera.frames]
    frames = [name for name in (*homes, *others) if name in tree.frames]
    used = tree.children_above(frames)
    names = [name for name in tree.children if name not in used]
    clocks = [n for n in tree.clocks if n not in others and not cameras_called(n, cameras)]
    if clocks:
        names += [f"the clock of {name}" for name in clocks]
    if names:
        tree.remark(
            f"{tree.source}: not used: {', '.join(names)}; no camera that is read is called so"
        )
