"""Recordings of rosbag2 as people have them: what the same messages in one MCAP say."""

from __future__ import annotations

import subprocess
import sys

import pytest
from mcap.reader import make_reader
from rosbag2_recorder import record, sample

from hiros_cli.app import run
from hiros_mcap.errors import LogError
from hiros_mcap.io.bags import recover
from hiros_mcap.io.container import McapReader
from hiros_mcap.io.log import open_log
from hiros_mcap.io.overview import overview_of


@pytest.fixture(scope="module")
def messages():
    return sample()


@pytest.fixture(scope="module")
def healthy(messages, tmp_path_factory):
    """The same messages in one MCAP file."""
    return record(tmp_path_factory.mktemp("one") / "lab", messages, metadata=False) / "lab_0.mcap"


@pytest.fixture(scope="module")
def result(healthy, tmp_path_factory):
    """What a run on that file gives."""
    return processed(healthy, tmp_path_factory.mktemp("result") / "out.mcap")


def processed(log, out, *options):
    assert run(["process", str(log), "-o", str(out), "-q", *options]) == 0
    return content(out)


def content(path):
    """Every message of a file, by the mcap library."""
    with path.open("rb") as file:
        rows = make_reader(file).iter_messages()
        return sorted((c.topic, m.log_time, bytes(m.data)) for _, c, m in rows)


@pytest.mark.parametrize("options", [{}, {"parts": 3}, {"storage": "sqlite3"}])
def test_messages_that_are_compressed_one_by_one_are_unpacked(messages, result, options, tmp_path):
    folder = record(tmp_path / "lab", messages, mode="message", **options)
    assert "--compression-mode message" in " ".join(overview_of(folder).remarks)
    assert processed(folder, tmp_path / "out.mcap") == result


@pytest.mark.parametrize("metadata", [True, False])
def test_a_file_of_compressed_messages_needs_no_metadata(messages, result, metadata, tmp_path):
    folder = record(tmp_path / "lab", messages, mode="message", metadata=metadata)
    assert processed(folder / "lab_0.mcap", tmp_path / "out.mcap") == result


def test_compressed_messages_are_unpacked_live_and_in_copies(messages, result, healthy, tmp_path):
    file = record(tmp_path / "lab", messages, mode="message") / "lab_0.mcap"
    assert recover(file, tmp_path / "copy.mcap").complete
    assert content(tmp_path / "copy.mcap") == content(healthy)
    out = [tmp_path / name for name in ("live.mcap", "healthy.mcap")]
    for source, target in zip((file, healthy), out, strict=True):
        with source.open("rb") as stream:
            command = [sys.executable, "-m", "hiros_mcap", "process", "-", "-o", str(target)]
            subprocess.run([*command, "-q"], stdin=stream, check=True)
    assert content(out[0]) == content(out[1])


def test_a_damaged_message_is_no_people(messages, tmp_path):
    cut = [m if k != 40 else m._replace(data=m.data[:9]) for k, m in enumerate(messages)]
    file = record(tmp_path / "lab", cut, mode="message") / "lab_0.mcap"
    data = file.read_bytes()
    assert data  # the frame of a message that is cut off is whole; the message is not
    with open_log(file) as log:
        reading = log.read()
        list(reading.frames())
    assert sum(account.skipped.total() for account in reading.accounts.values()) == 1
