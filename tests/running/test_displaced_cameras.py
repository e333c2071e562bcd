"""A camera that is wrong as a whole, in a run of hiros process."""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np
import pytest

from hiros_cli.app import run
from hiros_mcap.body.rotations import Rigid, from_vector, rotate
from hiros_mcap.body.transforms import pose_arrays
from hiros_mcap.config import load_config
from hiros_mcap.events import events_from_json
from hiros_mcap.io.channels import EVENTS_ATTACHMENT, add_skeleton_channel, add_static_poses
from hiros_mcap.io.codec import Encoder
from hiros_mcap.io.container import McapWriter
from hiros_mcap.io.log import open_log
from hiros_mcap.kernels.people_rows import move_messages
from hiros_mcap.running.pipeline import ProcessOptions, process
from hiros_mcap.simulate import SimulateParams, simulate
from hiros_mcap.skeletons import Frame

STEP = Rigid(from_vector(np.radians([6.0, -8.0, 0.0])), np.array([0.3, 0.0, 0.27]))
"""10 degrees and 40 cm, in the camera's own frame."""
SECONDS, AT_S, SECOND = 8.0, 6.4, 1_000_000_000
RATE = 10.0

Change = Callable[[Frame], Frame]


@pytest.fixture(scope="module")
def scene():
    params = {"people": 2, "cameras": 4, "seconds": SECONDS, "seed": 3, "action": "cross"}
    return simulate(SimulateParams.model_validate(params | {"rig": {"rate": RATE}}))


def write(path, scene, change, poses=None):
    """Write a log in which one camera's frames are changed."""
    poses = {camera.name: camera.pose for camera in scene.cameras} | dict(poses or {})
    encoder = Encoder(scene.model)
    frames = sorted(scene.detections, key=lambda frame: frame.log_time)
    with McapWriter(path) as writer:
        add_static_poses(writer, poses, "world", frames[0].log_time)
        channels = {name: add_skeleton_channel(writer, f"/{name}/people") for name in poses}
        for frame in frames:
            frame = change(frame) if frame.source == "camera_1" else frame
            writer.write(channels[frame.source], frame.log_time, encoder.encode(frame))
        writer.commit()
    return path


def as_it_is(frame):
    return frame


def moved_late(frame):
    """The frame of a camera that somebody moves before the last fifth of the log."""
    if frame.stamp < SimulateParams().start + AT_S * 1e9:
        return frame
    people = frame.people.copy()
    move_messages(pose_arrays([STEP.inverse()]), np.array([[0, len(people.ids)]]), people)
    return frame.replace(people=people)


def upside_down(frame):
    people = frame.people.copy()
    move_messages(
        pose_arrays([Rigid(from_vector(np.array([0.0, 0.0, np.pi])), np.zeros(3))]),
        np.array([[0, len(people.ids)]]),
        people,
    )
    return frame.replace(people=people)


def in_a_mirror(pose):
    """A wall of mirrors at x = 3 m: the camera shows everybody a second time."""

    def change(frame):
        n = frame.n_people
        twice = frame.select([*range(n), *range(n)]).people.copy()
        there = rotate(pose.xyzw, twice.markers[n:, :, :3]) + pose.translation
        there = there * [-1.0, 1.0, 1.0] + [6.0, 0.0, 0.0]
        twice.markers[n:, :, :3] = rotate(pose.inverse().xyzw, there - pose.translation)
        twice.links[n:] = np.nan
        return frame.replace(people=twice)

    return change


def false_people(path, scene):
    """Count the skeletons farther than 0.5 m from everybody, and those who are there twice."""
    truth = list(scene.truth)
    stamps = np.array([frame.stamp for frame in truth])
    false = 0
    with open_log(path, topics=["/hiros/filtered"], output_prefix="/none") as result:
        for frame in result.frames():
            true = truth[int(np.abs(stamps - frame.stamp).argmin())].positions
            apart = np.linalg.norm(frame.positions[:, None] - true[None], axis=-1)
            distances = np.nanmean(apart, axis=-1)
            near = [int(row.argmin()) for row in distances if row.min() < 0.5]
            false += frame.n_people - len(set(near))
    return false


def faulty(kind, folder, scene):
    """Write a log of a kind."""
    poses = {camera.name: camera.pose for camera in scene.cameras}
    changes: dict[str, tuple[Change, dict[str, Rigid]]] = {
        "healthy": (as_it_is, {}),
        "moved": (moved_late, {}),
        "upside down": (upside_down, {}),
        "one pose for two": (as_it_is, {"camera_1": poses["camera_0"]}),
        "mirror": (in_a_mirror(poses["camera_1"]), {}),
    }
    change, wrong = changes[kind]
    return write(folder / "log.mcap", scene, change, wrong)


@pytest.mark.parametrize(
    ("kind", "system"),
    [
        *((kind, "fuse") for kind in ("moved", "upside down", "one pose for two", "mirror")),
        *(("moved", system) for system in ("hiros", "hiros-realtime", "fuse-realtime")),
        ("mirror", "hiros-realtime"),
    ],
)
def test_nobody_is_doubled(kind, system, scene, tmp_path):
    log, out = faulty(kind, tmp_path, scene), tmp_path / "out.mcap"
    options = ProcessOptions(system=system, calibrate="off")
    summary = process(log, out, config=load_config(system=system), options=options)
    assert false_people(out, scene) == 0
    (warning,) = (text for text in summary.to_dict()["warnings"] if text.startswith("camera_1 "))
    assert ("mirror" in warning) == (kind == "mirror")


def test_the_warning_says_when_and_how_far(scene, tmp_path):
    log, out = faulty("moved", tmp_path, scene), tmp_path / "out.mcap"
    summary = process(log, out, options=ProcessOptions(calibrate="off"))
    (warning,) = summary.warnings
    assert re.match(r"camera_1 shows people 0\.\d\d m from where other cameras see them", warning)
    when = re.search(r"From (\S+) s on hiros left out (\d+) such detections", warning)
    assert when is not None
    assert float(when[1]) == pytest.approx(AT_S, abs=1.0)
    with open_log(out) as result:
        events = events_from_json((result.reader.attachment(EVENTS_ATTACHMENT) or b"").decode())
    (event,) = (event for event in events if event.kind == "camera displaced")
    assert (event.source, event.is_warning) == ("camera_1", True)
    assert len(summary.people) == 2


def test_the_terminal_shows_the_warning(scene, tmp_path, capsys):
    log = faulty("mirror", tmp_path, scene)
    assert run(["process", str(log), "-o", str(tmp_path / "out.mcap"), "--calibrate", "off"]) == 0
    assert "hiros: warning: camera_1 shows mirror images of people" in capsys.readouterr().err


def test_a_camera_moved_for_too_short_a_time_for_a_pose_doubles_nobody(scene, tmp_path):
    """As users run it: the poses are refined first, and the last part is too short."""
    log, out = faulty("moved", tmp_path, scene), tmp_path / "out.mcap"
    process(log, out)
    assert false_people(out, scene) == 0


def test_the_verdict_says_from_when_on_a_pose_does_not_fit(scene, tmp_path):
    def nudged(frame):
        late = frame.stamp > SimulateParams().start + (SECONDS - 2.0) * 1e9
        people = frame.people.copy()
        people.markers[:, :, 0] += 0.25 * late
        return frame.replace(people=people)

    log = write(tmp_path / "log.mcap", scene, nudged)
    summary = process(log, options=ProcessOptions(stages="T"))
    reasons = {c.name: c.reason for c in summary.poses if "from where" in c.reason}
    assert list(reasons) == ["camera_1"]
    when = re.fullmatch(r"shows people 0\.\d\d m from .* from (\S+) s on", reasons["camera_1"])
    assert when is not None
    assert float(when[1]) == pytest.approx(SECONDS - 2.0, abs=1.0)


@pytest.mark.parametrize("system", ["fuse", "fuse-realtime"])
def test_a_camera_that_stands_in_its_place_again_is_no_longer_doubtful(system, scene, tmp_path):
    """Live, this is what a camera looks like whose clock or pose was corrected meanwhile."""

    def nudged(frame):
        t = (frame.stamp - SimulateParams().start) / SECOND
        people = frame.people.copy()
        people.markers[:, :, 0] += 0.15 * (1.0 < t < 5.0)
        return frame.replace(people=people)

    log, out = write(tmp_path / "log.mcap", scene, nudged), tmp_path / "out.mcap"
    options = ProcessOptions(system=system, calibrate="off")
    summary = process(log, out, config=load_config(system=system), options=options)
    assert summary.warnings == ()
    (note,) = (note for note in summary.notes if "showed people" in note)
    found = re.fullmatch(
        r"camera_1 showed people 0\.1\d m from .* for (\S+) s, from (\S+) s on", note
    )
    assert found is not None
    assert [float(found[1]), float(found[2])] == pytest.approx([4.0, 1.0], abs=1.2)


def test_healthy_cameras_are_not_displaced(scene, tmp_path):
    log = faulty("healthy", tmp_path, scene)
    assert process(log, options=ProcessOptions(calibrate="off")).warnings == ()


@pytest.mark.parametrize(("cameras", "metres"), [(2, 0.2), (3, 0.1)])
def test_a_move_before_the_last_fifth_is_told_in_verdict_and_warning(cameras, metres, tmp_path):
    """Too short a part for a pose, and people too near to be taken for others."""

    def late(frame):
        people = frame.people.copy()
        people.markers[:, :, 0] += metres * (frame.stamp > SimulateParams().start + 12 * SECOND)
        return frame.replace(people=people)

    params = {"cameras": cameras, "seconds": 15.0, "seed": 31, "rig": {"rate": RATE}}
    walk = simulate(SimulateParams.model_validate(params))
    summary = process(write(tmp_path / "log.mcap", walk, late))
    doubtful = [c for c in summary.poses if c.verdict == "doubtful"]
    (warning,) = summary.warnings
    (reason,) = {c.reason for c in doubtful}
    when = re.match(r"shows people 0\.\d\d m from where .* from (\S+) s on", reason)
    assert when is not None
    assert float(when[1]) == pytest.approx(12.0, abs=1.0)
    assert warning.startswith(f"{doubtful[0].name} shows people ")
    assert cameras == 2 or doubtful[0].name == "camera_1"
