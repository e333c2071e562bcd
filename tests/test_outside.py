"""Text from outside: whatever it is, one error of one line, or what it means."""

from __future__ import annotations

import json
import os

import pytest
from text_readers import READERS, WORDS_OF_OTHERS

from hiros_mcap.config import load_config
from hiros_mcap.errors import HirosError
from hiros_mcap.io.channels import (
    CONFIG_ATTACHMENT,
    EVENTS_ATTACHMENT,
    REPORT_ATTACHMENT,
)
from hiros_mcap.io.container import McapReader, McapWriter
from hiros_mcap.io.foxglove import FoxgloveInput
from hiros_mcap.io.result import stored_events, stored_report
from hiros_mcap.running.overview import overview_of

DEEP = 200_000
LENS = """image_width: 640
image_height: 480
camera_matrix: {data: []}
distortion_coefficients: {data: []}
"""
ODD = {
    "toml": {
        "nested": "a = " + "[" * DEEP,
        "nested tables": "[" + ".".join(["a"] * 1000) + "]\n",
        "keys": ".".join(["a"] * 1000) + " = 1",
        "number": "a = " + "9" * 5000,
        "large number": "a = " + "9" * 400,
        "not text": "\udcff",
        "date": "a = 2026-99-99",
        "list": "[[a]]\n[[a]]",
    },
    "json": {
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
    "yaml": {
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


TAKE_MORE = {"lenses in TOML", "lenses in JSON"}
"""They leave out what is no camera."""
FILES = [
    name
    for name, (kind, _) in READERS.items()
    if kind in ODD and name not in WORDS_OF_OTHERS | TAKE_MORE
]


@pytest.mark.parametrize(
    ("reader", "text"), [(name, odd) for name in FILES for odd in ODD[READERS[name][0]]]
)
def test_odd_text_is_an_error_of_one_line(reader, text, tmp_path):
    kind, read = READERS[reader]
    path = tmp_path / f"x.{kind}"
    path.write_bytes(ODD[kind][text].encode(errors="surrogateescape"))
    with pytest.raises(HirosError, match=path.name) as caught:
        read(path)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 10_000


@pytest.mark.parametrize("reader", FILES)
def test_a_pipe_is_refused_at_once(reader, tmp_path):
    kind, read = READERS[reader]
    path = tmp_path / f"x.{kind}"
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
