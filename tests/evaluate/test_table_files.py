"""``--table``: the tables of eval and compare as CSV."""

from __future__ import annotations

import csv
import json
import math
from types import SimpleNamespace

import pytest

from hiros_cli.app import run
from hiros_mcap.errors import ConfigError
from hiros_mcap.evaluate.measures import Measure, Sheet, write_table

MEAN = Measure("mean", "Mean", "mm", "", interval=("low", "high"))
MOTION = (
    Measure("angle", "Angle", "deg", "", digits=2, sd="angle_sd"),
    Measure("share", "PCK", "%", "", scale=100),
    Measure("none", "Nobody has it", "mm", "", is_optional=True),
    Measure("switches", "Switches", "", "", digits=0),
)
GOOD = SimpleNamespace(mean=9.87654, low=9.5, high=10.25, angle=1.5, angle_sd=0.25, share=0.5)
BAD = SimpleNamespace(mean=31.0, low=math.nan, high=math.nan, angle=math.nan, switches=3)
ROWS = [("a_b & |c|", GOOD), ("bad", BAD)]
JOINTS = Sheet("Joint error, mm", "Channel", ROWS, [MEAN], "mm")
SHEETS = [JOINTS, Sheet("Motion", "Channel", ROWS, MOTION)]


def written(path, sheets=SHEETS):
    write_table(path, sheets)
    return path.read_text(encoding="utf-8")


def dicts(path):
    return list(csv.DictReader(path.read_text(encoding="utf-8").splitlines()))


def test_csv_has_a_column_per_number_and_full_digits(tmp_path):
    rows = list(csv.reader(written(tmp_path / "x.csv").splitlines()))
    assert rows == [
        [
            *("Channel", "Mean (mm)", "Mean 95 % low (mm)", "Mean 95 % high (mm)"),
            *("Angle (deg)", "Angle SD (deg)", "PCK (%)", "Switches"),
        ],
        ["a_b & |c|", "9.87654", "9.5", "10.25", "1.5", "0.25", "50", ""],
        ["bad", "31", "", "", "", "", "", "3"],
    ]


def test_sheets_of_several_logs_are_one_csv_table(tmp_path):
    sheets = [SHEETS[0]._replace(first="System", log=log) for log in ("one.mcap", "two.mcap")]
    rows = list(csv.reader(written(tmp_path / "x.csv", sheets).splitlines()))
    assert [row[:3] for row in rows] == [
        ["Log", "System", "Mean (mm)"],
        *([log, name, mean] for log in ("one.mcap", "two.mcap") for name, mean in (
            ("a_b & |c|", "9.87654"), ("bad", "31"),
        )),
    ]  # fmt: skip


def test_another_suffix_is_refused(tmp_path):
    with pytest.raises(ConfigError, match=r"x.txt: a table ends in .csv"):
        write_table(tmp_path / "x.txt", SHEETS)


def test_a_table_of_hiros_is_replaced_and_another_file_is_not(tmp_path, walking):
    target = tmp_path / "x.csv"
    command = ["eval", str(walking), "--channel", "/hiros/filtered", "-q", "--table", str(target)]
    assert run(command) == 0
    before = target.read_text()
    assert run(command) == 0
    assert target.read_text() == before
    target.write_text("Channel,mine\n")
    assert run(command) == 2
    assert target.read_text() == "Channel,mine\n"


def test_eval_and_compare_write_what_json_has(tmp_path, walking, capsys):
    assert run(["eval", str(walking), "--json", "--table", str(tmp_path / "x.csv")]) == 0
    channels = json.loads(capsys.readouterr().out)["channels"]
    (first, *_) = rows = dicts(tmp_path / "x.csv")
    assert [row["Channel"] for row in rows] == list(channels)
    scores = channels[first["Channel"]]
    assert scores["mean_low"] < scores["mean"] < scores["mean_high"]
    for column, name in (
        ("Mean (mm)", "mean"),
        ("Mean 95 % low (mm)", "mean_low"),
        ("Mean 95 % high (mm)", "mean_high"),
        ("Bending SD (deg)", "angle_deviation"),
    ):
        assert float(first[column]) == pytest.approx(scores[name], rel=1e-5)
    names = ["--system", "average", "--system", "raw"]
    command = ["compare", str(walking), *names, "--jobs", "1", "--json"]
    assert run([*command, "--table", str(tmp_path / "y.csv")]) == 0
    outcomes = {o["name"]: o for o in json.loads(capsys.readouterr().out)["outcomes"]}
    for row in dicts(tmp_path / "y.csv"):
        outcome = outcomes[row["System"]]
        assert row["Log"] == walking.name
        assert float(row["Mean (mm)"]) == pytest.approx(outcome["scores"]["mean"], rel=1e-5)
        column = row["Difference from the first 95 % low (mm)"]
        low = (outcome["difference"] or {}).get("low")
        assert (float(column) if column else None) == (low and pytest.approx(low, rel=1e-5))
