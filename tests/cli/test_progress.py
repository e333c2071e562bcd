"""Commands that take long show on a terminal how far they are, by one bar."""

from __future__ import annotations

import io
import sys
import time

import pytest

from hiros_cli.app import run
from hiros_mcap import progress

COMMANDS = {
    "process": ["process", "LAB", "-o", "OUT.mcap", "--calibrate", "off"],
    "live": ["process", "LAB", "--follow", "-o", "OUT.mcap"],
    "eval": ["eval", "LAB", "--leave-one-out", "--system", "average"],
    "simulate": ["simulate", "OUT.mcap", "--seconds", "1"],
    "export": ["export", "RESULT", "-o", "OUT.csv"],
    "plot": ["plot", "RESULT", "-o", "OUT.png", "--what", "limbs"],
    "view": ["view", "RESULT", "--save", "OUT.rrd", "--time-range", "0:1"],
    "people": ["calibrate", "people", "WALK"],
    "recover": ["recover", "LAB", "-o", "OUT.mcap"],
    "plan": ["plan", "--room", "4x4", "--cameras", "2"],
}


class Terminal(io.StringIO):
    """A stderr that somebody looks at."""

    def isatty(self):
        return True


@pytest.fixture(scope="module")
def logs(walking, short, tmp_path_factory):
    """A recording, a short one and the result of that."""
    folder = tmp_path_factory.mktemp("progress")
    result = folder / "result.mcap"
    assert run(["process", str(short), "-o", str(result), "--calibrate", "off", "-q"]) == 0
    return {"WALK": str(walking), "LAB": str(short), "RESULT": str(result)}


@pytest.mark.parametrize("name", COMMANDS)
def test_a_terminal_shows_a_bar_and_a_pipe_nothing(name, logs, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("TERM", "xterm")

    def told(folder):
        folder.mkdir()
        arguments = [
            logs.get(text, str(folder / text) if text.startswith("OUT") else text)
            for text in COMMANDS[name]
        ]
        monkeypatch.setattr(sys, "stderr", stderr := kind())
        assert run(arguments) == 0
        return stderr.getvalue()

    kind: type[io.StringIO] = Terminal
    assert "━" in told(tmp_path / "terminal")
    kind = io.StringIO
    assert "━" not in told(tmp_path / "pipe")


def test_the_log_of_a_job_has_a_line_a_minute(logs, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(progress, "MINUTE_S", 0.02)
    out = tmp_path / "out.mcap"
    arguments = ["process", logs["WALK"], "-o", str(out), "--calibrate", "off"]
    assert run(arguments) == 0
    assert ": 1 min\n" in capsys.readouterr().err
    assert run([*arguments, "-q"]) == 0
    assert "min\n" not in capsys.readouterr().err
    with progress.bar("work", quiet=False) as shown:
        shown.update(1, 4)
        time.sleep(0.1)
    assert "hiros: work: 25% after 1 min\n" in capsys.readouterr().err
