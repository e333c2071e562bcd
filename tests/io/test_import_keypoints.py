"""``hiros import`` of keypoints in images: files of detectors, lenses, and what may be wrong."""

from __future__ import annotations

import json

import numpy as np
import pytest

from hiros_cli.app import run
from hiros_mcap.body.transforms import read_extrinsics
from hiros_mcap.errors import ConfigError
from hiros_mcap.io.container import McapReader
from hiros_mcap.io.detectors.body_models import KEYPOINT_MODELS, body_model
from hiros_mcap.io.joints.image_series import RgbSetup
from hiros_mcap.io.joints.importing import RELATIVE_START, import_joints
from hiros_mcap.io.rgb_cameras import read_rgb_cameras
from hiros_mcap.running.overview import overview_of

SIZE = (640, 480)
RATE = {"": 50.0}
BODY = {  # px, of a person who stands before the camera
    **{"nose": (0, 0), "eye": (5, -5), "ear": (10, 0), "neck": (0, 40), "head": (0, -25)},
    **{"shoulder": (30, 45), "elbow": (40, 100), "wrist": (45, 150), "midhip": (0, 150)},
    **{"hip": (20, 150), "knee": (22, 220), "ankle": (23, 290), "bigtoe": (25, 305)},
    **{"smalltoe": (35, 305), "heel": (23, 295)},
}


def body(model, frame=0):
    """(J, 3) u, v and score of a model of the table."""
    rows = []
    for name in body_model(model).marker_names:
        part = name.lower().replace("_", "")
        side = 1 if part[0] == "l" else -1
        part = next(p for p in (part, part[1:], part[4:], part[5:]) if p in BODY)
        u, v = BODY[part]
        rows.append((300 + side * u + frame, 100 + v, 0.9))
    return np.array(rows)


def calibrated(path, names=("cam_1", "cam_2"), size=SIZE, more=""):
    tables = [
        f'[{name}]\nname = "{name}"\nsize = {list(size)}\ndistortions = [0.1, 0, 0, 0]\n'
        f"matrix = [[500, 0, 320], [0, 500, 240], [0, 0, 1]]\n"
        f"rotation = [0, {k}.5, 0]\ntranslation = [0, 0, {k + 3}]\n{more}"
        for k, name in enumerate(names)
    ]
    (path / "Calib.toml").write_text("".join(tables))
    return (path / "Calib.toml",)


def folder(path, people, numbers=range(5)):
    """OpenPose's folder of a camera: ``people`` of each frame."""
    path.mkdir()
    for k in numbers:
        listed = [{"pose_keypoints_2d": np.ravel(p(k)).tolist()} for p in people]
        text = json.dumps({"version": 1.3, "people": listed})
        (path / f"{path.name}_{k:012d}_keypoints.json").write_text(text)
    return path


def two(path, people=(lambda k: body("coco-17", k),)):
    return [folder(path / f"cam{k}_json", people) for k in (1, 2)]


def cameras_of(log):
    with McapReader(log) as reader:
        return {camera.name: camera for camera in read_rgb_cameras(reader)}


@pytest.mark.parametrize("model", ["openpose-25", "openpose-25b", "openpose-18", "coco-17"])
def test_the_number_of_joints_tells_the_model(model, tmp_path):
    sources = two(tmp_path, [lambda k: body(model, k), lambda k: body(model, k) - (150, 0, 0.2)])
    notes: list[str] = []
    setup = RgbSetup(calibrated(tmp_path), rates=RATE)
    import_joints(sources, tmp_path / "log.mcap", None, pytest.fail, notes.append, setup)
    cameras = cameras_of(tmp_path / "log.mcap")
    assert [*cameras] == ["cam_1", "cam_2"]
    first = cameras["cam_1"]
    assert first.model.marker_names == body_model(model).marker_names
    assert [f.stamp - first.frames[0].stamp for f in first.frames] == [
        20_000_000 * k for k in range(5)
    ]
    np.testing.assert_allclose(first.frames[3].pixels[0], body(model, 3)[:, :2])
    assert first.frames[3].scores[1] == pytest.approx(0.7)
    assert first.lens.distortion.tolist() == [0.1, 0, 0, 0]
    assert len([note for note in notes if "--joints" in note]) == (model[-3:] in ("-25", "25b"))


def test_joints_of_face_and_hands_are_left_out(tmp_path):
    assert KEYPOINT_MODELS[133] == ("coco-23",)
    whole = np.full((133, 3), (1, 1, 0.5))
    whole[:17] = body("coco-17")
    setup = RgbSetup(calibrated(tmp_path), rates=RATE)
    import_joints(two(tmp_path, [lambda k: whole]), tmp_path / "log.mcap", setup=setup)
    (frame, *_) = cameras_of(tmp_path / "log.mcap")["cam_2"].frames
    np.testing.assert_allclose(frame.pixels[0, :17], body("coco-17")[:, :2])
    assert frame.pixels.shape == (1, 23, 2)


def alphapose(path):
    people = [
        {"image_id": f"{k}.jpg", "keypoints": body("coco-17", k).ravel().tolist(), "score": 2.5}
        for k in (10, 2)
    ]
    (path / "cam1.json").write_text(json.dumps(people))
    return [path / "cam1.json"], RgbSetup(calibrated(path, ["cam1"]), rates=RATE)


def freemocap(path):
    bodies = np.stack([body("coco-17", k)[:, :2] for k in range(2, 11)])
    np.save(path / "a.npy", np.stack([bodies, bodies + 1]))
    return [path / "a.npy"], RgbSetup(calibrated(path, ["x0", "x1"]), rates=RATE)


def table(path):
    joints = body_model("coco-17").marker_names
    rows = [
        f"{k / 50},{camera},{joint},{u},{v},{score}"
        for k in (2, 10)
        for camera in ("cam1", "cam2")
        for joint, (u, v, score) in zip(joints, body("coco-17", k).tolist(), strict=True)
    ]
    (path / "a.csv").write_text("\n".join(["time,camera,joint,u,v,score", *rows, ""]))
    return [path / "a.csv"], RgbSetup(calibrated(path))


def instances(frame, width=2):
    """The people of an image, as MMPose lists them."""
    joints = body("coco-17", frame)
    return [
        {
            "keypoints": joints[:, :width].tolist(),
            "keypoint_scores": joints[:, 2].tolist(),
            "bbox": [[0, 0, 9, 9]],
            "bbox_score": 0.8,
        }
    ]


def mmpose(path):
    """A file of a video, as the inferencer and, with ``meta_info``, the demos write it."""
    frames = [{"frame_id": k, "instances": instances(k)} for k in range(2, 11)]
    content = {"meta_info": {"dataset_name": "coco"}, "instance_info": frames}
    (path / "cam1.json").write_text(json.dumps(frames))
    (path / "cam2.json").write_text(json.dumps(content))
    return [path / "cam2.json", path / "cam1.json"], RgbSetup(calibrated(path), rates=RATE)


def mmpose_images(path):
    """A folder of a file per image."""
    (path / "cam1").mkdir()
    for k in (2, 10):
        (path / "cam1" / f"{k:06d}.json").write_text(json.dumps(instances(k)))
    return [path / "cam1"], RgbSetup(calibrated(path, ["cam1"]), rates=RATE)


MAPPINGS = {mmpose: "mmpose", mmpose_images: "mmpose"}


@pytest.mark.parametrize("write", [alphapose, freemocap, table, *MAPPINGS])
def test_each_program_says_the_same(write, tmp_path):
    sources, setup = write(tmp_path)
    import_joints(sources, tmp_path / "log.mcap", MAPPINGS.get(write), setup=setup)
    frames = next(iter(cameras_of(tmp_path / "log.mcap").values())).frames
    np.testing.assert_allclose(frames[0].pixels[0], body("coco-17", 2)[:, :2])
    np.testing.assert_allclose(frames[-1].pixels[0], body("coco-17", 10)[:, :2])
    assert frames[-1].stamp - frames[0].stamp == 160_000_000


def test_a_model_of_mmpose_in_space_is_refused_and_another_program_named(tmp_path):
    frames = [{"frame_id": 0, "instances": instances(0, width=3)}]
    (tmp_path / "cam1.json").write_text(json.dumps(frames))
    setup = RgbSetup(calibrated(tmp_path, ["cam1"]), rates=RATE)
    with pytest.raises(ConfigError, match="have 3 numbers and a confidence beside them; .* 2D mod"):
        import_joints([tmp_path / "cam1.json"], tmp_path / "log.mcap", "mmpose", setup=setup)
    with pytest.raises(
        ConfigError, match=r"no list 'people' \(there are: frame_id, instances\); -"
    ):
        import_joints([tmp_path / "cam1.json"], tmp_path / "log.mcap", setup=setup)


def test_mediapipes_landmarks_of_the_image_become_keypoints(tmp_path):
    marks = np.column_stack([np.linspace(100, 420, 33), np.linspace(50, 410, 33), np.full(33, 0.9)])
    people = [
        [{"x": u / 640, "y": v / 480, "z": 0.1, "visibility": s} for u, v, s in marks.tolist()]
    ]
    frames = [
        {"timestamp_ms": 20 * k, "pose_landmarks": found, "pose_world_landmarks": []}
        for k, found in enumerate([people, people[0], None])  # the only person; nobody
    ]
    (tmp_path / "cam1.json").write_text(json.dumps(frames))
    setup = RgbSetup(calibrated(tmp_path, ["cam1"]))
    import_joints([tmp_path / "cam1.json"], tmp_path / "log.mcap", "mediapipe-image", setup=setup)
    camera = cameras_of(tmp_path / "log.mcap")["cam1"]
    assert camera.model.marker_names == body_model("mediapipe-33").marker_names
    assert [len(frame.pixels) for frame in camera.frames] == [1, 1, 0]
    for frame in camera.frames[:2]:
        np.testing.assert_allclose(frame.pixels[0], marks[:, :2])
        assert frame.scores == pytest.approx(0.9)


def test_legs_that_mediapipe_guesses_below_the_image_leave_shares_shares(tmp_path):
    marks = np.column_stack([np.linspace(0.3, 0.7, 33), np.linspace(0.1, 0.9, 33)])
    marks[25:] += [0.0, 1.4]  # somebody who sits at a desk
    scores = np.where(marks[:, 1] > 1, 0.01, 0.99)
    rows = zip(marks.tolist(), scores.tolist(), strict=True)
    people = [[{"x": u, "y": v, "z": 0.1, "visibility": s} for (u, v), s in rows]]
    frames = [{"timestamp_ms": 20 * k, "pose_landmarks": people} for k in range(3)]
    (tmp_path / "cam1.json").write_text(json.dumps(frames))
    setup = RgbSetup(calibrated(tmp_path, ["cam1"]))
    import_joints([tmp_path / "cam1.json"], tmp_path / "log.mcap", "mediapipe-image", setup=setup)
    frame = cameras_of(tmp_path / "log.mcap")["cam1"].frames[0]
    np.testing.assert_allclose(frame.pixels[0, :25], (marks * [640, 480])[:25])


def test_the_command_takes_rates_starts_and_poses(tmp_path, capsys):
    sources = [str(path) for path in two(tmp_path)]
    (calibration,) = calibrated(tmp_path)
    (tmp_path / "more").mkdir()
    (poses,) = calibrated(tmp_path / "more", ("cam2", "cam1", "cam3"))
    log = str(tmp_path / "log.mcap")
    options = ["--calibration", str(calibration), "--rate", "50", "--rate", "cam2=25", "--start"]
    assert (
        run(["import", *sources, *options, "cam1=1.5", "--extrinsics", str(poses), "-o", log]) == 0
    )
    cameras = cameras_of(log)
    stamps = {n: np.array([f.stamp for f in c.frames]) / 1e9 for n, c in cameras.items()}
    assert stamps["cam_1"] - RELATIVE_START == pytest.approx(1.5 + np.arange(5) / 50, abs=1e-6)
    assert stamps["cam_2"] - RELATIVE_START == pytest.approx(np.arange(5) / 25, abs=1e-6)
    with McapReader(log) as reader:
        (text,) = (m.data for m in reader.messages() if m.channel_id == 1)
    place = read_extrinsics(poses).lookup("cam1", "world", 0).translation
    assert place.astype("<f8").tobytes() in bytes(text)
    capsys.readouterr()
    assert run(["import", *sources, *options, "cam7=1", "-o", log, "--force"]) == 2
    assert (
        "--start names cam7, not among the cameras cam1_json, cam2_json" in capsys.readouterr().err
    )


def test_keypoints_of_a_log_are_listed(tmp_path):
    import_joints(
        two(tmp_path), tmp_path / "a.mcap", setup=RgbSetup(calibrated(tmp_path), rates=RATE)
    )
    rows = overview_of(tmp_path / "a.mcap").keypoints
    first = rows[0]
    assert [row.camera for row in rows] == ["cam_1", "cam_2"]
    assert (first.joints, first.images, first.width, first.height) == ("coco-17", 5, 640, 480)
    assert (first.rate_hz, first.least_people, first.most_people) == (pytest.approx(50), 1, 1)


def test_shares_of_the_image_become_pixels(tmp_path):
    share = (*SIZE, 1)
    notes: list[str] = []
    setup = RgbSetup(calibrated(tmp_path), rates=RATE)
    sources = two(tmp_path, [lambda k: body("coco-17", k) / share])
    import_joints(sources, tmp_path / "a.mcap", None, pytest.fail, notes.append, setup)
    frame = cameras_of(tmp_path / "a.mcap")["cam_1"].frames[0]
    np.testing.assert_allclose(frame.pixels[0], body("coco-17")[:, :2])
    assert "cam_1: keypoints are shares of the image, 0 to 1; they become px of 640 x 480" in notes


def test_a_broken_file_does_not_stop_the_import(tmp_path):
    sources, warnings = two(tmp_path), list[str]()
    for number, text in enumerate(["", '{"people": [7]}']):
        (sources[0] / f"cam1_json_{number:012d}_keypoints.json").write_text(text)
    setup = RgbSetup(calibrated(tmp_path), rates=RATE)
    import_joints(sources, tmp_path / "a.mcap", None, warnings.append, setup=setup)
    (text,) = warnings
    assert "cam1_json: 2 files of 5 left out; the first one: " in text
    assert len(cameras_of(tmp_path / "a.mcap")["cam_1"].frames) == 3


def test_videos_of_other_lengths_are_doubted(tmp_path):
    sources = [
        folder(tmp_path / f"cam{k}", [lambda k: body("coco-17")], range(0, n, 10))
        for k, n in ((1, 300), (2, 240))
    ]
    warnings: list[str] = []
    setup = RgbSetup(calibrated(tmp_path), rates=RATE)
    import_joints(sources, tmp_path / "a.mcap", None, warnings.append, setup=setup)
    (text,) = warnings
    assert text.endswith("cam1 5.8 s, cam2 4.6 s; if one has another rate, give it: --rate cam2=50")


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({}, "cam1_json: keypoints of images need the lenses of their cameras: name the calibr"),
        ({"names": ("a", "b", "c")}, r"has the cameras a, b, c, the keypoints are of cam1_json, c"),
        ({"size": (480, 320)}, "reach to 345, 390 px, .* 480 x 320 px: the video was turned"),
        ({"size": (400, 300)}, "400 x 300 px: the video has another size; calibrate these"),
        ({"joints": "zebra"}, r"--joints: should be a list, or one of"),
        ({"points": 21}, "has 21 keypoints, and hiros knows detectors of 17, 18"),
        ({"rate": {}}, "has no time; the rate under"),
        ({"text": "[cam_1]\nrotation = [0,0,0]\ntranslation = [0,0,1]\n"}, "tells no lens; hiros"),
        ({"text": "a = 1"}, "is no calibration of cameras; hiros needs"),
    ],
)
def test_what_is_wrong_is_one_line(change, fault, tmp_path):
    person = np.tile(body("coco-17"), (2, 1))[: change.get("points", 17)]
    calibration = calibrated(
        tmp_path, change.get("names", ("cam_1", "cam_2")), change.get("size", SIZE)
    )
    if "text" in change:
        calibration[0].write_text(change["text"])
    setup = RgbSetup(
        calibration if change else (),
        joints=change.get("joints", ""),
        rates=change.get("rate", RATE),
    )
    with pytest.raises(ConfigError, match=fault):
        import_joints(two(tmp_path, [lambda k: person]), tmp_path / "log.mcap", setup=setup)
    assert not (tmp_path / "log.mcap").exists()
