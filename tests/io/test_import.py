"""``hiros import``: joint positions from CSV, TRC and JSON files."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import detector_files as files
import detector_logs as made
import numpy as np
import pytest
from test_foreign_tables import c3d

from hiros_cli.app import run
from hiros_mcap import open_result
from hiros_mcap.errors import ConfigError
from hiros_mcap.io.detectors.body_models import body_model, linked
from hiros_mcap.io.joints.importing import RELATIVE_START, import_joints
from hiros_mcap.io.log import open_log
from hiros_mcap.running.pipeline import process
from hiros_mcap.skeletons import Frame

Y_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # x, y, z of the file = x, z, -y of the log


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    path = tmp_path_factory.mktemp("scene") / "scene.mcap"
    return made.scene(path, people=1, cameras=2, seconds=1.5, seed=4)


def frames_of(scene, camera):
    return [f for _, f in scene.detections if f.source == camera and f.n_people]


def wide_csv(path, frames, names):
    """Columns time, LEFT_x, LEFT_y, ...; mm, y up, ms since 1970."""
    head = ["time", *(f"{name}_{axis}" for name in names for axis in "xyz")]
    rows = [
        [
            f"{made.stamp_of(f) / 1e6:.6f}",
            *map(repr, (1000 * f.positions[0] @ Y_UP.T).ravel().tolist()),
        ]
        for f in frames
    ]
    path.write_text("\n".join(",".join(row) for row in [head, *rows]))


def tall_csv(path, frames, names):
    """A row per joint."""
    rows = ["t,who,landmark,X,Y,Z,score"]
    rows += [
        f"{made.stamp_of(f) / 1e6:.6f},{who},{name},{','.join(map(repr, xyz))},0.5"
        for f in frames
        for who, person in enumerate((1000 * f.positions @ Y_UP.T).tolist())
        for name, xyz in zip(names, person, strict=True)
    ]
    path.write_text("\n".join(rows))


def json_file(path, frames, names):
    content = [
        {
            "t": made.stamp_of(f) / 1e6,
            "persons": [
                {"id": "anna", "keypoints": (1000 * person @ Y_UP.T).tolist()}
                for person in f.positions
            ],
        }
        for f in frames
    ]
    path.write_text(json.dumps({"instants": content}))


def trc_file(path, frames, names):
    times = [(made.stamp_of(f) - made.stamp_of(frames[0])) / 1e9 for f in frames]
    positions = [1000 * f.positions[0] @ Y_UP.T for f in frames]
    path.write_text(files.trc_text(positions, names, times, "mm"))


AXES = 'axes = ["x", "-z", "y"]\n'
KINDS: dict[str, tuple[Callable[[Path, list[Frame], tuple[str, ...]], None], str, str]] = {
    "wide": (wide_csv, ".csv", f'unit = "mm"\n{AXES}[time]\nunit = "ms"\n'),
    "tall": (
        tall_csv,
        ".csv",
        f'unit = "mm"\n{AXES}[time]\ncolumn = "t"\nunit = "ms"\n[columns]\nperson = "who"\n'
        'joint = "landmark"\nx = "X"\ny = "Y"\nz = "Z"\nconfidence = "score"\n',
    ),
    "json": (
        json_file,
        ".json",
        f'unit = "mm"\n{AXES}names = {json.dumps(list(body_model("azure-kinect").marker_names))}\n'
        '[time]\ncolumn = "t"\nunit = "ms"\n[columns]\nframes = "instants"\npeople = "persons"\n'
        'joints = "keypoints"\n',
    ),
    "trc": (trc_file, ".trc", AXES + "[time]\nstart = {start}\n"),
}


@pytest.mark.parametrize("kind", KINDS)
def test_files_say_what_the_log_says(kind, tmp_path, scene):
    write, suffix, text = KINDS[kind]
    files = []
    for camera in ("camera_0", "camera_1"):
        files.append(tmp_path / f"{camera}{suffix}")
        write(files[-1], frames_of(scene, camera), scene.names)
        start = repr(made.stamp_of(frames_of(scene, camera)[0]) / 1e9)
        text += f'[files."{camera}{suffix}"]\nframe = "{camera}"\n'
        if "{start}" in KINDS[kind][2]:
            text += f"time.start = {start}\n"
    (tmp_path / "map.toml").write_text(text.replace("{start}", "0.0"))
    arguments = [*map(str, files), "--mapping", str(tmp_path / "map.toml")]
    assert run(["import", *arguments, "-o", str(tmp_path / "log.mcap"), "-q"]) == 0
    with open_log(tmp_path / "log.mcap", fixed_frame="camera_0") as log:
        found = [frame for frame in log.frames() if frame.source == "camera_0"]
        assert log.model.marker_names == scene.names
        assert log.model.n_links == 31
    expected = frames_of(scene, "camera_0")
    assert len(found) == len(expected)
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_allclose(a.positions, b.positions[: a.n_people], atol=1e-9)
        assert abs(a.stamp - made.stamp_of(b)) < 1000  # ns; the text has us
        assert (a.frame_id, a.source) == ("camera_0", "camera_0")


RECIPES = {
    "openpose": ("openpose", 'axes = ["x", "z", "-y"]\n[time]\nrate = 30', 21),
    "mediapipe": ("mediapipe.json", "", 21),
    "freemocap": ("mediapipe_body_3d_xyz.csv", "[time]\nrate = 30", 21),
    "freemocap 1, rows": ("lab_by_frame.csv", "[time]\nrate = 30", 21),
    "freemocap 2, rows": ("freemocap_data_by_frame.csv", "[time]\nrate = 30", 21),
    "freemocap, times": ("lab_by_trajectory.csv", "", 21),
    "freemocap, numpy": ("mediaPipeSkel_3d_body_hands_face.npy", "[time]\nrate = 30", 21),
    "azure-kinect": ("front.json", 'axes = ["x", "z", "-y"]', 32),
    "zed": ("zed_front.json", 'axes = ["x", "z", "-y"]', 18),
    "pose2sim": ("walk_P1.trc", "", len(files.POSE2SIM)),
    "opencap": ("squat.trc", "", len(files.OPENCAP)),
    "motive": ("take.csv", "", len(files.MOTIVE)),
}
"""Detector -> what it writes, what else the mapping says, and the joints that it sees."""


@pytest.fixture(scope="module")
def written(whole_crossing, tmp_path_factory):
    """A folder with what each detector writes of the same two people."""
    folder = tmp_path_factory.mktemp("written")
    files.write_all(folder, whole_crossing)
    return folder


@pytest.mark.parametrize("detector", RECIPES)
def test_files_of_a_detector_show_the_people_where_they_were(
    detector, tmp_path, written, whole_crossing
):
    name, more, n_joints = RECIPES[detector]
    detector = re.split("[ ,]", detector)[0]
    mapping = tmp_path / "own.toml"
    mapping.write_text(f'detector = "{detector}"\n{more}\n')
    import_joints([written / name], tmp_path / "log.mcap", mapping if more else Path(detector))
    expected, markers = files.truth_of(whole_crossing)
    with open_log(tmp_path / "log.mcap") as log:
        found, names = list(log.frames()), log.model.marker_names
        assert log.model.n_links >= n_joints - 6
    assert len(found) == len(expected) == 150
    assert [f.stamp - found[0].stamp for f in found[:2]] == pytest.approx([0, 33.3e6], abs=4e5)
    for frame, true in zip(found, expected, strict=True):
        people = files.seen(true, markers, names)[: frame.n_people]
        positions = frame.positions
        if detector == "mediapipe":  # from the middle of the hips
            hips = [names.index("left_hip"), names.index("right_hip")]
            people -= people[:, hips].mean(axis=1, keepdims=True)
        assert (~np.isnan(positions[0, :, 0])).sum() == n_joints
        np.testing.assert_allclose(positions, people, atol=1e-6)


def test_people_of_two_files_in_one_frame_have_no_poses_of_cameras(tmp_path, written):
    both = [written / "walk_P1.trc", written / "walk_P2.trc"]
    import_joints(both, tmp_path / "log.mcap", Path("pose2sim"))
    summary = process(tmp_path / "log.mcap", tmp_path / "out.mcap")
    assert len(summary.people) == 2
    assert not summary.poses


def test_people_without_any_joint_are_refused(tmp_path):
    (tmp_path / "op").mkdir()
    people = '{"people": [{"pose_keypoints_2d": [], "pose_keypoints_3d": []}]}'
    (tmp_path / "op" / "a_0_keypoints.json").write_text(people)
    (tmp_path / "own.toml").write_text('detector = "openpose"\n[time]\nrate = 30\n')
    with pytest.raises(ConfigError, match="op: holds no joint"):
        import_joints([tmp_path / "op"], tmp_path / "log.mcap", tmp_path / "own.toml")


def test_files_of_a_folder_are_in_the_order_of_their_numbers(tmp_path):
    (tmp_path / "op").mkdir()
    for number in range(12):
        joints = [0.1 * number, 0, 1, 1, 1, 1, 1, 1, 0, 0, 0, 0]
        content = {"people": [{"joints": joints}]}
        (tmp_path / "op" / f"a_{number}.json").write_text(json.dumps(content))
    (tmp_path / "own.toml").write_text('names = ["A", "B", "C"]\n[time]\nrate = 10\n')
    import_joints([tmp_path / "op"], tmp_path / "log.mcap", tmp_path / "own.toml")
    with open_log(tmp_path / "log.mcap") as log:
        people = np.concatenate([frame.positions for frame in log.frames()])
    np.testing.assert_allclose(people[:, 0, 0], 0.1 * np.arange(12), atol=1e-9)
    assert people.shape == (12, 2, 3)  # nobody ever saw C


def folder_of(path, names):
    """A folder of JSON files in each of which one person stands."""
    path.mkdir()
    content = json.dumps({"people": [{"joints": [0, 0, 1.6, 1, 0, 0, 0, 1]}]})
    for name in names:
        (path / f"{name}.json").write_text(content)
    return path


@pytest.mark.parametrize("pattern", ["walk_{:012d}_keypoints", "{}", "p2_{}_3d"])
def test_the_number_of_a_file_is_its_time(pattern, tmp_path):
    numbers = [*range(7, 11), *range(99, 103)]
    folder = folder_of(tmp_path / "op", map(pattern.format, numbers))
    (tmp_path / "own.toml").write_text('names = ["A", "B"]\n[time]\nrate = 10\n')
    import_joints([folder], tmp_path / "log.mcap", tmp_path / "own.toml")
    with open_log(tmp_path / "log.mcap") as log:
        stamps = [frame.stamp / 1e9 - RELATIVE_START for frame in log.frames()]
    assert stamps == pytest.approx([0.1 * number for number in numbers], abs=1e-6)


@pytest.mark.parametrize(
    "names", [["v_0", "v_1", "other_0"], ["cam1_00", "cam1_01", "cam2_00", "cam2_01"], ["a", "1"]]
)
def test_two_series_in_a_folder_are_refused(names, tmp_path):
    folder = folder_of(tmp_path / "op", names)
    (tmp_path / "own.toml").write_text('names = ["A", "B"]\n[time]\nrate = 10\n')
    with pytest.raises(ConfigError, match=r"op: holds several series, as \S+ and \S+ show"):
        import_joints([folder], tmp_path / "log.mcap", tmp_path / "own.toml")
    assert not (tmp_path / "log.mcap").exists()


def test_a_detector_of_a_camera_has_a_frame_and_confidences_of_its_own(tmp_path, written):
    import_joints([written / "zed_front.json"], tmp_path / "log.mcap", Path("zed"))
    with open_log(tmp_path / "log.mcap", fixed_frame="zed_front") as log:
        frame = next(iter(log.frames()))
    assert frame.frame_id == "zed_front"
    assert frame.ids.tolist() == [0, 1]
    assert frame.marker_confidences == pytest.approx(0.9)
    assert frame.stamp == 1_700_000_000_000_000_000


def test_zed_writes_one_of_several_skeletons(tmp_path, whole_crossing):
    frames, markers = files.truth_of(whole_crossing)
    for count in (34, 38):
        files.zed(tmp_path / f"{count}.json", frames[:2], markers, count)
    both = [tmp_path / "34.json", tmp_path / "38.json"]
    import_joints(both, tmp_path / "log.mcap", Path("zed"))
    text = (tmp_path / "38.json").read_text().replace('"keypoint": [[', '"keypoint": [[1, 2, 3], [')
    (tmp_path / "38.json").write_text(text)
    with pytest.raises(ConfigError, match="has 39 joints .* are 18 or 34 or 38 or 70"):
        import_joints(both, tmp_path / "log.mcap", Path("zed"))


def test_people_of_a_c3d_file_become_a_log(tmp_path):
    labels = ["Anna:HEAD", "Anna:PELVIS", "Ben:HEAD", "Ben:PELVIS", "*3"]
    points = np.zeros((4, len(labels), 3))
    points[:, :, 2] = [1600.0, 800.0, 1800.0, 900.0, 0.0]
    points[3, :, 0] = 77.0
    c3d(tmp_path / "vicon.c3d", points, labels)
    assert import_joints([tmp_path / "vicon.c3d"], tmp_path / "log.mcap") == {"/vicon/skeletons": 4}
    with open_log(tmp_path / "log.mcap") as log:
        frames = list(log.frames())
        assert log.model.marker_names == ("HEAD", "PELVIS")
    assert frames[3].stamp - frames[0].stamp == pytest.approx(30e6, abs=1000)
    assert frames[0].ids.tolist() == [0, 1]
    assert frames[3].positions[1, 0].tolist() == pytest.approx([0.077, 0, 1.8])


@pytest.mark.parametrize(
    ("array", "mapping", "fault"),
    [
        (np.ones((5, 34, 3)), "[time]\nrate = 30", "has 34 joints without names, .* are 33"),
        (np.ones((5, 33)), "[time]\nrate = 30", r"should have the shape .*, is \(5, 33\)"),
        (np.ones((5, 33, 3)), "", "has no times; write their rate under"),
        (np.array([{}]), "[time]\nrate = 30", "not an array of numpy: "),
    ],
)
def test_a_faulty_array_is_refused(array, mapping, fault, tmp_path):
    np.save(tmp_path / "a.npy", array)
    (tmp_path / "own.toml").write_text(f'detector = "freemocap"\n{mapping}\n')
    with pytest.raises(ConfigError, match=f"a.npy: {fault}"):
        import_joints([tmp_path / "a.npy"], tmp_path / "log.mcap", tmp_path / "own.toml")


def test_an_imported_log_can_be_processed(tmp_path, scene):
    wide_csv(tmp_path / "a.csv", frames_of(scene, "camera_0"), scene.names)
    (tmp_path / "map.toml").write_text(KINDS["wide"][2])
    import_joints([tmp_path / "a.csv"], tmp_path / "log.mcap", tmp_path / "map.toml")
    summary = process(tmp_path / "log.mcap", tmp_path / "out.mcap")
    assert len(summary.people) == 1


def small(path, factor=1.0, times=(0.0, 0.1, 0.2)):
    """A person of three joints, 1.6 m high."""
    rows = [f"{t},0,{1.6 * factor},1,0,{0.8 * factor},1,0,0,1" for t in times]
    names = ("HEAD", "PELVIS", "FOOT_LEFT")
    head = ",".join(["time", *(f"{n}_{a}" for n in names for a in "xyz")])
    path.write_text("\n".join([head, *rows]))
    return path


@pytest.mark.parametrize(("factor", "unit"), [(1000.0, "mm"), (100.0, "cm")])
def test_a_wrong_unit_is_named_with_its_remedy(factor, unit, tmp_path):
    with pytest.raises(ConfigError, match=rf'large if its unit is m; write unit = "{unit}" in'):
        import_joints([small(tmp_path / "a.csv", factor)], tmp_path / "log.mcap")
    assert not (tmp_path / "log.mcap").exists()


def test_metres_declared_as_millimetres_are_noticed(tmp_path):
    (tmp_path / "map.toml").write_text('unit = "mm"')
    with pytest.raises(ConfigError, match='write unit = "m" in'):
        import_joints([small(tmp_path / "a.csv")], tmp_path / "log.mcap", tmp_path / "map.toml")


def test_times_from_zero_get_a_date(tmp_path):
    import_joints([small(tmp_path / "a.csv")], tmp_path / "log.mcap")
    with open_log(tmp_path / "log.mcap") as log:
        stamps = [frame.stamp for frame in log.frames()]
    assert stamps[0] == round(RELATIVE_START * 1e9)
    assert [s - stamps[0] for s in stamps] == [0, 100_000_000, 200_000_000]


def test_joints_get_other_names_and_are_linked(tmp_path):
    (tmp_path / "map.toml").write_text('[joints]\nHEAD = "Head"\n')
    import_joints([small(tmp_path / "a.csv")], tmp_path / "log.mcap", tmp_path / "map.toml")
    with open_log(tmp_path / "log.mcap") as log:
        assert log.model.marker_names == ("Head", "PELVIS", "FOOT_LEFT")
        assert log.model.n_links == 2


def test_a_joint_is_linked_to_the_nearest_one_above():
    model = linked(["l_hip", "l_ankle", "r_hip", "r_ankle", "Hips"])
    names = model.marker_names
    ends = {(names[p], names[c]) for p, c in model.links.tolist()}
    assert ends == {
        ("l_hip", "l_ankle"),
        ("r_hip", "r_ankle"),
        ("Hips", "l_hip"),
        ("Hips", "r_hip"),
    }


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ('unit = "inch"', "unit: should be 'm', 'cm' or 'mm'"),
        ('detector = "pose"', "detector: 'pose' is none of openpose, mediapipe, "),
        ('axes = ["x", "y", "-z"]', "axes: should not mirror people"),
        ('axes = ["x", "x", "z"]', "axes: should be x, y and z in some order"),
        ("colour = 3", "colour: "),
        ("unit = ", "not TOML: "),
        (
            '[columns]\nposition = "{joint}_{ax}"',
            "columns.position: should have {joint} and {axis}",
        ),
        ('[columns]\nperson = "who"', "no column who; the mapping file says"),
        ('[joints]\nA = "HEAD"\nB = "HEAD"', "joints: should give each joint another name"),
        ('[time]\ncolumn = "frame"', "no column frame; the mapping file says"),
    ],
)
def test_a_wrong_mapping_is_one_line(text, fault, tmp_path, capsys):
    (tmp_path / "map.toml").write_text(text)
    arguments = [str(small(tmp_path / "a.csv")), "--mapping", str(tmp_path / "map.toml")]
    code = run(["import", *arguments, "-o", str(tmp_path / "log.mcap"), "-q"])
    err = capsys.readouterr().err
    assert code == 2
    assert err.count("\n") == 1
    assert fault in err
    assert not (tmp_path / "log.mcap").exists()


def test_a_file_of_a_header_alone_has_its_columns(tmp_path):
    (tmp_path / "a.csv").write_text("time,person,markr,x,y,z\n")
    with pytest.raises(ConfigError, match=r"no column joint; .*: time, person, markr, x, y, z\)"):
        import_joints([tmp_path / "a.csv"], tmp_path / "log.mcap")


def test_two_files_of_one_camera_are_refused(tmp_path):
    (tmp_path / "b").mkdir()
    files = [small(tmp_path / "a.csv"), small(tmp_path / "b" / "a.csv")]
    with pytest.raises(ConfigError, match="several files are of the camera a"):
        import_joints(files, tmp_path / "log.mcap")


TALL = "time,person,joint,x,y,z\n"
TRC = (
    "PathFileType\t4\nDataRate\tNumFrames\tUnits\n30\t{n}\tm\nFrame#\tTime\t{names}\n\n"
    "1\t0.0\t0\t0\t1.6\t0\t0\t0.8\n"
)
JSON = '[{"time": 0, "people": [{"joints": {"HEAD": [0, 0, 1.6]}}]}]'


@pytest.mark.parametrize(
    ("name", "text", "mapping", "fault"),
    [
        ("a.csv", TALL + "0,0,HEAD,0,0,1\n0,0,HEAD,0,0,2\n", "", "HEAD of person 0 occurs twice"),
        ("a.csv", TALL + "0,0,HEAD,0,0,1\n", "[time]\nrate = 30", "rate is for files of one row"),
        ("a.csv", TALL + "0,0,HEAD,0,0\n", "", "line 2: has not as many cells"),
        ("a.csv", TALL + "0,0,HEAD,0,0,1,7\n", "", "line 2: has not as many cells"),
        ("a.csv", "time,HEAD_x,HEAD_y\n0,0,0\n", "", "no column HEAD_z"),
        ("a.csv", "time,HEAD_y,HEAD_z,A_x,A_y,A_z\n0,0,0,1,1,1\n", "", "no column HEAD_x"),
        ("a.csv", "time,HEAD_x,HEAD_y,HEAD_y,HEAD_z\n0,0,0,0,0\n", "", "column HEAD_y twice"),
        ("a.csv", TALL + "0,0,HEAD,1_0,0,1\n", "", "line 2: '1_0' is not a number"),
        (
            "a.csv",
            "time,person,HEAD_x,HEAD_y,HEAD_z\n0,0,0,0,1\n0,1,0,0,1\n",
            "[time]\nrate = 30",
            "a row for each person, so it needs a column with times",
        ),
        (
            "a.csv",
            "time,A_x,A_y,A_z,B_x,B_y,B_z\n0,0,0,0,0,0,1\n",
            '[joints]\nA = "B"',
            "gives the name B to a joint, but another one has it",
        ),
        ("a.csv", TALL + "0,0,HEAD,0,0,1\n", '[files."b.csv"]\nframe = "b"', "names b.csv, not"),
        ("a.csv", TALL + "0,0,HEAD,0,0,1\n", "[time]\nstart = 2026-05-01T10:00:00", "have a zone"),
        ("a.csv", TALL + "0,0,HEAD,0,0,1\n", "[time]\noffset = 1e12", "is the unit of the time"),
        ("a.csv", TALL + "0,0,HEAD,0,0,1\n", "[time]\noffset = -1e300", "is the unit of the time"),
        ("a.trc", TRC.format(n=1, names="A\t\t\tA"), "", "names the marker A twice"),
        ("a.trc", TRC.format(n=3, names="A\t\t\tB"), "", "it has 1 of the 3 frames of its line 3"),
        ("a.trc", TRC.format(n=1, names="A\t\t\tB")[:-5], "", "line 6: is cut off"),
        (
            "a.trc",
            TRC.format(n=1, names="A\t\t\tB")
            .replace("Units", "NumMarkers\tUnits")
            .replace("\tm\n", "\t40\tm\n"),
            "",
            "line 4 names 2 markers, but line 3 says 40",
        ),
        (
            "a.trc",
            TRC.format(n=1, names="A"),
            "",
            "line 6: has more numbers than the 1 markers of line 4",
        ),
        ("a.trc", TRC.format(n=1, names="A\t\t\tB"), "[time]\nrate = 30", "this one has times"),
        ("a.json", '[{"time": 0, "people": [7]}]', "", "an instant or a person is no JSON object"),
        ("a.json", JSON[:-5], "", "not JSON: "),
        ("a.json", JSON.replace('"HEAD"', '"A": [0, 0, 0], "A"'), "", "the key 'A' occurs twice"),
    ],
)
def test_what_is_wrong_is_refused(name, text, mapping, fault, tmp_path):
    (tmp_path / name).write_text(text)
    (tmp_path / "map.toml").write_text(mapping)
    with pytest.raises(ConfigError, match=re.escape(fault)):
        import_joints([tmp_path / name], tmp_path / "log.mcap", tmp_path / "map.toml")
    assert not (tmp_path / "log.mcap").exists()


def test_what_hiros_exported_comes_back_without_a_mapping(tmp_path, crossing):
    result, table, log = (tmp_path / name for name in ("result.mcap", "lab.csv", "log.mcap"))
    process(crossing, result)
    assert run(["export", str(result), "-o", str(table), "--least-confidence", "0", "-q"]) == 0
    assert import_joints([table], log) == {"/lab/skeletons": 60}
    with open_log(log) as back:
        frames, names = list(back.frames()), list(back.model.marker_names)
    exported = open_result(result)
    slots = [names.index(name) for name in exported.model.marker_names]
    assert len(exported.motions) == 2
    for motion in exported.motions.values():
        rows = [(f, f.ids.tolist().index(motion.person)) for f in frames if motion.person in f.ids]
        positions = np.stack([frame.positions[row] for frame, row in rows])[:, slots]
        sure = np.stack([frame.marker_confidences[row] for frame, row in rows])[:, slots]
        assert positions == pytest.approx(motion.positions, abs=1e-6, nan_ok=True)
        assert sure == pytest.approx(motion.confidences, abs=1e-6, nan_ok=True)


def test_a_start_with_a_zone_means_the_same_everywhere(tmp_path):
    (tmp_path / "map.toml").write_text("[time]\nstart = 2026-05-01T10:00:00+02:00\n")
    import_joints([small(tmp_path / "a.csv")], tmp_path / "log.mcap", tmp_path / "map.toml")
    with open_log(tmp_path / "log.mcap") as log:
        first = next(iter(log.frames())).stamp
    assert first == datetime(2026, 5, 1, 8, tzinfo=UTC).timestamp() * 1e9


def test_a_last_line_without_an_end_may_be_cut_off(tmp_path, capsys):
    path = small(tmp_path / "a.csv")
    arguments = ["import", str(path), "-o", str(tmp_path / "log.mcap"), "-q"]
    assert run(arguments) == 0
    assert (
        "a.csv: its last line has no end; if a number in it is cut off" in capsys.readouterr().err
    )
    path.write_text(path.read_text() + "\n")
    assert run([*arguments, "--force"]) == 0
    assert capsys.readouterr().err == ""


def test_joints_of_a_trc_file_get_other_names(tmp_path):
    (tmp_path / "a.trc").write_text(TRC.format(n=1, names="A\t\t\tB"))
    (tmp_path / "map.toml").write_text('[joints]\nA = "HEAD"\n')
    import_joints([tmp_path / "a.trc"], tmp_path / "log.mcap", tmp_path / "map.toml")
    with open_log(tmp_path / "log.mcap") as log:
        assert log.model.marker_names == ("HEAD", "B")


def test_a_name_that_is_no_text_is_refused(tmp_path):
    path = small(tmp_path / os.fsdecode(b"\xff.csv"))
    with pytest.raises(ConfigError, match="name the camera in the mapping file"):
        import_joints([path], tmp_path / "log.mcap")
