"""Completions for Tab, by the protocols of the shells."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys

import pytest

from hiros_cli.app import run
from hiros_cli.completing import VARIABLE, parameters
from hiros_mcap.config import PRESETS, load_config
from hiros_mcap.systems import SYSTEMS

SHELLS = ("bash", "zsh", "fish")


def offered(line, shell, monkeypatch, capsys):
    """Press Tab at the end of a line; return the offers without their descriptions."""
    monkeypatch.setenv(VARIABLE, f"complete_{shell}")
    monkeypatch.setenv("COMP_WORDS", line)
    monkeypatch.setenv("COMP_CWORD", str(len(line.split(" ")) - 1))
    monkeypatch.setenv("_TYPER_COMPLETE_ARGS", line)
    monkeypatch.setenv("_TYPER_COMPLETE_FISH_ACTION", "get-args")
    assert run([]) == 0
    out = capsys.readouterr().out
    if shell == "zsh":  # _arguments '*: :(("a":"help" "b":"help"))', escaped
        return re.findall(r'(?:\(\(|^)"([^"]*)"', out, re.MULTILINE)
    return [text.split("\t")[0] for text in out.splitlines() if text]


@pytest.mark.parametrize("shell", SHELLS)
def test_commands_options_systems_and_presets(shell, monkeypatch, capsys):
    assert offered("hiros exp", shell, monkeypatch, capsys) == ["export"]
    assert offered("hiros export --mark", shell, monkeypatch, capsys) == ["--marker-set"]
    assert offered("hiros process --system ", shell, monkeypatch, capsys) == list(SYSTEMS)
    assert offered("hiros config --preset ", shell, monkeypatch, capsys) == list(PRESETS)


@pytest.mark.parametrize("shell", SHELLS)
def test_parameters(shell, monkeypatch, capsys):
    found = offered("hiros process a.mcap --set track.max_", shell, monkeypatch, capsys)
    assert set(found) >= {"track.max_distance=", "track.max_gap=", "track.max_jump="}
    assert all(name.startswith("track.max_") for name in found)


@pytest.mark.parametrize("shell", SHELLS)
def test_topics_of_the_log(shell, crossing, monkeypatch, capsys):
    line = f"hiros process {crossing} --topic "
    cameras = [f"/camera_{k}/skeletons" for k in range(3)]
    expected = [*cameras, "/truth/skeletons"]
    assert offered(line, shell, monkeypatch, capsys) == expected
    assert offered(f"{line}/cam", shell, monkeypatch, capsys) == cameras


@pytest.mark.parametrize("command", ["process", "info", "eval", "check", "export", "plot"])
def test_every_command_with_channels_offers_those_of_its_log(command, walking, monkeypatch, capsys):
    option = "--topic" if command in ("process", "info") else "--channel"
    line = f"hiros {command} {walking} {option} /camera_0"
    assert offered(line, "bash", monkeypatch, capsys) == ["/camera_0/skeletons"]


def test_a_damaged_or_missing_log_offers_nothing(tmp_path, monkeypatch, capsys):
    (tmp_path / "bad.mcap").write_bytes(b"no log at all")
    for name in ("bad.mcap", "missing.mcap"):
        line = f"hiros process {tmp_path / name} --topic "
        assert offered(line, "bash", monkeypatch, capsys) == []


def test_the_parameters_are_those_of_the_configuration():
    assert len(parameters("")) == len(set(parameters(""))) > 50
    load_config(None, [f"{parameters('track.max_g')[0]}0.5"])


@pytest.mark.parametrize("shell", SHELLS)
def test_a_script_for_every_shell(shell, tmp_path, capsys):
    assert run(["completion", shell]) == 0
    script = capsys.readouterr().out
    assert f"{VARIABLE}=complete_{shell}" in script
    if found := shutil.which(shell):
        (tmp_path / "script").write_text(script)
        subprocess.run([found, "-n", str(tmp_path / "script")], check=True)


def test_bash_completes(crossing, tmp_path, capsys):
    """The whole way: bash calls the function of the script, which calls the program."""
    assert run(["completion", "bash"]) == 0
    program = tmp_path / "hiros"
    program.write_text(f"#!/bin/sh\nexec {sys.executable} -m hiros_cli\n")
    program.chmod(0o755)
    ask = f"""
        COMP_WORDS=(hiros process {crossing} --topic /camera_1); COMP_CWORD=4
        _hiros_completion {program}
        printf '%s\n' "${{COMPREPLY[@]}}"
    """
    script = capsys.readouterr().out + ask
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(
        ["bash", "-c", script], capture_output=True, text=True, env=environment, check=True
    )
    assert done.stdout.split() == ["/camera_1/skeletons"]


def test_nothing_slow_is_imported():
    """Compiled kernels, pandas and the like would make every Tab wait; it takes 0.3 s so."""
    code = (
        "import os, sys; from hiros_cli.commands import dispatch; code = dispatch([]);"
        "slow = {'numba', 'numpy', 'pandas', 'scipy', 'rerun'} & set(sys.modules);"
        "sys.exit(f'{code} {slow}' if slow or code else 0)"
    )
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(sys.path),
        VARIABLE: "complete_bash",
        "COMP_WORDS": "hiros process a.mcap --set tr",
        "COMP_CWORD": "4",
    }
    subprocess.run([sys.executable, "-c", code], env=environment, check=True, capture_output=True)


def test_an_unknown_shell_is_refused(capsys):
    assert run(["completion", "tcsh"]) == 2
    assert "'tcsh' is none of bash, zsh, fish" in capsys.readouterr().err
