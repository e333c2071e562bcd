"""``hiros process - -o -`` as a Unix tool."""

from __future__ import annotations

import io
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from mcap.reader import NonSeekingReader

HIROS = [sys.executable, "-m", "hiros_cli"]


def topics(data: bytes) -> set[str]:
    reader = NonSeekingReader(io.BytesIO(data), validate_crcs=True)
    return {channel.topic for _, channel, _ in reader.iter_messages(log_time_order=False)}


def test_a_pipe_in_and_a_pipe_out(crossing: Path) -> None:
    with crossing.open("rb") as file:
        done = subprocess.run(
            [*HIROS, "process", "-", "-o", "-"], stdin=file, capture_output=True, check=True
        )
    assert {"/hiros/filtered", "/tf_static", "/truth/skeletons"} <= topics(done.stdout)
    assert b"camera_0" in done.stderr  # the summary


def test_quiet_prints_nothing(crossing: Path) -> None:
    with crossing.open("rb") as file:
        done = subprocess.run(
            [*HIROS, "process", "-", "-o", "-", "-q"], stdin=file, capture_output=True, check=True
        )
    assert done.stderr == b""


def test_a_reader_that_has_seen_enough(crossing: Path) -> None:
    with crossing.open("rb") as file:
        run = subprocess.Popen(
            [*HIROS, "process", "-", "-o", "-", "-q"],
            stdin=file,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        assert run.stdout is not None
        assert run.stderr is not None
        run.stdout.read(100)
        run.stdout.close()
        assert run.wait(120) == 128 + signal.SIGPIPE
        assert run.stderr.read() == b""
        run.stderr.close()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_input(number: int, crossing: Path, tmp_path: Path) -> None:
    growing, out = tmp_path / "growing.mcap", tmp_path / "out.mcap"
    shutil.copy(crossing, growing)
    os.truncate(growing, crossing.stat().st_size - 100)  # the end mark is still to come
    run = subprocess.Popen(
        [*HIROS, "process", str(growing), "--follow", "-o", str(out)],
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        text=True,
    )
    assert run.stderr is not None
    while "running" not in run.stderr.readline():
        pass
    time.sleep(1)
    run.send_signal(number)
    assert run.wait(120) == 0
    run.stderr.close()
    assert "/hiros/filtered" in topics(out.read_bytes())


@pytest.mark.parametrize(
    ("arguments", "fault"),
    [
        (["-"], "name the output"),
        (["LOG", "-o", "-"], "add --follow"),
        (["-", "--follow", "-o", "-"], "is live anyway"),
        (["nowhere.mcap", "--follow"], "does not exist yet"),
        (["-", "-o", "-", "--unit", "mm"], "are for files"),
        (["-", "-o", "bag/"], "not a bag's folder"),
        (["-", "-o", "-", "--system", "hiros-realtime", "--two-pass"], "reads the whole log first"),
        (["-", "-o", "-", "--recover"], "are for files"),
    ],
)
def test_what_cannot_be_live(
    arguments: list[str], fault: str, crossing: Path, tmp_path: Path
) -> None:
    given = [str(crossing) if text == "LOG" else text for text in arguments]
    done = subprocess.run(
        [*HIROS, "process", *given],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        cwd=tmp_path,
        check=False,
    )
    assert (done.returncode, done.stdout) == (2, b"")
    assert fault in done.stderr.decode()
    assert not list(tmp_path.iterdir())
