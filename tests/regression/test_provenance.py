"""A golden file knows how it was made; a check names first what was made otherwise."""

from __future__ import annotations

import hashlib
import os
import shutil
from pathlib import Path

import pytest

from hiros_cli.app import run
from hiros_mcap.config import load_config
from hiros_mcap.io.channels import PROVENANCE
from hiros_mcap.io.container import McapReader
from hiros_mcap.io.log import digest_of
from hiros_mcap.regression.differences import Provenance, changes
from hiros_mcap.regression.suite import Golden, check_output, write_golden
from hiros_mcap.running.pipeline import ProcessOptions, process


@pytest.fixture(scope="module")
def output(tmp_path_factory):
    out = tmp_path_factory.mktemp("out") / "out.mcap"
    process(SAMPLE, out, options=ProcessOptions(keep=()))
    return out


SAMPLE = Path(__file__).parents[2] / "sample_data" / "one_person_walking.mcap"


def test_a_golden_file_keeps_how_it_was_made(output, tmp_path):
    golden = tmp_path / "golden.mcap"
    check_output(output, Golden(golden), bless=True)
    other = tmp_path / "other.mcap"
    config = load_config(overrides=["filter.cutoff=9", "fuse.acceleration=300"])
    process(SAMPLE, other, config=config, options=ProcessOptions(keep=()))
    result = check_output(other, Golden(golden))
    assert [str(d) for d in result.differences[:2]] == [
        "configuration: filter.cutoff: was 4.5, is 9.0",
        "configuration: fuse.acceleration: was 3.0, is 300.0",
    ]
    assert all(d.where != "configuration" for d in result.differences[2:])
    assert len(result.differences) > 2


def test_a_golden_log_carries_version_configuration_and_input(output, tmp_path):
    write_golden(output, tmp_path / "golden.mcap")
    kept = Provenance.of_log(tmp_path / "golden.mcap")
    assert kept == Provenance.of_log(output)
    assert kept.run["input_sha256"] == hashlib.sha256(SAMPLE.read_bytes()).hexdigest()
    assert kept.run["system"] == "fuse"
    assert kept.parameters["track.max_gap"] == "1.5"
    with McapReader(tmp_path / "golden.mcap") as reader:
        assert reader.attachment("hiros/config.toml")


def test_a_result_says_how_cameras_were_calibrated_if_not_as_usual(output, tmp_path):
    process(SAMPLE, tmp_path / "off.mcap", options=ProcessOptions(stages="T", calibrate="off"))
    told = []
    for path in (output, tmp_path / "off.mcap"):
        with McapReader(path) as reader:
            told.append(dict(reader.contents.metadata)[PROVENANCE].get("calibrate"))
    assert told == [None, "off"]


def test_version_input_and_parameters_that_changed():
    was = Provenance(
        {"version": "1", "input_sha256": "a", "system": "hiros"}, {"filter.cutoff": "6"}
    )
    now = Provenance({"version": "2", "input_sha256": "b", "system": "hiros"}, {"filter.new": "7"})
    assert [str(d) for d in changes(now, was)] == [
        "configuration: filter.cutoff: was 6, is none",
        "configuration: filter.new: was none, is 7",
        "run: hiros version: was 1, is 2",
        "run: input, SHA-256: was a, is b",
    ]
    assert changes(now, now) == []
    assert changes(now, Provenance()) == []
    assert [d.what for d in changes(Provenance(), was)] == ["version and configuration"]


def test_an_equal_result_does_not_list_parameters(output, tmp_path, capsys):
    golden, same = tmp_path / "golden.mcap", tmp_path / "same.mcap"
    check_output(output, Golden(golden), bless=True)
    config = load_config(overrides=["track.max_gap=1.6"])
    process(SAMPLE, same, config=config, options=ProcessOptions(keep=()))
    assert run(["check", str(same), "--golden", str(golden)]) == 0
    assert capsys.readouterr().out.split() == ["equal", "same.mcap"]


def test_files_that_a_run_was_given_are_named_by_their_hash(output, tmp_path):
    limbs = tmp_path / "limbs.toml"
    process(SAMPLE, tmp_path / "a.mcap", options=ProcessOptions(keep=(), limbs_out=limbs))
    process(SAMPLE, tmp_path / "b.mcap", options=ProcessOptions(keep=(), limbs_in=limbs))
    found = changes(Provenance.of_log(tmp_path / "b.mcap"), Provenance.of_log(output))
    assert [d.what for d in found] == ["limb lengths file, SHA-256"]
    assert found[0].now == hashlib.sha256(limbs.read_bytes()).hexdigest()


def test_the_hash_of_a_folder_and_of_a_pipe(tmp_path):
    folder = tmp_path / "bag"
    folder.mkdir()
    shutil.copy(SAMPLE, folder / "b.mcap")
    (folder / "a.yaml").write_bytes(b"first")
    with digest_of(folder) as digest:
        expected = hashlib.sha256(b"first" + SAMPLE.read_bytes()).hexdigest()
        assert digest.result() == expected
    os.mkfifo(tmp_path / "pipe")
    with digest_of(tmp_path / "pipe") as digest:
        assert digest.result() == ""
