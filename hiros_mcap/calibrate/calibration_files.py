"""The file for ``--extrinsics`` that a calibration writes."""

from __future__ import annotations

import json
import math
from pathlib import Path

from hiros_mcap.body.rotations import Rigid
from hiros_mcap.calibrate.people import PeopleCalibration
from hiros_mcap.calibrate.verdict import CameraResult, TargetCalibration
from hiros_mcap.outputs import CAMERAS_MARK, write_text

_ERRORS = {
    "error_deg": "standard error of the orientation",
    "error_mm": "standard error of the position",
    "residual_mm": "how far what it sees is from what the others see",
}
"""Keys of a camera, of which each is written if it is known."""


def save_cameras(path: Path, rig: PeopleCalibration | TargetCalibration) -> None:
    """Write poses and clocks as TOML: every camera with a pose, every clock that is known.

    A camera whose frame is the fixed one is the parent of the others. The file is written, or
    nothing at all; raises LogError if it cannot be written.
    """
    frame = rig.fixed_frame
    lines = [f"# verdict: {rig.verdict}" + (f" ({rig.reason})" if rig.reason else "")]
    for camera in rig.cameras:
        if camera.pose is not None and camera.frame != frame:
            lines += ["", *_camera(camera, camera.pose, frame)]
    clocks = {c.name: c.clock_s for c in rig.cameras if not math.isnan(c.clock_s)}
    if clocks:
        lines += ["", "[clock]  # s to add to the stamps of each camera"]
    lines += [f"{_text(name)} = {seconds:.4f}" for name, seconds in clocks.items()]
    write_text(path, CAMERAS_MARK + "\n".join([*lines, ""]))


def _camera(camera: CameraResult, pose: Rigid, parent: str) -> list[str]:
    lines = [
        "[[camera]]",
        f"frame = {_text(camera.frame)}",
        f"parent = {_text(parent)}",
        f"translation = [{', '.join(f'{x:.5f}' for x in pose.translation)}]  # m",
        f"quaternion_xyzw = [{', '.join(f'{x:.7f}' for x in pose.xyzw)}]",
    ]
    lines.append(f"verdict = {_text(camera.verdict)}")
    if camera.verdict == "impossible":
        lines[-1] += "  # the pose is the log's"
    if camera.reason:
        lines.append(f"reason = {_text(camera.reason)}")
    for key, comment in _ERRORS.items():
        value = getattr(camera, key)
        if math.isfinite(value) and camera.verdict != "impossible":
            lines.append(f"{key} = {value:.2f}  # {comment}")
    return lines


def _text(value: str) -> str:
    """Return a TOML string; JSON's escapes are TOML's, too."""
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
