"""Commands that take long show on a terminal how far they are, by one bar."""

from __future__ import annotations

import io
import sys

import pytest

from hiros_cli.app import run

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
