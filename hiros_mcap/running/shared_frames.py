"""Cameras that publish in one frame: whether they see the same people at one place in it.

If they do, somebody has applied their poses before. If not, the frame is no frame of what they all
see, and each camera needs one of its own.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from hiros_mcap.calibrate.survey import in_words, names_of, shared_frames
from hiros_mcap.calibrate.verdict import NO_VIEW, UNLINKED, CalibratedCamera
from hiros_mcap.io.log import Log

if TYPE_CHECKING:
    from hiros_mcap.calibrate.people import PeopleCalibration


def shared_wrongly(
    log: Log, rig: Sequence[CalibratedCamera], *, or_alone: bool = False
) -> dict[str, list[str]]:
    """Frame -> the cameras in it, where people whom they share are not at one place in it.

    ``or_alone`` : also where no two of them share anybody.
    """
    wrong = {camera.name for camera in rig if not camera.fits}
    alone = {camera.name for camera in rig if or_alone and camera.reason == UNLINKED}
    shared = {frame: names_of(cameras) for frame, cameras in shared_frames(log).items()}
    return {
        frame: names for frame, names in shared.items() if wrong & set(names) or alone >= set(names)
    }


def agreements(log: Log, rig: Sequence[CalibratedCamera]) -> tuple[str, ...]:
    """Return a line for each frame in which several cameras see the same people at one place."""
    fitting = {
        camera.name for camera in rig if camera.fits and camera.reason not in (NO_VIEW, UNLINKED)
    }
    shared = {frame: names_of(cameras) for frame, cameras in shared_frames(log).items()}
    return tuple(
        f"{in_words(names)} publish in the same frame {frame!r} and see the same people at the "
        "same place in it, so hiros takes them as they are"
        for frame, names in shared.items()
        if fitting >= set(names)
    )


def said(frame: tuple[str, Sequence[str]]) -> str:
    """Say that a frame of several cameras is no frame of what they all see."""
    name, cameras = frame
    where = f"publish in the same frame {name!r}" if name else "name no frame"
    return (
        f"{in_words(cameras)} {where}, but do not see the same people "
        "at the same place in it; set header.frame_id to each camera's own frame, pass a pose for "
        "each topic with --extrinsics FILE, or calibrate the poses that were applied before"
    )


def mended(log: Log, own: Log, calibration: PeopleCalibration) -> Iterator[str]:
    """Yield which frames channels got in ``own`` that share one in the log."""
    from hiros_mcap.calibrate.people import see_alike

    named = {camera.channel.topic: camera.own_frame for camera in own.cameras}
    for frame, cameras in shared_frames(log).items():
        names, new = names_of(cameras), [named[camera.channel.topic] for camera in cameras]
        if any(new) and not see_alike(names, calibration.cameras):
            yield (
                f"{in_words(names)} publish in the same frame {frame!r}, but do not see the same "
                f"people at the same place in it: hiros took a frame for each channel "
                f"({', '.join(filter(None, new))}). Set header.frame_id to each camera's own frame "
                "(tf_prefix)"
            )
