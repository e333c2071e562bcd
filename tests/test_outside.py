"""Text from outside: whatever it is, one error of one line, or what it means."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from hiros_mcap.body.foreign_cameras import read_calibration
from hiros_mcap.body.limb_table import LimbTable
from hiros_mcap.body.transforms import read_extrinsics
from hiros_mcap.config import load_config
from hiros_mcap.errors import HirosError
from hiros_mcap.io.channels import (
    CONFIG_ATTACHMENT,
    EVENTS_ATTACHMENT,
    LIMBS_ATTACHMENT,
    REPORT_ATTACHMENT,
)
from hiros_mcap.io.container import McapReader, McapWriter
from hiros_mcap.io.export.files import load_marker_set
from hiros_mcap.io.foxglove import FoxgloveInput
from hiros_mcap.io.joints.importing import import_joints
from hiros_mcap.io.result import stored_events, stored_report
from hiros_mcap.regression.differences import limbs_of
from hiros_mcap.regression.quantities import load_tolerances
from hiros_mcap.regression.suite import load_suite
from hiros_mcap.running.overview import overview_of
from hiros_mcap.skeletons import SkeletonModel

DEEP = 200_000
MODEL = SkeletonModel.of(["HEAD"], [])


def imported(path):
    return import_joints([path], path.with_suffix(".mcap"))


def mapped(path):
    (path.parent / "a.csv").write_text("time,joint,x,y,z\n0,HEAD,0,0,0\n")
    return import_joints([path.parent / "a.csv"], path.with_suffix(".mcap"), path)


READERS: dict[str, tuple[str, Callable[[Path], object]]] = {
    "settings": ("TOML", load_config),
    "limbs": ("TOML", LimbTable.load),
    "mapping": ("TOML", mapped),
    "marker set": ("TOML", lambda path: load_marker_set(str(path), MODEL)),
    "tolerances": ("TOML", load_tolerances),
    "suite": ("TOML", load_suite),
    "poses.toml": ("TOML", read_extrinsics),
    "poses.json": ("JSON", read_extrinsics),
    "joints.json": ("JSON", imported),
    "lens.yaml": ("YAML", read_calibration),
}
LENS = """image_width: 640
image_height: 480
camera_matrix: {data: []}
distortion_coefficients: {data: []}
"""
ODD = {
    "TOML": {
        "nested": "a = " + "[" * DEEP,
        "nested tables": "[" + ".".join(["a"] * 1000) + "]\n",
        "keys": ".".join(["a"] * 1000) + " = 1",
        "number": "a = " + "9" * 5000,
        "large number": "a = " + "9" * 400,
        "not text": "\udcff",
        "date": "a = 2026-99-99",
        "list": "[[a]]\n[[a]]",
    },
    "JSON": {
        "nested": "[" * DEEP,
        "nested and closed": "[" * 900 + "]" * 900,
        "nested objects": '{"a":' * DEEP,
        "number": '{"a": ' + "9" * 5000 + "}",
        "large number": '[{"time": ' + "9" * 400 + ', "people": []}]',
        "surrogate": '[{"time": 0, "people": [{"joints": {"\\ud800": [0, 0, 0]}}]}]',
        "twice": '{"camera": [], "camera": []}',
        "null": "[null]",
        "people": '[{"time": 0, "people": [null]}]',
        "joints": '[{"time": 0, "people": [{"joints": {"HEAD": {"x": 1}}}]}]',
        "not text": "\udcff",
    },
    "YAML": {
        "nested": "[" * 5000,
        "aliases": "a: &a [1, 2]\n" + LENS.replace("[]", f"[{', '.join(['*a'] * 9)}]"),
        "itself": "a: &a [*a]",
        "tag": "a: !!python/object/apply:os.getcwd []",
        "merge keys": "a: &a {x: 1}\nb: {<<: [*a, *a]}",
        "large": "a" * (2 << 20),
        "number": "a: " + "9" * 5000,
        "twice": "a: 1\na: 2",
        "lens": LENS,
    },
}


@pytest.mark.parametrize(
    ("reader", "text"), [(name, odd) for name, (kind, _) in READERS.items() for odd in ODD[kind]]
)
def test_odd_text_is_an_error_of_one_line(reader, text, tmp_path):
    kind, read = READERS[reader]
    path = tmp_path / f"x.{reader.rpartition('.')[2] if '.' in reader else kind.lower()}"
    path.write_bytes(ODD[kind][text].encode(errors="surrogateescape"))
    with pytest.raises(HirosError, match=path.name) as caught:
        read(path)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 10_000


@pytest.mark.parametrize("reader", READERS)
def test_a_pipe_is_refused_at_once(reader, tmp_path):
    kind, read = READERS[reader]
    path = tmp_path / f"x.{kind.lower()}"
    os.mkfifo(path)
    with pytest.raises(HirosError, match="is not a regular file"):
        read(path)


@pytest.mark.parametrize("text", ["[" * DEEP, "9" * 5000, "a.b=[" * 20_000])
def test_an_assignment_may_be_anything(text):
    with pytest.raises(HirosError, match="track.max_gap"):
        load_config(overrides=[f"track.max_gap={text}"])


def with_attachment(path, name, data):
    with McapWriter(path) as writer:
        writer.add_attachment(name, data, "application/json")
        writer.commit()
    return path


@pytest.mark.parametrize(
    "data",
    [
        b"[" * DEEP,
        b"\xff",
        b"[null]",
        b'[{"stamp": "x", "kind": 3}]',
        b'[{"stamp": 1' + b"0" * 400 + b', "kind": "x"}]',
        b'{"cameras": [null], "warnings": 3}',
    ],
)
def test_odd_attachments_are_damaged(data, tmp_path):
    for name, read in ((EVENTS_ATTACHMENT, stored_events), (REPORT_ATTACHMENT, stored_report)):
        path = with_attachment(tmp_path / "x.mcap", name, data)
        with McapReader(path) as reader, pytest.raises(HirosError, match=f"{name} is damaged"):
            read(reader)
        overview_of(path)  # what it says of itself is left out


@pytest.mark.parametrize("data", [b"\xff", b"[" * DEEP, b"[person]\n0 = 3"])
def test_odd_limb_lengths_of_a_result_are_named(data, tmp_path):
    path = with_attachment(tmp_path / "x.mcap", LIMBS_ATTACHMENT, data)
    with pytest.raises(HirosError, match=r"x\.mcap: "):
        limbs_of(path)


@pytest.mark.parametrize("text", ["a = " + "[" * DEEP, "[input]\na = 2026-01-01"])
def test_odd_parameters_of_a_result_are_left_out(text, tmp_path):
    overview_of(with_attachment(tmp_path / "x.mcap", CONFIG_ATTACHMENT, text.encode()))


@pytest.mark.parametrize(
    "text",
    [
        "[" * DEEP,
        "9" * 5000,
        "[null]",
        '{"op": "advertise", "channels": [null]}',
        json.dumps(
            {
                "op": "advertise",
                "channels": [
                    {"id": 1, "topic": "\ud800", "encoding": "", "schemaName": "", "schema": ""}
                ],
            }
        ),
    ],
)
def test_odd_messages_of_a_server_are_named(text):
    source = FoxgloveInput("ws://127.0.0.1:1", lambda topic, kind: True)
    with pytest.raises(HirosError, match="ws://127.0.0.1:1: "):
        list(source._advertised(None, text))
