"""Suites on the real chain: what breaks a stage is caught and named, what does not is not."""

from __future__ import annotations

import json
import shutil
import tomllib
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from stick_figures import MODEL, at, person, seen

from hiros_mcap.config import load_config
from hiros_mcap.errors import ConfigError
from hiros_mcap.evaluate import Truth, evaluate, load_truth
from hiros_mcap.evaluate.logs import output_channels
from hiros_mcap.evaluate.measures import MEASURES
from hiros_mcap.frames import by_block, by_frame
from hiros_mcap.regression import check_report
from hiros_mcap.regression.differences import (
    ChannelComparison,
    Comparison,
    Difference,
    Divergence,
    compare_logs,
)
from hiros_mcap.regression.metrics import Threshold, metrics_of
from hiros_mcap.regression.quantities import Tolerances, beside
from hiros_mcap.regression.suite import (
    CaseResult,
    Golden,
    check_output,
    load_suite,
    run_suite,
    write_golden,
)
from hiros_mcap.running.pipeline import ProcessOptions, process
from hiros_mcap.systems import SYSTEMS

SAMPLES = Path(__file__).parents[2] / "sample_data"
FULL = load_config(overrides=["output.precision=full", "output.derivatives=all"])
SUITE = """
[[log]]
name = "walk"
input = "walk.mcap"
golden = "golden/walk.mcap"
channels = ["/hiros/*"]
require = ["mpjpe <= 25 mm", "id_switches = 0"]
system = "hiros"
"""


def test_the_total_adds_what_every_log_took():
    cases = [("a", "equal", 1.0), ("b", "error", 2.5), ("c", "different", 0.2)]
    results = [CaseResult(name, status, seconds=s) for name, status, s in cases]  # type: ignore[arg-type]
    assert check_report.totals(results) == ("1 of 3 logs as expected, 1 different, 1 failed, 3.7 s")


def test_the_sample_logs_give_what_they_gave():
    results = run_suite(load_suite(SAMPLES / "suite.toml"), jobs=1)
    assert {r.name: (r.error, r.differences) for r in results} == {
        r.name: ("", ()) for r in results
    }
    assert len(results) == 6


@pytest.fixture(scope="module")
def golden(short):
    """The golden outputs of all stages of a log of 1 s."""
    out = short.with_name("out.mcap")
    causal = load_config(overrides=["output.log_time=causal"], system="hiros")
    process(short, out, config=causal, options=ProcessOptions("hiros", keep=()))
    write_golden(out, short.with_name("golden.mcap"), ["/hiros/*"])
    return short.with_name("golden.mcap")


@pytest.fixture
def suite(short, golden, tmp_path):
    """A suite of one log, with the golden outputs of all its stages."""
    shutil.copy(short, tmp_path / "walk.mcap")
    (tmp_path / "golden").mkdir()
    shutil.copy(golden, tmp_path / "golden" / "walk.mcap")
    path = tmp_path / "suite.toml"
    path.write_text(SUITE)
    return path


def change_stage(monkeypatch, name, wrap):
    """Let the frames of one stage pass through ``wrap``."""
    hiros = SYSTEMS["hiros"]

    def changed(run):
        table = dict(hiros.stages(run))
        stage = by_frame(table[name])
        table[name] = by_block(lambda frames: wrap(stage(frames)))
        return table

    monkeypatch.setitem(SYSTEMS, "hiros", replace(hiros, stages=changed))


def lifted(metres):
    def wrap(frames):
        for frame in frames:
            markers = frame.markers.copy()
            markers[..., 2] += metres
            yield frame.replace(markers=markers)

    return wrap


@pytest.mark.parametrize(
    ("stage", "equal"), [("tracked", []), ("merged", ["tracked"]), ("filtered", ["optimized"])]
)
def test_a_broken_stage_is_caught_and_named(suite, monkeypatch, stage, equal):
    change_stage(monkeypatch, stage, lifted(0.001))
    (result,) = run_suite(load_suite(suite), jobs=1)
    assert result.status == "different"
    assert result.first[0][0] == f"/hiros/{stage}"
    assert "is off by 1 mm" in result.first[0][1].what
    if equal:
        assert result.notes[0].startswith(f"first channel that differs: /hiros/{stage}; equal: ")
        assert f"/hiros/{equal[-1]}" in result.notes[0]


def test_what_is_tolerated_is_no_first_difference(monkeypatch):
    """Of ten frames, one is missing in the merger's channel, two in the filter's."""
    first = Divergence(3, 0, 0.1, "the frame is missing")
    channels = [
        ChannelComparison(f"/hiros/{name}", frames=10, missing_frames=missing, first=first)
        for name, missing in (("merged", 1), ("filtered", 2))
    ]
    monkeypatch.setattr(
        "hiros_mcap.regression.suite.compare_logs", lambda *_, **__: Comparison(channels)
    )
    golden = Golden(SAMPLES / "golden" / "one_person_walking.mcap", Tolerances(frames=0.1))
    result = golden.check(CaseResult("walk", "equal"), golden.path, bless=False)
    assert result.status == "different"
    assert result.notes == ("first channel that differs: /hiros/filtered; equal: /hiros/merged",)
    assert [str(d) for d in result.differences] == [
        "/hiros/filtered: frames: was 10, is 8 (2 missing, 0 extra)"
    ]
    assert result.first == (("/hiros/filtered", first),)


def renumbered(frames):
    for frame in frames:
        yield frame.replace(ids=frame.ids + np.int32(40))


@pytest.mark.parametrize(
    ("stage", "wrap"), [("filtered", lifted(1e-9)), ("tracked", renumbered)], ids=["1 nm", "ids"]
)
def test_a_harmless_change_is_not_reported(suite, monkeypatch, stage, wrap):
    change_stage(monkeypatch, stage, wrap)
    (result,) = run_suite(load_suite(suite), jobs=1)
    assert (result.status, result.differences) == ("equal", ())


def test_bless_accepts_and_says_what(suite):
    golden = suite.parent / "golden" / "walk.mcap"
    before = golden.read_bytes()
    text = suite.read_text() + 'set = ["filter.cutoff=8"]\n'
    assert run_suite(load_suite(suite), bless=True, jobs=1)[0].notes == (
        "unchanged; the golden file is kept",
    )
    assert golden.read_bytes() == before
    suite.write_text(text)
    assert run_suite(load_suite(suite), jobs=1)[0].status == "different"
    (blessed,) = run_suite(load_suite(suite), bless=True, jobs=1)
    assert blessed.notes[0] == "accepted: configuration: filter.cutoff: was 4.5, is 8.0"
    assert any("accepted: /hiros/filtered: positions: was" in note for note in blessed.notes)
    assert run_suite(load_suite(suite), jobs=1)[0].status == "equal"
    assert golden.read_bytes() != before


def test_a_missing_input_fails_its_case_and_no_other(suite):
    suite.write_text(SUITE + '[[log]]\ninput = "none.mcap"\nrequire = ["people = 1"]\n')
    walk, none = run_suite(load_suite(suite), bless=True, jobs=1)
    assert (walk.status, none.status) == ("equal", "error")
    assert "none.mcap: there is no such input" in none.error
    (alone,) = run_suite(load_suite(suite), only=["walk"], jobs=1)
    assert alone.status == "equal"


def test_a_golden_log_of_a_suite_equals_a_plain_run(suite, tmp_path):
    run_suite(load_suite(suite), bless=True, jobs=1)
    process(suite.with_name("walk.mcap"), tmp_path / "plain.mcap", system="hiros")
    golden = Golden(suite.parent / "golden" / "walk.mcap")
    result = check_output(tmp_path / "plain.mcap", golden)
    assert (result.status, result.differences) == ("equal", ())
    assert result.notes[0].startswith("log times are not compared: of the golden log they are")


def test_in_parallel_as_one_after_the_other(suite):
    text = SUITE.replace('"walk"', '"again"') + SUITE.replace('"walk"', '"other"')
    suite.write_text(SUITE + text.replace("<= 25 mm", "<= 1 mm"))
    results = run_suite(load_suite(suite), only=["other", "walk"], jobs=2)
    assert [(r.name, r.status) for r in results] == [("walk", "equal"), ("other", "different")]


def test_a_case_runs_the_system_that_it_names(suite, tmp_path):
    suite.write_text('[[log]]\ninput = "walk.mcap"\nsystem = "raw"\nrequire = ["people = 1"]\n')
    run_suite(load_suite(suite), jobs=1, keep=tmp_path / "golden")
    assert output_channels(tmp_path / "golden" / "walk.mcap") == ["/hiros/tracked"]


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("", "expects"),
        ("[[log]", "not TOML"),
        ('[[log]]\ninput = "walk.mcap"\ngolden = "a.txt"', "is no .mcap file"),
        ('[[log]]\ninput = "walk.mcap"\nrequire = ["height < 2 m"]', "no metric 'height'"),
        ('[[log]]\ninput = "walk.mcap"\nrequire = ["mpjpe < 2 cm"]', "mpjpe is in mm"),
        ('[[log]]\ninput = "walk.mcap"\nrequire = ["mpjpe is ok"]', "not of the form"),
        ('[[log]]\ninput = "walk.mcap"\ngolden = "a.mcap"\nfoo = 1', "walk.mcap: foo: there"),
        ('[[log]]\nname = "kitchen"\ninptu = "walk.mcap"', "log kitchen: inptu: there is no"),
        ('[[log]]\nname = "kitchen"', "log kitchen: input: is missing"),
        ('[[log]]\ninput = "walk.mcap"', "log walk.mcap: expects nothing"),
        (
            '[[log]]\ninput = "walk.mcap"\ngolden = "a.mcap"\ntolerances = {positions = -1}',
            "positions",
        ),
        (SUITE + SUITE, "two cases are called 'walk'"),
    ],
)
def test_faulty_suites(suite, text, fault):
    suite.write_text(text)
    with pytest.raises(ConfigError, match=fault) as caught:
        load_suite(suite)
    assert str(suite) in str(caught.value)


def test_a_golden_log_is_compact_and_equal_to_its_source(walking, tmp_path):
    out, golden = tmp_path / "out.mcap", tmp_path / "golden.mcap"
    process(walking, out, options=ProcessOptions(keep=()))
    write_golden(out, golden, ["/hiros/*"])
    comparison = compare_logs(out, golden)
    assert len(comparison.channels) == 4
    assert comparison.differences(Tolerances()) == {}
    assert 0 < max(c.quantities["positions"].largest for c in comparison.channels) < 2e-7
    process(walking, tmp_path / "full.mcap", config=FULL, options=ProcessOptions(keep=()))
    assert golden.stat().st_size < (tmp_path / "full.mcap").stat().st_size / 3
    first = golden.read_bytes()
    write_golden(out, golden, ["/hiros/*"])
    assert golden.read_bytes() == first


def test_tolerances_beside_the_golden_file(tmp_path):
    assert beside(tmp_path / "a.mcap") == Tolerances()
    (tmp_path / "a.tolerances.toml").write_text("positions = 0.001\n")
    assert beside(tmp_path / "a.mcap").positions == 0.001
    (tmp_path / "a.tolerances.toml").write_text("position = 0.001\n")
    with pytest.raises(ConfigError, match="position"):
        beside(tmp_path / "a.mcap")


def test_an_early_result_is_as_bad_as_a_late_one(walking, tmp_path):
    out = tmp_path / "out.mcap"
    process(walking, out)
    truth = load_truth(walking)
    for seconds in (-0.03, 0.03):
        metrics = metrics_of(out, "/hiros/filtered", truth.moved(seconds))
        assert metrics["lag"] == pytest.approx(30, abs=2)


@pytest.mark.parametrize(
    ("text", "values", "fault"),
    [
        ("mpjpe <= 25 mm", {"mpjpe": 25.0}, ""),
        ("mpjpe < 25", {"mpjpe": 25.0}, "mpjpe: was required < 25 mm, is 25 mm"),
        ("people=2", {"people": 2.0}, ""),
        ("people == 2", {"people": 3.0}, "people: was required == 2, is 3"),
        ("people != 2", {"people": 2.0}, "people: was required != 2, is 2"),
        ("mpjpe <= 25", {"mpjpe": 25.1}, "mpjpe: was required <= 25 mm, is 25.1 mm"),
        ("mota > 0.5", {"mota": 0.5}, "mota: was required > 0.5, is 0.5"),
        ("hota >= 0.9", {"hota": 0.9}, ""),
        ("hota >= 0.9", {"hota": 0.8}, "hota: was required >= 0.9, is 0.8"),
        ("mota > 0", {}, "is not known (no truth, or nothing to measure)"),
    ],
)
def test_thresholds(text, values, fault):
    difference = Threshold.parse(text).difference(values)
    assert (difference is None) == (fault == "")
    assert fault in str(difference)


RESULTS = [
    CaseResult("good | one", "equal", metrics={"mpjpe": 20.0}, seconds=1.0),
    CaseResult(
        *("bad", "different", ""),
        (
            Difference("configuration", "filter.cutoff", "6.0", "8.0"),
            Difference("/hiros/filtered", "positions", "<b>\x00 1 m", "2 | m", "up to 1000 mm"),
        ),
    ),
    CaseResult("worst", "error", "bad.mcap: not a log"),
]


def test_junit_is_xml_that_counts():
    suite = ElementTree.fromstring(check_report.junit(RESULTS, "suite"))[0]
    assert (suite.get("tests"), suite.get("failures"), suite.get("errors")) == ("3", "1", "1")
    failure = suite[1].find("failure")
    assert failure is not None
    assert failure.get("message") == "configuration: filter.cutoff: was 6.0, is 8.0"
    assert "positions: was <b>? 1 m, is 2 | m" in (failure.text or "")
    assert suite[2].find("error") is not None


def test_junit_is_xml_whatever_the_names_hold():
    results = [CaseResult("a\x01\ufffe", "error", "b\x1b", notes=("c\x02\ud800",))]
    suite = ElementTree.fromstring(check_report.junit(results, "s\x03"))[0]
    assert (suite.get("name"), suite[0].get("name")) == ("s?", "a??")
    assert suite[0].findtext("system-out") == "c??"


@pytest.mark.parametrize("key", ["input", "golden", "truth", "config"])
def test_a_null_character_in_a_name_is_one_line(key, tmp_path):
    table = {"input": "a.mcap", "golden": "a.mcap", key: "a\x00.json"}
    rows = "\n".join(f"{name} = {json.dumps(value)}" for name, value in table.items())
    (tmp_path / "suite.toml").write_text(f"[[log]]\n{rows}\n")
    with pytest.raises(ConfigError, match="suite.toml: log .*: names a file with a null character"):
        load_suite(tmp_path / "suite.toml")


def test_markdown_keeps_to_its_tables_and_has_no_empty_column():
    lines = check_report.markdown(RESULTS, "suite").splitlines()
    assert lines[0].startswith("### hiros check: suite: 1 of 3 logs as expected, 1 different, 1 f")
    table = [[c.strip() for c in line.replace("\\|", "").split("|")[1:-1]] for line in lines[2:7]]
    assert table[0] == ["log", "result", "mpjpe"]
    assert [row[2] for row in table[2:]] == ["20 mm", "-", "-"]
    assert "| where | what | was | is |" in lines
    assert "| configuration | filter.cutoff | 6.0 | 8.0 |" in lines
    assert any("| positions | &lt;b>\x00 1 m | 2 \\| m |" in line for line in lines)
    assert "bad.mcap: not a log" in lines


@pytest.mark.parametrize(
    ("name", "field"),
    [
        ("mpjpe", "mean"),
        ("mpjpe_sd", "deviation"),
        ("mpjpe_95", "percentile_95"),
        ("angle_rmse", "angle_rmse"),
        ("link_angle_rmse", "link_angle_rmse"),
        ("orientation_error", "orientation_error"),
        ("limb_error", "limb_error"),
        ("missing", "missing"),
        ("false", "false"),
        ("id_switches", "switches"),
    ],
)
def test_each_metric_is_that_of_its_name(name, field):
    frame = [seen([person()], at(0), ids=[0])]
    scores = evaluate(frame, Truth.of(frame), MODEL)
    changed = replace(scores, **{field: 7})
    assert MEASURES[name].compared(changed) == 7


def test_the_page_has_the_tolerances():
    page = (SAMPLES.parent / "docs" / "golden.md").read_text(encoding="utf-8")
    block = page.partition("## Tolerances")[2].partition("```toml\n")[2].partition("```")[0]
    assert tomllib.loads(block) == Tolerances().model_dump()
