"""Logs whose camera poses change, contradict each other, coincide or are missing."""

from __future__ import annotations

import numpy as np
import pytest
from mcap_logs import tf_bytes

from hiros_cli.app import run as command
from hiros_mcap.io.container import McapWriter
from hiros_mcap.io.log import open_log
from hiros_mcap.running.pipeline import process

SECOND = 1_000_000_000
NONE = (0.0, 0.0, 0.0, 1.0)
Pose = tuple[int, str, tuple[float, ...], tuple[float, ...]]
"""Log time, child frame, translation, xyzw; the parent is the world."""


def start(source):
    with open_log(source) as log:
        return log.span[0]


def with_poses(source, target, poses, *, own=True):
    """Copy a log with more static transforms; without its own ones if not ``own``."""
    with open_log(source) as log, McapWriter(target) as writer:
        writer.copy_definitions(log.reader, log.reader.channels)
        tf = next(i.id for i in log.channels if i.topic == "/tf_static")
        rows = [
            (m.log_time, m.channel_id, bytes(m.data))
            for m in log.reader.messages()
            if own or m.channel_id != tf
        ]
        for time, child, translation, xyzw in poses:
            rows.append((time, tf, tf_bytes((0, "world", child, translation, xyzw))))
        for time, channel, data in sorted(rows):
            writer.write(channel, time, data)
        writer.commit()
    return target


def pose(source, camera):
    with open_log(source) as log:
        found = log.transforms.lookup(camera, "world", 0)
    return tuple(found.translation.tolist()), tuple(found.xyzw.tolist())


def test_a_camera_calibrated_anew_in_the_middle_counts_from_then_on(whole_crossing, tmp_path):
    now, ((x, y, z), xyzw) = start(whole_crossing) + 2 * SECOND, pose(whole_crossing, "camera_1")
    moved = with_poses(
        whole_crossing, tmp_path / "moved.mcap", [(now, "camera_1", (x + 0.5, y, z), xyzw)]
    )
    with open_log(whole_crossing) as before, open_log(moved) as after:
        for one, other in zip(before.detections(), after.detections(), strict=True):
            expected = 0.5 if one.source == "camera_1" and one.log_time >= now else 0.0
            shift = (other.positions - one.positions)[..., 0]
            np.testing.assert_allclose(shift[~np.isnan(shift)], expected, atol=1e-9)
        (warning,) = after.warnings
    assert "the pose of camera_1 in world changes by 50.0 cm and 0.0 degrees at 2.0 s" in warning
    assert "--extrinsics" in warning
    displaced, last = process(moved).warnings
    assert last == warning
    assert displaced.startswith("camera_1 shows people 0.")  # nobody has moved it


def test_the_same_pose_over_and_over_is_no_change(crossing, tmp_path):
    times = range(start(crossing), start(crossing) + 4 * SECOND, SECOND)
    rows = [(time, "camera_1", *pose(crossing, "camera_1")) for time in times]
    with open_log(with_poses(crossing, tmp_path / "same.mcap", rows)) as log:
        assert log.warnings == ()


def test_contradicting_poses_are_refused(crossing, tmp_path, capsys):
    rows = [(start(crossing), "camera_1", (9.0, 0.0, 2.0), NONE)]
    log, out = with_poses(crossing, tmp_path / "two.mcap", rows), tmp_path / "out.mcap"
    assert command(["process", str(log), "-o", str(out)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "'camera_1' has two static transforms in 'world'" in line
    assert line.count("--extrinsics") == 1
    assert not out.exists()


def test_cameras_at_one_place_are_noticed(crossing, tmp_path, capsys):
    rows = [(0, f"camera_{k}", (0.0, 0.0, 0.0), NONE) for k in range(3)]
    log = with_poses(crossing, tmp_path / "identity.mcap", rows, own=False)
    assert command(["info", str(log)]) == 0
    warning = "hiros: warning: camera_0, camera_1 and camera_2 stand at the same place"
    assert warning in capsys.readouterr().err
    assert command(["process", "-q", "-o", str(tmp_path / "out.mcap"), str(log)]) == 2
    assert "all cameras stand at the same place" in capsys.readouterr().err


@pytest.mark.parametrize("in_mm", [("camera_0", "camera_1", "camera_2"), ("camera_1",)])
def test_transforms_in_mm_are_named_as_such(in_mm, whole_crossing, tmp_path, capsys):
    poses = {f"camera_{k}": pose(whole_crossing, f"camera_{k}") for k in range(3)}
    rows: list[Pose] = [
        (0, name, tuple(x * (1000.0 if name in in_mm else 1.0) for x in place), xyzw)
        for name, (place, xyzw) in poses.items()
    ]
    log = with_poses(whole_crossing, tmp_path / "mm.mcap", rows, own=False)
    message = f"km apart ({', '.join(in_mm)}): the translations look like mm, not m; divide them"
    assert command(["info", str(log)]) == 0
    assert message in capsys.readouterr().err
    assert command(["process", "-q", "-o", str(tmp_path / "out.mcap"), str(log)]) in (0, 2)
    assert message in capsys.readouterr().err


def test_a_log_without_transforms_says_what_to_do(crossing, tmp_path, capsys):
    log = with_poses(crossing, tmp_path / "none.mcap", [], own=False)
    assert command(["process", str(log)]) == 2
    (text,) = capsys.readouterr().err.splitlines()
    assert "no /tf or /tf_static, so the camera poses are unknown; pass them with" in text
    assert "hiros calibrate people" in text
    assert "--extrinsics cameras.toml" in text
