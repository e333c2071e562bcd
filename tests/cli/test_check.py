"""``hiros check`` from outside: exit codes, reports, faults in one line."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from odd_logs import changed

from hiros_cli.app import run
from hiros_mcap.config import load_config
from hiros_mcap.running.pipeline import process
from hiros_mcap.skeletons import People

SAMPLES = Path(__file__).parents[2] / "sample_data"


@pytest.fixture(scope="module")
def output(walking, tmp_path_factory):
    out = tmp_path_factory.mktemp("check") / "out.mcap"
    exact = load_config(overrides=["output.precision=full"])
    process(walking, out, config=exact)
    return out


@pytest.fixture
def suite(walking, tmp_path):
    shutil.copy(walking, tmp_path)
    path = tmp_path / "suite.toml"
    path.write_text('[[log]]\ninput = "one_person_walking.mcap"\nrequire = ["people = 1"]\n')
    return path


def test_a_result_without_orientations_equals_its_golden_log(walking, tmp_path):
    def position_only(frame, _):
        return frame.replace(links=np.full_like(frame.links, np.nan))

    log = changed(walking, tmp_path / "log.mcap", position_only)
    out, golden = tmp_path / "out.mcap", tmp_path / "golden.mcap"
    process(log, out)
    assert run(["check", str(out), "--golden", str(golden), "--bless"]) == 0
    assert run(["check", str(out), "--golden", str(golden)]) == 0


def test_a_result_in_the_folder_of_a_bag_is_a_result(walking, output, tmp_path):
    folder, golden = tmp_path / "bag", tmp_path / "golden.mcap"
    exact = load_config(overrides=["output.precision=full"])
    process(walking, f"{folder}/", config=exact)
    assert run(["check", str(folder), "--golden", str(output)]) == 0
    assert run(["check", str(folder), "--golden", str(golden), "--bless"]) == 0
    assert run(["check", str(output), "--golden", str(golden)]) == 0


@pytest.mark.parametrize("keep", [True, False])
def test_the_result_of_an_empty_room_is_checked_and_scored_against_a_truth(
    walking, keep, tmp_path, capsys
):
    def nobody(frame, _):
        return frame.replace(people=People(*(array[:0] for array in frame.people)))

    log = changed(walking, tmp_path / "log.mcap", nobody, keep=keep)
    out, golden = tmp_path / "out.mcap", str(tmp_path / "golden.mcap")
    process(log, out)
    assert run(["check", str(out), "--golden", golden, "--bless"]) == 0
    assert run(["check", str(out), "--golden", golden]) == 0
    capsys.readouterr()
    assert run(["eval", str(out), "--json"]) == 0
    scores = json.loads(capsys.readouterr().out)["channels"]["/hiros/filtered"]
    assert scores["missing"] > 0 == scores["false"]
    assert run(["compare", str(log), "--system", "hiros", "--system", "raw", "--jobs", "1"]) == 0
    # It must not give the truth for a result.
    assert run(["export", str(out), "-o", str(tmp_path / "out.csv")]) == 2
    assert "there is nobody in /hiros/filtered" in capsys.readouterr().err


def test_bless_check_and_differ(output, tmp_path, capsys):
    golden, tolerances = tmp_path / "golden.mcap", tmp_path / "t.toml"
    assert run(["check", str(output), "--golden", str(golden), "--bless"]) == 0
    assert "accepted: a new golden file" in capsys.readouterr().out
    assert run(["check", str(output), "--golden", str(golden)]) == 0
    assert capsys.readouterr().out.split() == ["equal", "out.mcap"]
    other = SAMPLES / "golden" / "two_people_crossing.mcap"
    assert run(["check", str(output), "--golden", str(other), "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["different"] == 1
    tolerances.write_text("positions = 0\n")
    strict = ["--golden", str(golden), "--tolerances", str(tolerances)]
    assert run(["check", str(output), *strict]) == 1
    out = capsys.readouterr().out
    assert "positions: was " in out
    largest = re.search(r"positions: was .*up to (\S+) mm", out)
    assert largest
    assert 0 < float(largest[1]) <= 1.1e-4  # golden files have 0.1 um


def test_a_suite_with_reports(suite, tmp_path, capsys):
    junit, markdown, kept = tmp_path / "j.xml", tmp_path / "m.md", tmp_path / "kept"
    reports = ["--junit", str(junit), "--markdown", str(markdown), "--keep", str(kept)]
    assert run(["check", str(suite), *reports]) == 0
    assert ElementTree.parse(junit).getroot()[0].get("failures") == "0"
    assert markdown.read_text(encoding="utf-8").startswith("### hiros check: suite: 1 of 1")
    assert (kept / "one_person_walking.mcap").stat().st_size > 0
    assert capsys.readouterr().out.split() == ["equal", "one_person_walking"]
    suite.write_text(suite.read_text().replace("people = 1", "people = 3"))
    assert run(["check", str(suite)]) == 1
    assert "people: was required = 3, is 1" in capsys.readouterr().out
    (tmp_path / "one_person_walking.mcap").write_bytes(b"nothing")
    assert run(["check", str(suite)]) == 2


def test_quiet_leaves_differences_and_errors(suite, tmp_path, capsys):
    assert run(["check", str(suite), "-q"]) == 0
    assert capsys.readouterr() == ("", "")
    assert run(["check", str(suite), "-q", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["equal"] == 1
    suite.write_text(suite.read_text().replace("people = 1", "people = 3"))
    assert run(["check", str(suite), "-q"]) == 1
    out, err = capsys.readouterr()
    assert (out.splitlines()[0], err) == ("different one_person_walking", "")
    assert "people" in out
    (tmp_path / "one_person_walking.mcap").write_bytes(b"nothing")
    assert run(["check", str(suite), "-q"]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("hiros: error: one_person_walking: ")
    assert captured.err.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "fault"),
    [
        (["{output}"], "name the golden log with --golden"),
        (["{output}", "--golden", "/nowhere.mcap"], "no such golden file"),
        (["{output}", "--golden", "{recording}"], "is no golden log"),
        (["{recording}", "--golden", "{output}"], "run `hiros process` first"),
        (["{output}", "--golden", "/etc/passwd"], "ends in .mcap"),
        (["{output}", "--junit", "a.xml"], "--junit has no effect on an output"),
        (["{suite}", "--golden", "a.mcap"], "--golden has no effect on a suite"),
        (["{suite}", "--only", "run"], "no case 'run'"),
        (["{suite}", "--junit", "/nowhere/at/all.xml"], "no such folder"),
        (["/nowhere/suite.toml"], "/nowhere/suite.toml"),
    ],
)
def test_faults_are_one_line(walking, output, suite, capsys, arguments, fault):
    assert (
        run(
            ["check", *(a.format(output=output, suite=suite, recording=walking) for a in arguments)]
        )
        == 2
    )
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1
    assert fault in captured.err
