"""Options of every command, and hiros.toml beside a log."""

from __future__ import annotations

import json
import logging
import shutil
from pathlib import Path

import pytest

import hiros_mcap
from hiros_cli.app import run
from hiros_mcap.config import settings_beside

LATE = ["--clock", "camera_0=100", "--calibrate", "off"]


@pytest.fixture
def lab(crossing, tmp_path):
    """A log in a folder of its own."""
    return Path(shutil.copy(crossing, tmp_path / "lab.mcap"))


@pytest.fixture
def long_lab(whole_crossing, tmp_path):
    """A log in a folder of its own."""
    return Path(shutil.copy(whole_crossing, tmp_path / "lab.mcap"))


def test_verbose_shows_the_steps_and_a_warning_once(long_lab, capsys):
    assert run(["process", str(long_lab), *LATE, "-q", "--verbose"]) == 0
    told = capsys.readouterr().err
    assert told.count("camera_1/skeletons: 97 % of 147 messages not used") == 1
    assert f"hiros: {long_lab}: system fuse: tracked, merged, optimized, filtered\n" in told


def test_without_the_options_nothing_more_is_told(long_lab, capsys):
    assert run(["process", str(long_lab), *LATE, "-q"]) == 0
    assert all(line.startswith("hiros: warning: ") for line in capsys.readouterr().err.splitlines())
    assert logging.getLogger("hiros_mcap").level == logging.NOTSET


@pytest.mark.parametrize(
    ("environment", "colored"),
    [
        ({}, False),
        ({"FORCE_COLOR": "1"}, True),
        ({"FORCE_COLOR": "1", "NO_COLOR": "1"}, False),
    ],
)
def test_color_is_as_the_environment_asks(environment, colored, crossing, monkeypatch, capsys):
    for name in ("NO_COLOR", "FORCE_COLOR"):
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    assert run(["info", str(crossing)]) == 0
    assert ("\x1b[" in capsys.readouterr().out) == colored


def test_parameters_beside_a_log_count_and_are_named(lab, capsys):
    beside = lab.with_name("hiros.toml")
    beside.write_text("[filter]\ncutoff = 7.0\n")
    assert run(["process", str(lab), "--calibrate", "off", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["settings"] == str(beside)
    assert run(["info", str(lab.with_name("lab.hiros.mcap"))]) == 0
    assert "changed: filter.cutoff = 7.0" in capsys.readouterr().out
    summary = hiros_mcap.process(lab, calibrate="off")
    assert summary.settings == str(beside)
    own = lab.with_name("own.toml")
    own.write_text("")
    assert run(["process", str(lab), "--calibrate", "off", "--config", str(own)]) == 0
    assert f"; parameters of {own}\n" in capsys.readouterr().out


def test_the_nearest_folder_above_has_the_parameters_of_a_log(lab):
    (lab.parent / "a" / "bag").mkdir(parents=True)
    lab.with_name("hiros.toml").touch()
    assert settings_beside(lab.parent / "a" / "log.mcap") == lab.with_name("hiros.toml")
    (lab.parent / "a" / "hiros.toml").touch()
    assert settings_beside(lab.parent / "a" / "bag") == lab.parent / "a" / "hiros.toml"
    assert settings_beside("-") is settings_beside("ws://lab:8765") is None


def test_each_of_many_logs_has_the_parameters_of_its_folder(lab, tmp_path, capsys):
    for name, cutoff in (("a", 7), ("b", 9)):
        (tmp_path / "logs" / name).mkdir(parents=True)
        shutil.copy(lab, tmp_path / "logs" / name / f"{name}.mcap")
        (tmp_path / "logs" / name / "hiros.toml").write_text(f"[filter]\ncutoff = {cutoff}.0\n")
    out = tmp_path / "out"
    command = f"process {tmp_path / 'logs'} -o {out} --calibrate off -q --jobs 1"
    assert run(command.split()) == 0
    assert f"1 log with parameters of {tmp_path}/logs/b/hiros.toml" in capsys.readouterr().err
    for name, cutoff in (("a", 7), ("b", 9)):
        assert run(["info", str(out / f"{name}.hiros.mcap")]) == 0
        assert f"changed: filter.cutoff = {cutoff}.0" in capsys.readouterr().out


@pytest.mark.parametrize("command", [["info"], ["eval"], ["calibrate", "people"], ["compare"]])
def test_every_command_that_reads_a_log_reads_its_parameters(lab, capsys, command):
    lab.with_name("hiros.toml").write_text("[input]\nunit = 'ell'\n")
    assert run([*command, str(lab)]) == 2
    assert f"{lab.with_name('hiros.toml')}: input.unit" in capsys.readouterr().err


def test_quiet_still_names_the_file_with_the_parameters(lab, capsys):
    lab.with_name("hiros.toml").touch()
    assert run(["process", str(lab), "--calibrate", "off", "-q"]) == 0
    assert capsys.readouterr().err == f"hiros: parameters of {lab.with_name('hiros.toml')}\n"


def test_an_output_without_a_suffix_asks_what_it_is(lab, capsys):
    assert run(["process", str(lab), "-o", str(lab.with_name("new"))]) == 2
    assert capsys.readouterr().err.endswith(f"name it {lab.with_name('new.mcap')}\n")
