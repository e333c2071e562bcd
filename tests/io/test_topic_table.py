"""``hiros export --topic``: the raw messages of any ROS 2 topic as a table."""

from __future__ import annotations

import re

import pandas as pd
import pyarrow.parquet
import pytest
from mcap.writer import Writer
from mcap_ros2._dynamic import serialize_dynamic

from hiros_cli.app import run

SCAN = "lab_msgs/msg/Scan"
TEXT = """
Point[] points
string name
uint64 count
uint8[] image
float32[2] pair
bool ok
================================================================================
MSG: lab_msgs/Point
float64 x
int32[] tags
"""
BODY = {
    "name": "a, b\nc",
    "count": 2**53 + 1,
    "image": b"\x01\x02\x03",
    "pair": [0.5, 2],
    "ok": True,
}
MESSAGES = [
    {"points": [{"x": 1.5, "tags": [7]}], **BODY},
    {"points": [{"x": 2.5, "tags": list(range(12))}, {"x": float("nan"), "tags": []}], **BODY},
]


def log(path, damaged=0, **changed):
    """A log of two messages of a type that hiros does not know, and of something that is no CDR."""
    encode = serialize_dynamic(SCAN, TEXT)[SCAN]
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2", "test")
        schema = writer.register_schema(SCAN, "ros2msg", TEXT.encode())
        scan = writer.register_channel("/lab/scan", "cdr", schema)
        other = writer.register_channel("/lab/json", "json", 0)
        for k, message in enumerate(MESSAGES):
            data = encode({**message, **changed})[: 9 if k < damaged else None]
            writer.add_message(scan, 10**18 + k, data, publish_time=5)
        writer.add_message(other, 10**18, b"{}", publish_time=5)
        writer.finish()
    return path


def exported(tmp_path, *arguments):
    return run(["export", str(log(tmp_path / "a.mcap")), "--topic", *map(str, arguments)])


def test_a_row_per_message_and_a_column_per_field(tmp_path):
    assert exported(tmp_path, "/lab/scan", "-o", tmp_path / "x.csv") == 0
    table = pd.read_csv(tmp_path / "x.csv")
    assert list(table.columns) == [
        "log time (ns)",
        *("points[0].x", *(f"points[0].tags[{k}]" for k in range(12)), "points[1].x"),
        *("name", "count", "image (bytes)", "pair[0]", "pair[1]", "ok"),
    ]
    assert table["log time (ns)"].tolist() == [10**18, 10**18 + 1]
    assert table["points[0].x"].tolist() == [1.5, 2.5]
    assert table["points[0].tags[11]"].isna().tolist() == [True, False]
    assert table["count"].tolist() == [2**53 + 1] * 2
    last = table.iloc[1]
    assert (last["name"], last["image (bytes)"], last["pair[1]"], last["ok"]) == (
        *("a, b\nc", 3, 2.0),
        True,
    )


def test_parquet_holds_the_same_with_types(tmp_path):
    assert exported(tmp_path, "/lab/scan", "-o", tmp_path / "x.parquet") == 0
    table = pyarrow.parquet.read_table(tmp_path / "x.parquet")
    assert table["count"].to_pylist() == [2**53 + 1] * 2
    assert table["points[0].tags[11]"].to_pylist() == [None, 11]
    assert table["ok"].to_pylist() == [True, True]


def test_a_table_of_hiros_is_replaced_and_another_file_is_not(tmp_path):
    for suffix in (".csv", ".parquet"):
        target = tmp_path / f"x{suffix}"
        assert exported(tmp_path, "/lab/scan", "-o", target) == 0
        assert exported(tmp_path, "/lab/scan", "-o", target) == 0
        target.write_text("mine")
        assert exported(tmp_path, "/lab/scan", "-o", target) == 2
        assert target.read_text() == "mine"


def test_damaged_messages_are_counted(tmp_path, capsys):
    path, target = log(tmp_path / "a.mcap", damaged=1), tmp_path / "x.csv"
    assert run(["export", str(path), "--topic", "/lab/scan", "-o", str(target)]) == 0
    assert "/lab/scan: 1 of 2 messages cannot be decoded: " in capsys.readouterr().err
    assert pd.read_csv(target)["ok"].isna().tolist() == [True, False]


@pytest.mark.parametrize(
    ("arguments", "fault"),
    [
        (
            ["/nope", "-o", "x.csv"],
            r"/nope: has no messages of this topic; it has /lab/json \(\), /l",
        ),
        (["/lab/json", "-o", "x.csv"], "/lab/json: is json with no definition; a table is made of"),
        (["/lab/scan", "-o", "x.trc"], "x.trc: a topic is written as .csv or .parquet"),
        (["/lab/scan", "-o", "x.csv", "--rate", "30"], "raw messages; leave out --rate"),
        (["/lab/scan", "-o", "x.csv", "b.mcap"], "--topic is for one log, and there are many"),
    ],
)
def test_what_is_no_table_is_refused(arguments, fault, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert exported(tmp_path, *arguments) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert re.search(fault, err)
    assert [p.name for p in tmp_path.iterdir()] == ["a.mcap"]


def test_messages_that_nobody_can_decode_or_that_are_too_wide_are_refused(tmp_path, capsys):
    target = tmp_path / "x.csv"
    for path, fault in (
        (log(tmp_path / "a.mcap", damaged=2), "no message can be decoded: "),
        (
            log(tmp_path / "b.mcap", points=[{"x": 0, "tags": [1] * 17_000}]),
            "17007 numbers, too many",
        ),
    ):
        assert run(["export", str(path), "--topic", "/lab/scan", "-o", str(target)]) == 2
        assert fault in capsys.readouterr().err
        assert not target.exists()
