"""Exported files, read back by programs that know nothing of hiros."""

from __future__ import annotations

import errno
import json
import subprocess
import sys
import warnings
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from hiros_cli.app import run
from hiros_mcap.errors import ConfigError, LogError
from hiros_mcap.evaluate.truth_files import read_mocap
from hiros_mcap.events import Event
from hiros_mcap.io.channels import add_skeleton_channel
from hiros_mcap.io.codec import Encoder
from hiros_mcap.io.container import ChunkCopier, McapReader, McapWriter
from hiros_mcap.io.export.biomechanics import tree_of
from hiros_mcap.io.export.files import FORMATS, export, files_of, load_marker_set, steady
from hiros_mcap.io.joints.marker_files import read_c3d
from hiros_mcap.io.result import Motion, Result, open_result
from hiros_mcap.regression.suite import write_golden
from hiros_mcap.running.pipeline import ProcessOptions, process
from hiros_mcap.simulate import SimulateParams
from hiros_mcap.simulate.body_model import MODEL
from hiros_mcap.simulate.simulation import write_log
from hiros_mcap.skeletons import Frame, SkeletonModel


@pytest.fixture(scope="module")
def log(crossing, tmp_path_factory):
    out = tmp_path_factory.mktemp("export") / "crossing.hiros.mcap"
    process(crossing, out)
    return out


@pytest.fixture(scope="module")
def result(log):
    return open_result(log)


def test_the_result_is_the_last_stage_of_everybody(result):
    assert (result.channel, result.people) == ("/hiros/filtered", (0, 1))
    assert repr(result) == (
        "<Result crossing.hiros.mcap /hiros/filtered: 2 people, 2.0 s, 32 markers>"
    )
    joints = result.joints()
    assert joints.index.names == ["person", "time"]
    knee = joints.loc[0, "KNEE_LEFT"].to_numpy()
    slot = result.model.marker_names.index("KNEE_LEFT")
    np.testing.assert_array_equal(knee, result.motions[0].positions[:, slot])
    assert "track born" in set(result.events()["kind"])


def test_what_is_no_result_is_refused(crossing, log):
    with pytest.raises(LogError, match="holds no results of hiros"):
        open_result(crossing)
    with pytest.raises(ConfigError, match="no channel '/hiros/x'"):
        open_result(log, "/hiros/x")


def test_resampling_keeps_pauses():
    times = np.concatenate([np.arange(0, 1, 0.1), np.arange(2, 3, 0.1)])
    motion = Motion(0, times, np.repeat(times, 3).reshape(-1, 1, 3), np.ones((20, 1)))
    fine = motion.at(np.arange(0, 2.9, 0.05))
    known = ~np.isnan(fine.positions[:, 0, 0])
    assert not known[(fine.times > 0.91) & (fine.times < 1.99)].any()
    np.testing.assert_allclose(fine.positions[known, 0, 0], fine.times[known], atol=1e-9)


@pytest.mark.parametrize(
    ("stamps", "words"),
    [([0, 0, 0, 1], "twice at one time"), ([0, 1, 2, 10**9], "--start and --end")],
)
def test_instants_without_a_rate_are_refused_and_others_are_put_in_order(stamps, words, tmp_path):
    encoder = Encoder(MODEL)
    for name, times in (("odd", stamps), ("late", [3, 1, 2, 0])):
        with McapWriter(tmp_path / name) as writer:
            channel = add_skeleton_channel(writer, "/hiros/tracked")
            for log_time, stamp in enumerate(times):
                frame = Frame.empty(1, MODEL, stamp=(100 + stamp) * 10**8, frame_id="world")
                place = 1 + (stamp if name == "late" else log_time)
                frame.ids[:], frame.markers[..., :3] = 0, place
                writer.write(channel, log_time, encoder.encode(frame))
            writer.commit()
    with pytest.raises(ConfigError, match=words):
        steady(open_result(tmp_path / "odd"))
    late = steady(open_result(tmp_path / "late")).motions[0]
    np.testing.assert_allclose(late.positions[:, 0, 0], [1, 2, 3, 4], atol=1e-9)


def test_parts_can_be_selected(result):
    part = result.select(person=1, start=1.0, end=2.0, rate=100.0)
    (motion,) = part.motions.values()
    assert motion.person == 1
    assert 1.0 <= motion.times[0] < motion.times[-1] <= 2.0
    np.testing.assert_allclose(np.diff(motion.times), 0.01, atol=1e-9)
    for bad in ({"person": 7}, {"start": 100.0}, {"rate": 0.0}):
        with pytest.raises(ConfigError):
            result.select(**bad)


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_tables_come_back(suffix, result, tmp_path):
    (path,) = export(result, tmp_path / f"out{suffix}", "both")
    table = pd.read_csv(path) if suffix == ".csv" else pd.read_parquet(path)
    mine = table[table["person"] == 1]
    x = mine["HEAD x (m)"].to_numpy()
    np.testing.assert_allclose(x, result.joints().loc[1, ("HEAD", "x")], atol=1e-6)
    assert "left knee flexion (deg)" in table
    slot = result.model.marker_names.index("HEAD")
    confidence = result.motions[1].confidences[:, slot]
    np.testing.assert_allclose(mine["HEAD confidence"], confidence, atol=1e-6)
    deviations = result.motions[1].deviations
    assert deviations is not None
    np.testing.assert_allclose(mine["HEAD SD (m)"], deviations[:, slot], atol=1e-6)


def test_tables_say_from_how_many_cameras_somebody_is_hidden(result, tmp_path):
    """Person 1 from one camera, then from two, as the events say; person 0 never."""
    happened = [
        Event(result.start + round(begin * 1e9), "hidden", 1, camera, f"behind person 0 for {s} s")
        for begin, camera, s in ((0.5, "a", 1.0), (1.0, "b", 0.5))
    ]
    marked = replace(result, happened=(*happened, Event(result.start, "track born", 1, "a", "")))
    (path,) = export(marked, tmp_path / "out.csv")
    table = pd.read_csv(path).set_index(["person", "time (s)"])["hidden from (cameras)"]
    assert not table[0].any()
    for time, expected in ((0.4, 0), (0.7, 1), (1.3, 2), (1.7, 0)):
        nearest = abs(table[1].index - time).argmin()
        assert table[1].iloc[nearest] == expected
    (path,) = export(marked, tmp_path / "out.jsonl")
    rows = [json.loads(line) for line in path.read_text().splitlines()]
    assert [row["hidden from (cameras)"] for row in rows if row["person"] == 1] == table[1].tolist()


def test_json_lines_have_names_and_gaps(result, tmp_path):
    result.motions[0].positions[3, 5] = np.nan
    (path,) = export(result, tmp_path / "out.jsonl")
    rows = [json.loads(line) for line in path.read_text().splitlines()]
    name, motion = result.model.marker_names[5], result.motions[0]
    assert (rows[3]["person"], rows[3]["time (s)"]) == (0, pytest.approx(motion.times[3], abs=1e-6))
    assert rows[3][f"{name} x (m)"] is None
    assert rows[2][f"{name} y (m)"] == pytest.approx(motion.positions[2, 5, 1], abs=1e-6)
    confidence = motion.confidences[2, 5]
    assert rows[2][f"{name} confidence"] == pytest.approx(confidence, abs=1e-6)
    assert 0 < rows[2][f"{name} SD (m)"] < 0.1


def test_a_trc_file_is_a_truth_that_the_result_equals(log, result, tmp_path, capsys):
    (path,) = export(result.select(person=0), tmp_path / "out.trc")
    motion = steady(result.select(person=0)).motions[0]
    read = read_mocap(path)
    np.testing.assert_allclose(read.positions[:, 0, 0, 1], motion.positions[:, 0, 2], atol=1e-6)
    arguments = ["--truth", str(path), "--up", "y", "--channel", "/hiros/filtered", "--json"]
    assert run(["eval", str(log), *arguments]) == 0
    assert json.loads(capsys.readouterr().out)["channels"]["/hiros/filtered"]["mean"] < 1.0


def test_opensim_reads_angles_in_degrees(result, tmp_path):
    paths = export(result, tmp_path / "out.mot", warn=len)
    assert [path.name for path in paths] == ["out.0.mot", "out.1.mot"]
    table = pd.read_csv(paths[1], sep="\t", skiprows=7)
    knee = steady(result).angles().loc[1, "right knee flexion"]
    np.testing.assert_allclose(table["knee_angle_r"], knee, atol=5)
    assert 0.7 < table["pelvis_ty"].mean() < 1.3


def test_c3d_is_read_by_another_library(result, tmp_path):
    import c3d

    (path,) = export(result, tmp_path / "out.c3d", "joints")
    with path.open("rb") as file, warnings.catch_warnings(action="ignore"):
        reader = c3d.Reader(file)
        labels = [label.strip() for label in reader.point_labels]
        frames = [points for _, points, _ in reader.read_frames()]
    where = labels.index("1:HEAD")
    head = result.motions[1].at(np.array([frames_time(result, 30, 30.0)])).positions
    slot = result.model.marker_names.index("HEAD")
    np.testing.assert_allclose(frames[30][where, :3], 1000 * head[0, slot], atol=0.5)
    assert reader.point_rate == 30.0


def frames_time(result, frame, rate):
    return float(min(m.times[0] for m in result.motions.values()) + frame / rate)


def test_c3d_of_more_frames_than_it_counts_is_one_line_with_the_remedy(tmp_path, capsys):
    write_truth(tmp_path / "truth.mcap", np.arange(0, 66.1, 0.1))
    arguments = ["export", str(tmp_path / "truth.mcap"), "-o", str(tmp_path / "a.c3d"), "-q"]
    assert run([*arguments, "--rate", "1000"]) == 2
    assert "at most 65535 frames, and this would have 6" in (error := capsys.readouterr().err)
    assert "choose a part with --start and --end, a lower --rate, or another format" in error
    assert not (tmp_path / "a.c3d").exists()
    assert run([*arguments, "--rate", "900"]) == 0


def write_truth(path, times):
    """Write the truth of one joint of one person, who stands."""
    model = SkeletonModel.of(["HEAD"], [])
    encoder = Encoder(model)
    with McapWriter(path) as writer:
        channel = add_skeleton_channel(writer, "/truth/skeletons")
        for time in np.round(1e9 * times).astype(int).tolist():
            frame = Frame.empty(1, model, stamp=time, source="truth", frame_id="world")
            frame.ids[:], frame.markers[..., :3], frame.marker_confidences[:] = 0, 1.0, 1.0
            writer.write(channel, time, encoder.encode(frame))
        writer.commit()


def test_c3d_says_which_points_are_angles(result, tmp_path):
    import ezc3d

    (path,) = export(result, tmp_path / "out.c3d", "both")
    file = ezc3d.c3d(str(path))
    point = file["parameters"]["POINT"]
    angles = point["ANGLES"]["value"]
    assert point["ANGLE_UNITS"]["value"] == ["deg"]
    assert len(angles) == 2 * len(result.angles().columns)
    assert not {name for name in angles if "KNEE_LEFT" in name}
    where = point["LABELS"]["value"].index("1:left knee flexion")
    knee = steady(result).angles().loc[1, "left knee flexion"].to_numpy()
    np.testing.assert_allclose(file["data"]["points"][0, where, : len(knee)], knee, atol=0.01)


def uncertain(result):
    """Nobody sees the left knee of person 0 for half a second."""
    motion = result.motions[0]
    confidences = motion.confidences.copy()
    confidences[40:55, result.model.marker_names.index("KNEE_LEFT")] = 0.05
    motions = {**result.motions, 0: replace(motion, confidences=confidences)}
    return replace(result, motions=motions)


def test_what_nobody_saw_is_a_gap_unless_it_is_asked_for(result, tmp_path):
    for least, gaps in ((0.1, 15), (0.0, 0), (0.04, 0)):
        (path,) = export(uncertain(result), tmp_path / "out.csv", least_confidence=least)
        table = pd.read_csv(path)
        mine = table[table["person"] == 0]
        assert mine["KNEE_LEFT x (m)"].isna().sum() == gaps
        assert mine["HEAD x (m)"].notna().all()
        assert mine["KNEE_LEFT confidence"].notna().all()
        # The angle is a gap, too, and so are those of every format.
        assert mine["left knee flexion (deg)"].isna().sum() == gaps
    (path,) = export(uncertain(result).select(person=0), tmp_path / "out.trc")
    assert "\t\t\t\t" in path.read_text().split("\n", 6)[-1]


def test_tables_in_python_have_the_gaps_of_files(result):
    doubtful = uncertain(result)
    assert doubtful.joints().loc[0, ("KNEE_LEFT", "x")].isna().sum() == 15
    assert doubtful.angles()["left knee flexion"].isna().sum() == 15
    everything = doubtful.joints(least_confidence=0)
    np.testing.assert_array_equal(everything.loc[0, "KNEE_LEFT"].notna().all(axis=1), True)
    assert (doubtful.confidences()["KNEE_LEFT"] == 0.05).sum() == 15


def test_tables_of_nobody_have_the_columns_of_somebody_and_no_row(result):
    nobody = replace(result, motions={})
    for table in (Result.joints, Result.confidences, Result.angles):
        assert table(nobody).columns.equals(table(result).columns)
        assert len(table(nobody)) == 0


def test_warnings_of_export_reach_the_user(log, tmp_path, capsys, monkeypatch):
    faceless = open_result(log)
    names = [name.replace("WRIST", "GRIP") for name in faceless.model.marker_names]
    renamed = replace(faceless, model=replace(faceless.model, marker_names=tuple(names)))
    monkeypatch.setattr("hiros_mcap.io.result.open_result", lambda *_: renamed)
    assert run(["export", str(log), "-o", str(tmp_path / "out.mot"), "--person", "0", "-q"]) == 0
    assert "hiros: warning: " in (err := capsys.readouterr().err)
    assert "left out arm_add_l" in err


NASTY = "=KNEE\tLEFT\n{"


def test_c3d_of_more_people_than_a_byte_counts_angles(tmp_path):
    """Seven people have 273 angles, and 255 is the most that one parameter names."""
    write_log(tmp_path / "sim.mcap", SimulateParams(seconds=1, cameras=1, people=7))
    truth_only(tmp_path / "sim.mcap", tmp_path / "truth.mcap")
    path = tmp_path / "out.c3d"
    assert run(["export", str(tmp_path / "truth.mcap"), "-o", str(path), "-q"]) == 0
    markers = read_c3d(path)
    assert markers.people == tuple("0123456")
    assert not [name for name in markers.names if "flexion" in name]
    assert len(markers.names) == 32


@pytest.mark.parametrize("suffix", [".csv", ".trc", ".bvh", ".jsonl", ".c3d"])
def test_no_marker_name_breaks_a_file(suffix, result, tmp_path):
    names = [NASTY if n == "KNEE_LEFT" else n for n in result.model.marker_names]
    named = replace(result, model=replace(result.model, marker_names=tuple(names)))
    (path,) = export(named.select(person=0), tmp_path / f"out{suffix}", "joints")
    (plain,) = export(result.select(person=0), tmp_path / f"plain{suffix}", "joints")
    if suffix == ".c3d":
        import ezc3d

        assert "_KNEE_LEFT_{" in ezc3d.c3d(str(path))["parameters"]["POINT"]["LABELS"]["value"]
        return
    text, expected = path.read_text(), plain.read_text()
    assert "=KNEE" not in text
    assert "_KNEE_LEFT_" in text
    assert text.count("\n") == expected.count("\n")
    assert text.count("\t") == expected.count("\t")
    assert text.count("{") == expected.count("{") or suffix != ".bvh"


def test_nobody_has_a_file_if_that_of_another_person_cannot_be_written(
    result, tmp_path, monkeypatch
):
    kind = FORMATS[".trc"]

    def full(*arguments):
        if "out.1" in arguments[0].path.name:
            raise OSError(errno.ENOSPC, "No space left on device")
        kind.write(*arguments)

    monkeypatch.setitem(FORMATS, ".trc", replace(kind, write=full))
    with pytest.raises(LogError, match=r"out\.1\.trc: cannot be written: No space left"):
        export(result, tmp_path / "out.trc")
    assert list(tmp_path.iterdir()) == []


LIMITED = """
import resource, sys
from hiros_cli.app import run
resource.setrlimit(resource.RLIMIT_FSIZE, (40960, 40960))
print(*(run(["export", sys.argv[1], "-o", path]) for path in sys.argv[2:]))
"""


def test_a_file_beyond_a_limit_of_size_is_one_error(log, tmp_path):
    faults = dict.fromkeys((".csv", ".parquet", ".jsonl"), "File too large")
    faults[".c3d"] = "the file was cut"
    done = subprocess.run(
        [sys.executable, "-c", LIMITED, log, *(tmp_path / f"out{suffix}" for suffix in faults)],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.stdout == "2 2 2 2\n", done.stderr
    for line, (suffix, fault) in zip(done.stderr.splitlines(), faults.items(), strict=True):
        assert f"out{suffix}: cannot be written: " in line and fault in line
    assert list(tmp_path.glob("*out*")) == []


def test_bvh_is_read_by_another_library_and_stands_where_the_person_stood(result, tmp_path):
    from bvh import Bvh

    (path,) = export(result.select(person=0), tmp_path / "out.bvh")
    read = Bvh(path.read_text())
    assert read.frame_time == pytest.approx(1 / 30, abs=1e-6)
    motion = result.motions[0].at(np.array([result.motions[0].times[0]]))
    x, _, z = motion.positions[0, 0]
    assert read.frame_joint_channel(0, "PELVIS", "Xposition") == pytest.approx(100 * x, abs=0.1)
    assert read.frame_joint_channel(0, "PELVIS", "Yposition") == pytest.approx(100 * z, abs=0.1)
    thigh = np.linalg.norm(read.joint_offset("KNEE_LEFT"))
    assert 35 < thigh < 50


@pytest.mark.parametrize(
    ("links", "root"),
    [
        ([(0, 1), (0, 2), (2, 3)], 0),
        ([(2, 3), (1, 2), (1, 0)], 1),  # in any order
        ([(0, 1), (2, 3)], None),  # two trees
        ([(0, 1), (0, 2), (1, 3), (2, 3)], None),  # two ways to one joint
        ([(0, 1), (1, 2), (2, 0)], None),  # a ring
        ([], None),
    ],
)
def test_links_form_a_tree_or_are_refused(links, root):
    model = SkeletonModel.of("abcd", [(f"{p}{c}", p, c) for p, c in links])
    if root is None:
        with pytest.raises(ConfigError, match="form a tree with one root"):
            tree_of(model)
        return
    found, tree = tree_of(model)
    assert found == root
    assert sorted((p, c) for p, children in tree.items() for c in children) == sorted(links)


@pytest.mark.parametrize("suffix", FORMATS)
def test_every_format_from_the_command_line(suffix, log, tmp_path, capsys):
    target = tmp_path / f"out{suffix}"
    assert run(["export", str(log), "-o", str(target), "--start", "0.5", "--end", "1"]) == 0
    paths = files_of(target, (0, 1))
    assert all(path.stat().st_size > 100 for path in paths)
    assert capsys.readouterr().out == "".join(f"wrote {path}\n" for path in paths)
    assert run(["export", str(log), "-o", str(target), "--end", "0.5", "-q"]) == 0  # our own
    assert sorted(tmp_path.iterdir()) == sorted(paths)
    paths[0].write_bytes(b"what somebody else wrote" * 1000)
    assert run(["export", str(log), "-o", str(target)]) == 2
    assert "is not an export of hiros; --force overwrites it" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "fault"),
    [
        (["-o", "out.xls"], "ends in none of .csv"),
        (["-o", "out.trc", "--what", "angles"], "holds no angles"),
        (["-o", "out.csv", "--what", "bones"], "none of joints, angles, both"),
        (["-o", "out.csv", "--person", "9"], "no person 9"),
        (["-o", "out.csv", "--start", "99"], "there is nobody in /hiros/filtered from 99 s on"),
    ],
)
def test_faults_in_one_line(arguments, fault, log, tmp_path, monkeypatch, capsys):  # fmt: skip
    monkeypatch.chdir(tmp_path)
    assert run(["export", str(log), *arguments]) == 2
    error = capsys.readouterr().err
    assert fault in error
    assert error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", FORMATS)
def test_process_names_export_instead_of_writing_mcap_under_another_name(
    suffix, walking, tmp_path, capsys
):
    target = tmp_path / f"out{suffix}"
    assert run(["process", str(walking), "-o", str(target)]) == 2
    assert "run hiros export on its result" in capsys.readouterr().err
    assert not target.exists()


def test_process_writes_mcap_under_no_other_suffix(walking, tmp_path, capsys):
    assert run(["process", str(walking), "-o", str(tmp_path / "out.txt")]) == 2
    assert f"name it {tmp_path / 'out.mcap'}" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


SET = 'SHOULDER_LEFT = "LSJC"\nKNEE_RIGHT = "RKJC"\n'


@pytest.mark.parametrize("suffix", [".trc", ".c3d"])
def test_markers_take_the_names_of_a_model(suffix, log, result, tmp_path):
    (tmp_path / "set.toml").write_text(SET)
    target = tmp_path / f"out{suffix}"
    arguments = ["--person", "0", "--marker-set", str(tmp_path / "set.toml"), "-q"]
    assert run(["export", str(log), "-o", str(target), *arguments]) == 0
    if suffix == ".trc":
        assert target.read_text().splitlines()[3].split() == ["Frame#", "Time", "LSJC", "RKJC"]
        slot = result.model.marker_names.index("KNEE_RIGHT")
        positions = read_mocap(target).positions[:, 0, 1]
        own = steady(result.select(person=0)).motions[0].positions
        np.testing.assert_allclose(positions[:, 1], own[:, slot, 2], atol=1e-6)
    else:
        import ezc3d

        assert ezc3d.c3d(str(target))["parameters"]["POINT"]["LABELS"]["value"] == ["LSJC", "RKJC"]


@pytest.mark.parametrize(
    "names", [("SHOULDER_LEFT", "ANKLE_RIGHT"), ("ShoulderLeft", "AnkleRight"), ("lshoulder", "x")]
)
def test_the_built_in_set_knows_the_names_of_any_detector(names):
    found = load_marker_set("rajagopal", SkeletonModel.of([*names, "Head"], ()))
    expected = {names[0]: "LSJC", names[1]: "RAJC"}
    assert found == {ours: expected[ours] for ours in found}
    assert names[0] in found or "x" in names


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("KNIE_LEFT = 'LKJC'", "the log has no marker KNIE_LEFT"),
        ("KNEE_LEFT = 'A'\nKNEE_RIGHT = 'A'", "gives two markers the same name"),
        ("KNEE_LEFT = 3", "KNEE_LEFT has no name"),
        ("", "names no marker"),
        ("not toml", "not TOML: "),
    ],
)
def test_wrong_marker_sets_in_one_line(text, fault, log, tmp_path, capsys):
    (tmp_path / "set.toml").write_text(text)
    arguments = ["-o", str(tmp_path / "out.trc"), "--marker-set", str(tmp_path / "set.toml")]
    assert run(["export", str(log), *arguments]) == 2
    error = capsys.readouterr().err
    assert fault in error
    assert error.count("\n") == 1
    assert not (tmp_path / "out.trc").exists()


def test_golden_logs_truths_and_results_without_input_are_results(log, crossing, tmp_path):
    process(crossing, tmp_path / "bare.mcap", options=ProcessOptions(keep=()))
    write_golden(log, tmp_path / "golden.mcap")
    write_log(tmp_path / "sim.mcap", SimulateParams(seconds=0.5, cameras=1))
    truth_only(tmp_path / "sim.mcap", tmp_path / "truth.mcap")
    full = open_result(log)
    for name in ("bare.mcap", "golden.mcap"):
        part = open_result(tmp_path / name)
        assert part.people == full.people
        assert part.motions[0].times[0] == 0.0
        assert part.seconds == pytest.approx(full.seconds, abs=0.1)
    truth = open_result(tmp_path / "truth.mcap")
    assert (truth.channel, truth.people) == ("/truth/skeletons", (0,))
    with pytest.raises(LogError, match="run `hiros process` first"):
        open_result(tmp_path / "sim.mcap")


def truth_only(source, target):
    with McapReader(source) as reader, McapWriter(target) as writer:
        (truth,) = (i for i, c in reader.channels.items() if c.topic.startswith("/truth"))
        ChunkCopier(reader, writer, [truth]).finish()
        writer.commit()


def test_resampling_turns_links_the_short_way():
    times = np.arange(0, 1, 0.1)
    half = np.pi * times / 2
    turns = np.stack([0 * half, 0 * half, np.sin(half), np.cos(half)], axis=-1)[:, None]
    turns[::2] *= -1  # the same rotations
    motion = Motion(0, times, np.zeros((10, 1, 3)), np.ones((10, 1)), turns)
    fine = motion.at(np.linspace(0, 0.9, 19))
    assert fine.orientations is not None
    found = 2 * np.arctan2(*np.moveaxis(fine.orientations[:, 0, 2:], -1, 0))
    np.testing.assert_allclose(np.unwrap(found) - found[0], np.pi * fine.times, atol=1e-3)


def test_the_rate_and_the_part_do_not_change_the_angles(result):
    whole, part = result.angles(), result.select(person=0, start=1.0, end=2.0).angles()
    pd.testing.assert_frame_equal(whole.loc[part.index], part)
    fine = result.select(person=0, rate=200.0).angles()["left hip flexion"].loc[0]
    coarse = whole.loc[0]["left hip flexion"]
    between = np.interp(coarse.index, fine.index, fine)
    np.testing.assert_allclose(between[:-1], coarse[:-1], atol=0.5)
