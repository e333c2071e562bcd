"""What a user should know of a log before it is read, in words."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence

from hiros_mcap.body.transforms import PoseChange, TransformTree, same_place
from hiros_mcap.io.channels import OUTPUT_TOPICS, CameraChannel, ChannelInfo
from hiros_mcap.io.detectors.body_size import unit_warning
from hiros_mcap.summary import quantity


def pose_warnings(
    cameras: Sequence[CameraChannel], transforms: TransformTree, fixed: str, start: int
) -> Iterator[str]:
    """Yield what makes the cameras' poses in the frame ``fixed`` doubtful, with the remedy.

    ``start`` is the log time, ns, of the first skeleton.
    """
    frames = sorted({name for camera in cameras for name in camera.frames} - {fixed})
    poses = {name: transforms.lookup(name, fixed, 0) for name in frames}
    yield from filter(None, (unit_warning(c.channel.topic, c.size) for c in cameras))
    changes: dict[str, list[PoseChange]] = {}
    for change in transforms.changes_above([*frames, fixed]):
        changes.setdefault(change.child, []).append(change)
    for same in changes.values():
        yield _changed(same, start)
    for same_frames in same_place(poses):
        yield (
            f"{', '.join(same_frames[:-1])} and {same_frames[-1]} stand at the same place with the "
            "same orientation; unless they are one camera, pass the camera poses with "
            "--extrinsics FILE"
        )


def _changed(changes: Sequence[PoseChange], start: int) -> str:
    first = changes[0]
    seconds = (first.log_time - start) * 1e-9
    more = f" and then {quantity(len(changes) - 1, 'time')} more" if len(changes) > 1 else ""
    return (
        f"the pose of {first.child} in {first.parent} changes by {first.distance} at "
        f"{seconds:.1f} s{more}; hiros uses the new pose from then on. If nobody moved or "
        "calibrated it, pass the right poses with --extrinsics FILE"
    )


def input_warnings(cameras: Sequence[CameraChannel]) -> Iterator[str]:
    """Yield what makes the result worthless before a message is read."""
    if cameras and not _sent(cameras):
        yield "the room is empty: the cameras sent no message; check the detectors"


def _sent(cameras: Sequence[CameraChannel]) -> int:
    return sum(camera.channel.count for camera in cameras)


def input_remarks(
    cameras: Sequence[CameraChannel], *, has_people: bool, has_transforms: bool
) -> Iterator[str]:
    """Yield notes about the cameras' messages."""
    if not has_people and _sent(cameras):
        yield "the room is empty: no camera sees anybody"
    topics = [camera.channel.topic for camera in cameras if "" in camera.frames]
    if topics:
        unused = " and does not use the log's transforms" if has_transforms else ""
        yield (
            f"channels without a coordinate frame: {', '.join(topics)}; hiros assumes that their "
            f"skeletons share one frame{unused}"
        )


def channel_remarks(
    channels: Iterable[ChannelInfo], left_out: Mapping[str, tuple[str, int]]
) -> Iterator[str]:
    """Yield notes about the other channels of a log; for ``left_out`` see BagReader."""
    former = [info.topic for info in channels if info.topic in OUTPUT_TOPICS]
    if former:
        yield (
            f"the log holds results of hiros already ({', '.join(former)}); a run reads the "
            "cameras again and its results replace them"
        )
    if left_out:
        topics = [f"{topic} ({kind}, {n})" for topic, (kind, n) in sorted(left_out.items())]
        yield f"not copied from the bag: {', '.join(topics)}"
