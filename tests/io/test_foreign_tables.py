"""TRC, CSV, C3D and JSON as other programs and people save them, for ``import`` and as a truth."""

from __future__ import annotations

import csv
import json
import struct

import ezc3d
import numpy as np
import pandas as pd
import pytest
from detector_files import motive_text

from hiros_cli.app import run
from hiros_mcap.errors import ConfigError
from hiros_mcap.evaluate.truth_files import load_truth
from hiros_mcap.io.detectors.body_models import joints_of
from hiros_mcap.io.joints.importing import RELATIVE_START, import_joints
from hiros_mcap.io.joints.marker_files import read_c3d, read_trc
from hiros_mcap.io.log import open_log
from hiros_mcap.skeletons import Frame

NAMES = ("PELVIS", "HEAD", "Left Knee")
POINTS = np.array([[[0.1 * k, 0.9, 0], [0.1 * k, 1.6, 0], [0.1 * k, 0.5, 0.1]] for k in range(6)])
"""(instants, joints, 3) m."""


def trc(
    unit="mm", scale=1000.0, between="\t", point=".", keys=None, values=None, axes=True, rows=None
):
    """A TRC file of POINTS, 30 Hz."""
    keys = keys or between.join(["DataRate", "CameraRate", "NumFrames", "NumMarkers", "Units"])
    lines = ["PathFileType\t4", keys, values or between.join(["30", "30", "6", "3", unit])]
    joints = [cell for name in NAMES for cell in (name, "", "")]
    lines.append(between.join(["Frame#", "Time", *joints]))
    lines += [between * 2 + between.join(f"{a}{k}" for k in (1, 2, 3) for a in "XYZ"), ""] * axes
    for k in range(6) if rows is None else rows:
        numbers = [f"{v:.6f}" for v in (k / 30, *(scale * POINTS[k]).ravel())]
        lines.append(between.join([str(k + 301), *numbers]).replace(".", point))
    return "\n".join(lines) + "\n"


def imported(path, mapping=None, warn=lambda text: None):
    """Frames of an imported file, by camera."""
    import_joints([path], path.with_suffix(".mcap"), mapping, warn)
    frames: dict[str, list[Frame]] = {}
    with open_log(path.with_suffix(".mcap")) as log:
        for frame in log.frames():
            frames.setdefault(frame.source, []).append(frame)
    return frames


def assert_same(frames, points=POINTS):
    found = np.stack([frame.positions[0] for frame in frames])
    assert found == pytest.approx(points, abs=1e-6)


def assert_times(frames, begin):
    """8 Hz from there on, s; the texts have us."""
    stamps = [frame.stamp - round(begin * 1e9) for frame in frames]
    assert stamps == pytest.approx([k * 125_000_000 for k in range(6)], abs=1000)


EIGHT = "DataRate\tCameraRate\tNumFrames\tNumMarkers\t\tUnits\tOrigDataRate\tOrigNumFrames"
FOREIGN_TRC = {
    "blanks in the header": trc(keys=EIGHT, values="30\t \t30\t \t6\t \t3\tmm\t30\t6"),
    "blanks for tabs in a line": trc(keys=EIGHT, values="30\t30\t6\t3\tmm   30.0  6"),
    "decimal commas": trc(point=","),
    "semicolons and decimal commas": trc(between=";", point=","),
    "commas": trc(between=","),
    "blanks": trc(between=" ").replace("Left Knee", "Knee"),
    "header with tabs, rows with blanks": trc(between=" ").replace(
        "Frame# Time PELVIS   HEAD   Left Knee", "Frame#\tTime\tPELVIS\t\t\tHEAD\t\t\tLeft Knee"
    ),
    "no line of axes, no blank line": trc(axes=False),
    "a long unit": trc(unit="Millimeters"),
    "quoted": trc().replace("\tmm", '\t"mm"').replace("PathFileType", '"PathFileType"'),
    "UTF-16": trc().encode("utf-16"),
}


@pytest.mark.parametrize("kind", FOREIGN_TRC)
def test_trc_of_other_programs_is_read(kind, tmp_path):
    text = FOREIGN_TRC[kind]
    path = tmp_path / "a.trc"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    assert_same(imported(path)["a"])
    assert load_truth(path).positions[:, 0] == pytest.approx(POINTS, abs=1e-6)


def test_a_trc_file_of_one_instant_without_a_line_of_axes_is_read(tmp_path):
    path = tmp_path / "one.trc"
    path.write_text(trc(axes=False, values="30\t30\t1\t3\tmm", rows=[0]))
    markers = read_trc(path)
    assert markers.positions[:, 0] == pytest.approx(POINTS[:1], abs=1e-6)


def test_trajectories_without_a_name_are_left_out_of_a_trc_file(tmp_path):
    (tmp_path / "a.trc").write_text(trc().replace("\tHEAD\t", "\t*60\t"))
    assert_same(imported(tmp_path / "a.trc")["a"], POINTS[:, [0, 2]])
    assert load_truth(tmp_path / "a.trc").model.marker_names == ("PELVIS", "Left Knee")


def test_rows_that_are_missing_in_a_trc_file_are_a_pause(tmp_path):
    (tmp_path / "a.trc").write_text(trc(rows=[0, 1, 4, 5]))
    frames = imported(tmp_path / "a.trc")["a"]
    assert_same(frames, POINTS[[0, 1, 4, 5]])
    assert frames[2].stamp - frames[1].stamp == pytest.approx(0.1e9, abs=1e4)


def test_a_header_that_counts_one_row_too_many_is_doubtful_and_two_an_error(tmp_path):
    warnings: list[str] = []
    (tmp_path / "a.trc").write_text(trc(rows=range(5)))
    assert len(imported(tmp_path / "a.trc", None, warnings.append)["a"]) == 5
    assert "5 of the 6 frames of its line 3; unless NumFrames is wrong" in warnings[0]
    (tmp_path / "a.trc").write_text(trc(rows=range(4)))
    with pytest.raises(ConfigError, match="cut off: it has 4 of the 6 .* or correct NumFrames"):
        imported(tmp_path / "a.trc")


@pytest.mark.parametrize(
    ("values", "fault"),
    [
        ("30\t30\t-1\t3\tmm", "line 3: NumFrames is -1, which counts nothing; correct it"),
        ("30\t30\t1e9\t3\tmm", "is cut off: it has 6 of the 1000000000 frames"),
        ("30\t30\tnan\t3\tmm", "line 3: NumFrames is nan, which counts nothing"),
        ("30\t30\t6\t-3\tmm", "line 3: NumMarkers is -3, which counts nothing"),
        ("30\t30\t6\t1e9\tmm", "line 4 names 3 markers, but line 3 says 1000000000"),
    ],
)
def test_numbers_of_a_trc_file_that_count_nothing_are_refused(values, fault, tmp_path):
    (tmp_path / "a.trc").write_text(trc(values=values))
    with pytest.raises(ConfigError, match=fault):
        read_trc(tmp_path / "a.trc")


@pytest.mark.parametrize("values", ["nan\t30\t6\t3\tmm", "30\tinf\t6\t3\tmm", "30\t30\t\t\tmm"])
def test_rates_that_are_no_number_and_counts_that_are_empty_change_nothing(values, tmp_path):
    (tmp_path / "a.trc").write_text(trc(values=values))
    assert_same(imported(tmp_path / "a.trc")["a"])


def test_commas_that_are_decimal_and_between_cells_are_one_line_with_the_remedy(tmp_path):
    (tmp_path / "a.trc").write_text(trc(between=",", point=","))
    with pytest.raises(ConfigError, match="more numbers .* separate the cells by tabs"):
        imported(tmp_path / "a.trc")


@pytest.mark.parametrize("suffix", [".trc", ".c3d"])
def test_the_unit_of_a_mapping_wins_and_the_error_names_it(suffix, tmp_path, capsys):
    path = tmp_path / f"a{suffix}"
    path.write_text(trc(scale=1.0)) if suffix == ".trc" else c3d(path, POINTS, NAMES)
    arguments = ["import", str(path), "-o", str(tmp_path / "a.mcap"), "-q"]
    assert run(arguments) == 2
    fault = capsys.readouterr().err
    assert 'is mm, as the file says; write unit = "m" in the mapping file (--mapping)' in fault
    (tmp_path / "map.toml").write_text('unit = "m"')
    assert_same(imported(path, tmp_path / "map.toml")["a"])


def table(names=NAMES, scale=1.0):
    """A row per instant."""
    columns = [f"{name}_{axis}" for name in names for axis in "xyz"]
    rows = pd.DataFrame(scale * POINTS.reshape(6, -1), columns=columns)
    rows.insert(0, "time", np.arange(6) / 8)
    return rows


DATES = pd.Timestamp("2024-05-03 10:00:00") + pd.to_timedelta(np.arange(6) / 8, unit="s")
UNITS = ",".join(["s", *["mm"] * 9])
FOREIGN_CSV = {
    "semicolons and decimal commas": table().to_csv(index=False, sep=";", decimal=","),
    "decimal commas in quotes": table().to_csv(index=False, decimal=","),
    "tabs": table().to_csv(index=False, sep="\t"),
    "tabs in UTF-16": table().to_csv(index=False, sep="\t", decimal=",").encode("utf-16"),
    "a line for Excel": "sep=;\n" + table().to_csv(index=False, sep=";"),
    "rows without cells": table().to_csv(index=False) + "," * 9 + "\n",
    "a line of units": table(scale=1000).to_csv(index=False).replace("\n", f"\n{UNITS}\n", 1),
    "lengths of time": table().assign(time=DATES - DATES[0]).to_csv(index=False),
}


@pytest.mark.parametrize("kind", FOREIGN_CSV)
def test_csv_of_other_programs_is_read(kind, tmp_path):
    text = FOREIGN_CSV[kind]
    path = tmp_path / "a.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    frames = imported(path)["a"]
    assert_same(frames)
    assert_times(frames, RELATIVE_START)


@pytest.mark.parametrize(
    ("dates", "hours", "guessed"),
    [
        (DATES.astype(str), 0, True),
        ([date.isoformat() for date in DATES], 0, True),
        (DATES.tz_localize("Europe/Rome"), -2, False),
        ([f"{date.isoformat()}Z" for date in DATES], 0, False),
    ],
)
def test_dates_are_times(dates, hours, guessed, tmp_path):
    warnings: list[str] = []
    table().assign(time=dates).to_csv(tmp_path / "a.csv", index=False)
    frames = imported(tmp_path / "a.csv", None, warnings.append)["a"]
    begin = DATES[0].tz_localize("UTC").timestamp() + 3600 * hours
    assert_times(frames, begin)
    assert [text.endswith("name no zone, so that of UTC is taken") for text in warnings] == [
        True
    ] * guessed


def test_a_date_of_another_order_is_one_line_with_the_remedy(tmp_path):
    table().assign(time=DATES.strftime("%d.%m.%Y %H:%M:%S")).to_csv(tmp_path / "a.csv")
    with pytest.raises(ConfigError, match="line 2: '03.05.2024 10:00:00' is no time; write sec"):
        imported(tmp_path / "a.csv")


@pytest.mark.parametrize("late", [0.0, 0.01])
def test_a_column_tells_cameras_apart(late, tmp_path):
    rows = [table().assign(device=name) for name in ("left", "right")]
    rows[1]["time"] += late
    rows[1].loc[:, [name for name in rows[1] if name.endswith("_x")]] += 0.5  # not the same again
    pd.concat(rows).sort_values("time").to_csv(tmp_path / "a.csv", index=False)
    with pytest.raises(ConfigError, match=r'2 values \(left, right\); .* write camera = "device"'):
        imported(tmp_path / "a.csv")
    (tmp_path / "map.toml").write_text('frame = "{camera}"\n[columns]\ncamera = "device"')
    cameras = imported(tmp_path / "a.csv", tmp_path / "map.toml")
    assert [*cameras] == ["left", "right"]
    for shift, (name, frames) in zip((0.0, 0.5), cameras.items(), strict=True):
        assert_same(frames, np.add(POINTS, [shift, 0, 0]))
        assert {frame.frame_id for frame in frames} == {name}


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        (
            table().to_csv(index=False, decimal=",").replace('"', ""),
            r"commas are decimal ones, sep",
        ),
        ("time;A_x;A_y;A_z\n0,5;1.5;0;0\n", "line 2: has the number '0,5', and elsewhere .* '1.5'"),
        ("time,A_x,A_y,A_z\ns,m,m,mm\n0,1,1,1\n", "line 2: has the units m, mm, where one of"),
        ("time,A_x,A_x,A_x\n0,1,1,1\n", "column A_x twice; one line should name each"),
        (
            "scorer,net,net\nbodyparts,A,A\ncoords,x,y\n0,1,2\n",
            "a table of DeepLabCut, .* one line",
        ),
        ("time,A_x,A_y,A_z,\xe9\n0,1,1,1,1\n".encode("latin-1"), "not text: .*; save text as UTF"),
    ],
)
def test_a_table_that_is_ambiguous_is_one_line_with_the_remedy(text, fault, tmp_path):
    (tmp_path / "a.csv").write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(ConfigError, match=fault):
        imported(tmp_path / "a.csv")


def tall(times):
    """A row per joint, as a truth has it."""
    return pd.DataFrame(
        [
            (time, name, *xyz)
            for time, points in zip(times, POINTS.tolist(), strict=True)
            for name, xyz in zip(NAMES, points, strict=True)
        ],
        columns=["time", "marker", "x", "y", "z"],
    )


@pytest.mark.parametrize(
    ("begin", "text"),
    [
        (0.0, tall(np.arange(6) / 8).to_csv(index=False, sep=";", decimal=",")),
        (
            0.0,
            "\ufeff" + tall(np.arange(6) / 8).to_csv(index=False, quoting=csv.QUOTE_ALL, sep="\t"),
        ),
        (0.0, tall(np.arange(6) / 8).to_csv(index=False).replace("\n", "\ns,,m,m,m\n", 1)),
        (1714730400.0, tall(DATES).to_csv(index=False)),
    ],
)
def test_a_truth_in_csv_is_read_likewise(begin, text, tmp_path):
    (tmp_path / "a.csv").write_bytes(text.encode())
    truth = load_truth(tmp_path / "a.csv")
    assert truth.positions[:, 0] == pytest.approx(POINTS, abs=1e-9)
    stamps = [round(begin * 1e9) + k * 125_000_000 for k in range(6)]
    assert truth.stamps.tolist() == pytest.approx(stamps, abs=1000)


def nexus(between=",", point=".", subject="P1:", before="", first=101):
    """A table of Vicon Nexus: POINTS at 8 Hz, mm, and a trajectory without a name."""
    labels = ["", ""] + [cell for name in (*NAMES, "*7") for cell in (subject + name, "", "")]
    lines = ["Trajectories", "8", between.join(labels)]
    lines.append(between.join(["Frame", "Sub Frame", *4 * "XYZ"]))
    lines.append(between.join(["", "", *12 * ["mm"]]))
    for k, points in enumerate(POINTS):
        cells = [str(first + k), "0", *(f"{v:.3f}" for v in 1000 * points.ravel()), "", "", ""]
        lines.append(between.join(cells).replace(".", point))
    return before + "\n".join(lines) + "\n"


DEVICES = "Devices\n1000\n,,Force\nFrame,Sub Frame,Fx\n,,N\n1,0,3.5\n\n"


def motive(kind="Bone", unit="Meters", more="", id_lines=2):
    """A CSV file of OptiTrack's Motive: POINTS at 8 Hz, as bones or another kind."""
    names = ["Anna:Anna", "Anna:Head", "Anna:LShin"] if kind == "Bone" else NAMES
    head = f"Length Units,{unit}{more}"
    points = POINTS * (1000 if unit == "Millimeters" else 1)
    return motive_text(points, names, np.arange(6) / 8, kind, head, id_lines)


def qualisys(lead=True, head=True, data="3D"):
    """A TSV file of Qualisys Track Manager: POINTS at 8 Hz, mm."""
    lines = ["NO_OF_FRAMES\t6", "FREQUENCY\t8", f"DATA_INCLUDED\t{data}"]
    lines.append("\t".join(["MARKER_NAMES", *NAMES]))
    columns = ["Frame", "Time"] * lead + [f"{name} {axis}" for name in NAMES for axis in "XYZ"]
    lines += ["\t".join(columns)] * head
    for k, points in enumerate(1000 * POINTS):
        cells = [str(k + 1), f"{k / 8:.5f}"] * lead + [f"{v:.3f}" for v in points.ravel()]
        lines.append("\t".join(cells))
    return "\n".join(lines) + "\n"


FOREIGN_MOCAP = {
    "commas": nexus(),
    "empty lines before": nexus(before="\n,,,\n"),
    "tabs and decimal commas": nexus("\t", ","),
    "semicolons and decimal commas": nexus(";", ","),
    "no subject": nexus(subject=""),
    "after the devices, before the models": nexus(before=DEVICES) + DEVICES.replace("Dev", "\nDev"),
    "a line without its last cells": nexus().replace(",,,\n", "\n"),
    "Qualisys": qualisys(),
    "Qualisys, positions alone": qualisys(lead=False, head=False),
    "Motive, bones": motive(),
    "Motive, bones in mm, no parents": motive(unit="Millimeters", id_lines=1),
    "Motive, markers": motive("Marker"),
    "Motive, markers of a skeleton": motive("Bone Marker"),
}


@pytest.mark.parametrize("kind", FOREIGN_MOCAP)
def test_tables_of_motion_capture_are_read(kind, tmp_path):
    (tmp_path / "a.csv").write_text(FOREIGN_MOCAP[kind])
    frames = imported(tmp_path / "a.csv")["a"]
    assert_same(frames)
    assert_times(frames, RELATIVE_START)
    truth = load_truth(tmp_path / "a.csv")
    assert truth.positions[:, 0] == pytest.approx(POINTS, abs=1e-6)
    assert joints_of(truth.model.marker_names) == joints_of(NAMES)


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        (DEVICES, "has no Trajectories, only Devices; export them, too"),
        (nexus()[:-40], "line 11: is cut off"),
        (nexus().replace(",mm", ",deg"), "line 5: unit 'deg' is none of"),
        (nexus().replace(",mm", ",m", 1), "line 5: unit 'm, mm' is none of"),
        (nexus().replace("900.000", "high", 1), "line 6: 'high' is not a number"),
        ("Trajectories\n8\n\n", "line 1: has no trajectories"),
        (qualisys(data="6D"), "has no MARKER_NAMES or no FREQUENCY, or no 3D data"),
        (qualisys()[:-9], "line 11: is cut off"),
        (motive("Skeleton"), "line 4: names no bone and no marker, only .*Body Marker, Marker, Sk"),
        (motive()[:-5], "line 14: is cut off"),
        (motive(unit="Feet"), "line 1: unit 'Feet' is none of"),
        (motive().replace("Frame,", "No,"), "has no line that begins with Frame, Time; export it"),
        (motive(more=",Coordinate Space,Local"), "line 1: positions count from others; export Glo"),
        (nexus().replace("Trajectories\n8", "Trajectories\n-8"), "names no marker, or the line be"),
    ],
)
def test_a_faulty_table_of_motion_capture_is_one_line(text, fault, tmp_path):
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(ConfigError, match=fault):
        imported(tmp_path / "a.csv")


def c3d(path, points, names, count=None, **trial):
    """A C3D file of (T, M, 3) points that says mm."""
    file = ezc3d.c3d()
    file["parameters"]["POINT"]["UNITS"]["value"] = ["mm"]
    file["parameters"]["POINT"]["RATE"]["value"] = [100.0]
    file["parameters"]["POINT"]["LABELS"]["value"] = list(names)
    for name, words in trial.items():
        file.add_parameter("TRIAL", name, words)
    ones = np.ones((1, points.shape[1], len(points)))
    file["data"]["points"] = np.concatenate([points.transpose(2, 1, 0), ones])
    file.write(str(path))
    return path


LONG = 65535 + 4321


@pytest.fixture(scope="module")
def long_c3d(tmp_path_factory):
    """12 minutes at 100 Hz; x counts the frames, mm."""
    points = np.full((LONG, 2, 3), 100.0)
    points[:, :, 0], points[:, 1, 2] = np.arange(LONG)[:, None], 1600.0
    path = tmp_path_factory.mktemp("long") / "long.c3d"
    return c3d(path, points, ("A", "B"), ACTUAL_START_FIELD=[1, 0], ACTUAL_END_FIELD=[4320, 1])


def with_frames(data, count, kind=2):
    """The bytes of a C3D file whose POINT:FRAMES is another 16 bits, or a float."""
    at = data.find(b"\x01FRAMES") + 7
    header = 512 * (int.from_bytes(data[16:18], "little") - 1)
    if kind == 2:
        return data[: at + 4] + struct.pack("<H", count) + data[at + 6 :]
    step = int.from_bytes(data[at : at + 2], "little") + 2
    number = struct.pack("<HBBf", step, 4, 0, count)
    return (data[:at] + number + data[at + 6 :])[:header] + data[header:]


LONG_KINDS = {
    "as Vicon counts": lambda data: data,
    "by the size alone": lambda data: data.replace(b"ACTUAL", b"FORMER"),
    "counted modulo 65536": lambda data: with_frames(data, LONG % 65536),
    "counted by a float": lambda data: with_frames(data, LONG, 4).replace(b"ACTUAL", b"FORMER"),
}


@pytest.mark.parametrize("kind", LONG_KINDS)
def test_all_frames_of_a_long_c3d_file_are_read(kind, long_c3d, tmp_path):
    path = tmp_path / "a.c3d"
    path.write_bytes(LONG_KINDS[kind](long_c3d.read_bytes()))
    markers = read_c3d(path)
    assert markers.positions[:, 0, 0, 0] == pytest.approx(np.arange(LONG) / 1000)
    assert markers.times[-1] == pytest.approx((LONG - 1) / 100)
    assert load_truth(path).stamps[-1] == (LONG - 1) * 10_000_000


def test_a_long_c3d_file_that_is_cut_off_is_refused(long_c3d, tmp_path):
    (tmp_path / "a.c3d").write_bytes(long_c3d.read_bytes()[:-50_000])
    with pytest.raises(ConfigError, match=rf"is cut off: it has \d+ of {LONG} frames"):
        read_c3d(tmp_path / "a.c3d")
    (tmp_path / "a.c3d").write_bytes(long_c3d.read_bytes().replace(b"ACTUAL", b"FORMER")[:-50_001])
    with pytest.raises(ConfigError, match="is cut off: it ends within the frame"):
        read_c3d(tmp_path / "a.c3d")


def test_frames_of_a_longer_recording_do_not_count(tmp_path):
    path = c3d(tmp_path / "a.c3d", 1000 * POINTS, NAMES, ACTUAL_END_FIELD=[4320, 1])
    assert read_c3d(path).positions[:, 0] == pytest.approx(POINTS, abs=1e-6)


def two_of_three(data, frames, drop):
    """The bytes of a C3D file of three markers that counts two, and perhaps holds two."""
    at, start = data.find(b"USED") + 8, 512 * (int.from_bytes(data[16:18], "little") - 1)
    head = data[:2] + b"\2\0" + data[4:at] + b"\2\0" + data[at + 2 : start]
    points = np.frombuffer(data[start : start + 48 * frames], np.uint8).reshape(frames, 3, 16)
    return head + (points[:, :2].tobytes() if drop else data[start:]) + bytes(512)


def test_labels_beyond_the_points_name_nothing(tmp_path):
    points = np.tile(1000 * POINTS, (20, 1, 1))
    data = c3d(tmp_path / "a.c3d", points, NAMES).read_bytes()
    (tmp_path / "a.c3d").write_bytes(two_of_three(data, 120, drop=True))
    markers = read_c3d(tmp_path / "a.c3d")
    assert markers.names == ["PELVIS", "HEAD"]
    assert markers.positions[:6, 0] == pytest.approx(POINTS[:, :2], abs=1e-6)


def test_a_damaged_number_of_points_is_refused(tmp_path, capsys):
    points = np.tile(1000 * POINTS, (20, 1, 1))
    data = c3d(tmp_path / "a.c3d", points, NAMES).read_bytes()
    (tmp_path / "a.c3d").write_bytes(two_of_three(data, 120, drop=False))
    assert run(["import", str(tmp_path / "a.c3d"), "-o", str(tmp_path / "a.mcap"), "-q"]) == 2
    assert (
        "its 120 frames of 2 points are too few or too short for its size"
        in capsys.readouterr().err
    )


@pytest.mark.parametrize("suffix", [".trc", ".csv", ".c3d"])
def test_info_on_a_file_of_joints_names_the_import(suffix, tmp_path, capsys):
    (tmp_path / f"a{suffix}").write_text(trc())
    assert run(["info", str(tmp_path / f"a{suffix}")]) == 2
    assert "is not an MCAP file; `hiros import` makes a log of" in capsys.readouterr().err


def azure(path, counts):
    """JSON of the offline processor: so many bodies in each instant."""
    joints = (1000 * np.linspace([0, 0.5, 2], [0, -1, 2], 32)).tolist()
    bodies = [{"body_id": 1, "joint_positions": joints}]
    frames = [{"timestamp_usec": 100_000 * k, "bodies": n * bodies} for k, n in enumerate(counts)]
    path.write_text(json.dumps({"frames": frames}))
    return path


@pytest.mark.parametrize("counts", [[0, 1, 1], [1, 0, 0, 1], [1, 1, 0], [0, 0, 0]])
def test_instants_without_people_are_kept(counts, tmp_path):
    import_joints([azure(tmp_path / "a.json", counts)], tmp_path / "a.mcap", "azure-kinect")
    with open_log(tmp_path / "a.mcap") as log:
        frames = list(log.detections())
    assert [frame.n_people for frame in frames] == counts
    assert [round((f.stamp - frames[0].stamp) / 1e8) for f in frames] == [*range(len(counts))]


def test_a_camera_of_an_export_without_people_changes_nothing_for_the_others(tmp_path):
    files = [azure(tmp_path / "a.json", [1, 1]), azure(tmp_path / "b.json", [0, 0])]
    written = import_joints(files, tmp_path / "log.mcap", "azure-kinect")
    assert written == {"/a/skeletons": 2, "/b/skeletons": 2}


def test_openpose_files_without_people_are_instants(tmp_path):
    (tmp_path / "take").mkdir()
    person = {"pose_keypoints_3d": [0.0, 0.0, 1.0, 1.0] * 24 + [0.0, 0.0, 2.0, 1.0]}
    for k, people in enumerate([[], [person], [{"pose_keypoints_3d": []}]]):
        file = tmp_path / "take" / f"walk_{k:012d}_keypoints.json"
        file.write_text(json.dumps({"people": people}))
    (tmp_path / "map.toml").write_text('detector = "openpose"\n[time]\nrate = 10')
    import_joints([tmp_path / "take"], tmp_path / "a.mcap", tmp_path / "map.toml")
    with open_log(tmp_path / "a.mcap") as log:
        assert [frame.n_people for frame in log.detections()] == [0, 1, 0]


def test_rows_without_numbers_are_instants_without_people(tmp_path):
    rows = table()
    rows.iloc[2:4, 1:] = np.nan
    rows.to_csv(tmp_path / "a.csv", index=False, na_rep="NA")
    import_joints([tmp_path / "a.csv"], tmp_path / "a.mcap")
    with open_log(tmp_path / "a.mcap") as log:
        assert [frame.n_people for frame in log.detections()] == [1, 1, 0, 0, 1, 1]
