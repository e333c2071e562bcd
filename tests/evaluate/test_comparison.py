"""Systems on the same log."""

from __future__ import annotations

import json
import re
import time

import pytest
from odd_logs import shifted
from stick_figures import SECOND, START, person, seen

from hiros_cli.app import run
from hiros_mcap.config import load_config
from hiros_mcap.errors import ConfigError
from hiros_mcap.evaluate import Truth, score_tables
from hiros_mcap.evaluate.comparison import (
    DEFAULT,
    Entry,
    MeanDifference,
    Task,
    _by_second,
    by_number_of_cameras,
    camera_subsets,
    comparison,
)
from hiros_mcap.evaluate.leave_one_out import leave_one_out
from hiros_mcap.evaluate.logs import (
    consistency,
    evaluate_channels,
    evaluate_log,
    find_truth,
    output_channels,
    read_channel,
    results_of,
    start_of,
)
from hiros_mcap.evaluate.match import match
from hiros_mcap.evaluate.measures import text_of
from hiros_mcap.running.pipeline import ProcessOptions, process
from hiros_mcap.simulate import SimulateParams
from hiros_mcap.simulate.simulation import write_log
from hiros_mcap.systems import SYSTEMS, System
from hiros_mcap.wording import plain


def test_entries_are_read_and_checked():
    entry = Entry.parse("lee:tm,cluster.radius=0.2")
    assert (entry.system, entry.stages, entry.assignments) == ("lee", "TM", ("cluster.radius=0.2",))
    assert entry.name == "lee:TM,cluster.radius=0.2"
    assert Entry.parse("hiros").name == "hiros"
    for text in ("hydra", "hiros:FT", "lee,cluster.size=1", "lee,cluster.radius=-1"):
        with pytest.raises(ConfigError):
            Entry.parse(text)


@pytest.fixture(scope="module")
def faulty(tmp_path_factory):
    """A recording with wrong poses and wrong clocks."""
    path = tmp_path_factory.mktemp("faulty") / "log.mcap"
    scene = {"cameras": 3, "seconds": 6.0, "seed": 5, "calibration_error": 4.0}
    write_log(
        path, SimulateParams.model_validate({**scene, "rig": {"rate": 10.0, "clock_offset": 0.2}})
    )
    return path


@pytest.mark.parametrize("name", ["fuse", "fuse-realtime"])
def test_process_eval_and_compare_give_one_score(faulty, tmp_path, name):
    """Clocks and poses are corrected alike in all of them."""
    out = tmp_path / "out.mcap"
    config = load_config(system=name)
    summary = process(faulty, out, config=config, options=ProcessOptions(name))
    if name == "fuse":
        assert any(camera.used for camera in summary.poses)
        assert any(fault.corrected for camera in summary.cameras for fault in camera.clock)
    truth = find_truth(faulty)
    assert truth is not None
    expected = numbers(list(evaluate_log(out, truth).values())[-1].scores)
    compared = comparison([Task(faulty, Entry(name))])[0]
    assert numbers(compared.scores) == expected
    assert compared.milliseconds > 0
    channels = results_of(faulty, config, system=name)
    assert numbers(list(evaluate_channels(channels, truth).values())[-1].scores) == expected
    alone = leave_one_out(faulty, config=config, options=ProcessOptions(name))
    frames, model, _ = read_channel(out, output_channels(out)[-1])
    assert alone.consistency == consistency(frames, model)


def numbers(scores):
    """All scores as text, where two NaN are equal."""
    assert scores is not None
    return json.dumps(plain(scores))


def test_side_by_side_as_one_after_the_other(walking):
    tasks = [Task(walking, Entry(name)) for name in ("raw", "hiros", "average")]
    together, alone = comparison(tasks, jobs=2), comparison(tasks, jobs=1)
    assert [o.name for o in together] == ["raw", "hiros", "average"]
    assert [o.error for o in together] == [o.error for o in alone]
    header, rows = text_of(*score_tables.system_sheets(together))
    assert header[:2] == ("System", "Mean")
    assert [row[0] for row in rows] == ["hiros", "average", "raw"]


def test_what_the_first_call_of_a_kernel_costs_is_not_timed(walking, monkeypatch):
    called: list[int] = []

    def slow_at_first(frames):
        if not called:
            end = time.process_time() + 0.15
            while time.process_time() < end:
                pass
        called.append(0)
        yield from frames

    one_stage = System("", lambda _: {"tracked": slow_at_first}, ("T",), ("associate",))
    monkeypatch.setitem(SYSTEMS, "slow", one_stage)
    outcome = comparison([Task(walking, Entry("slow"))])[0]
    assert len(called) == 2
    assert outcome.milliseconds < 0.5


def test_the_realtime_preset_takes_part_as_a_system(crossing, tmp_path):
    config = load_config(preset="realtime", system="hiros")
    process(crossing, tmp_path / "a.mcap", config=config, options=ProcessOptions("hiros"))
    process(crossing, tmp_path / "b.mcap", options=ProcessOptions(system="hiros-realtime"))
    truth = find_truth(crossing)
    assert truth is not None
    each = [
        evaluate_log(tmp_path / name, truth)["/hiros/filtered"].scores.mean
        for name in ("a.mcap", "b.mcap")
    ]
    outcomes = comparison([Task(crossing, Entry(name)) for name in DEFAULT[2:4]], jobs=1)
    assert [o.name for o in outcomes] == ["hiros", "hiros-realtime"]
    assert each[0] == each[1] == pytest.approx(outcomes[1].error)
    assert outcomes[0].error < outcomes[1].error


def test_every_subset_of_the_cameras(walking):
    tasks = camera_subsets(Task(walking, Entry("hiros")))
    assert [len(task.sources or ()) for task in tasks] == [1, 1, 1, 2, 2, 2, 3]
    table = by_number_of_cameras(comparison(tasks, jobs=1))
    errors = [table["hiros"][n][0] for n in (1, 2, 3)]
    assert errors[0] > errors[1] > errors[2]


def test_errors_by_number_of_cameras_as_a_table():
    header, rows = text_of(score_tables.camera_sheet({"hiros": {1: (30.0, 5.0), 3: (20.0, 4.0)}}))
    assert header == ("System", "1", "3")
    assert rows == [("hiros", "30.0 (5.0)", "20.0 (4.0)")]


def test_from_outside(walking, tmp_path, capsys):
    page = tmp_path / "a.html"
    arguments = ["--system", "raw", "--system", "hiros:TM", "--jobs", "1"]
    assert run(["compare", str(walking), *arguments, "--html", str(page)]) == 0
    text = capsys.readouterr().out
    assert text.index("\nhiros:TM") < text.index("\nraw")
    assert "hiros:TM" in page.read_text(encoding="utf-8")
    assert run(["compare", str(walking), *arguments, "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert {o["name"] for o in data["outcomes"]} == {"raw", "hiros:TM"}


@pytest.fixture
def bare(walking, tmp_path):
    """A recording without a truth."""
    path = tmp_path / "bare.mcap"
    process(walking, path, options=ProcessOptions(stages="T", keep=("/camera_*", "/tf_static")))
    return path


def test_the_last_instant_counts_where_a_truth_lasts_whole_seconds():
    frames = [seen([person()], START + k * SECOND, ids=[0]) for k in range(3)]
    truth = Truth.of(frames)
    distances = _by_second(match(frames, truth), truth)
    assert distances.stamps.tolist() == [frame.stamp for frame in frames]
    assert distances.joints.ravel().tolist() == [0.0, 0.0, 0.0]


def test_without_a_truth_nothing_is_ranked(bare, tmp_path, capsys):
    page = tmp_path / "a.html"
    for first, second in (("hiros", "raw"), ("raw", "hiros")):
        arguments = ["--system", first, "--system", second, "--jobs", "1", "--html", str(page)]
        assert run(["compare", str(bare), *arguments]) == 0
        text = capsys.readouterr().out
        assert text.index(f"{first} ") < text.index(f"{second} ")
        assert "Not ranked" in text
        html = page.read_text(encoding="utf-8")
        assert "Least error first" not in html
        for said in (text, html):
            assert "error" not in said.replace("neither the error nor", "").replace(
                "misses errors that all", ""
            )
    assert run(["compare", str(bare), "--study", "cameras"]) == 2
    assert "needs a truth" in capsys.readouterr().err


def test_a_result_without_its_recording_cannot_be_compared(walking, tmp_path, capsys):
    process(walking, tmp_path / "result.mcap", options=ProcessOptions(keep=()))
    process(walking, tmp_path / "truth.mcap", options=ProcessOptions(keep=("/truth/*",)))
    for name in ("result.mcap", "truth.mcap"):
        assert run(["compare", str(tmp_path / name), "--system", "hiros"]) == 2
        line = capsys.readouterr().err
        assert line.endswith("holds results or a truth, but no detections; name the recording\n")
        assert line.count("\n") == 1


def test_who_is_better_is_said_with_an_interval(bare, walking, capsys):
    for log in (bare, walking):
        arguments = ["--system", "hiros", "--system", "raw", "--jobs", "1"]
        assert run(["compare", str(log), *arguments]) == 0
        text = capsys.readouterr().out
        rows = {line.split()[0]: line.rstrip() for line in text.splitlines() if line.strip()}
        assert "Against" in text
        assert rows["hiros"].endswith(" -")
    assert "worse" in rows["raw"]
    assert "smoothing, not fusion" not in text


@pytest.mark.parametrize(
    ("low", "high", "sure"),
    [(0.2, 0.9, True), (-0.9, -0.2, True), (-0.2, 0.9, False), (0.0, 0.0, False)],
)
def test_a_difference_is_sure_if_its_interval_lies_on_one_side_of_0(low, high, sure):
    difference = MeanDifference("raw", (low + high) / 2, low, high, 9)
    assert difference.is_sure is sure
    assert ("no difference" in str(difference)) is not sure


def test_what_is_known_without_a_truth_and_a_system_is_no_better_than_itself(bare, capsys):
    systems = ["--system", "hiros", "--system", "hiros", "--system", "raw"]
    assert run(["compare", str(bare), *systems, "--jobs", "1", "--json"]) == 0
    one, other, raw = json.loads(capsys.readouterr().out)["outcomes"]
    assert raw["scores"] is one["scores"] is None
    assert not any("error" in key or "rank" in key for key in raw)
    assert raw["jitter"] > 5 * one["jitter"]
    assert 0.9 < one["coverage"] <= 1
    assert (one["ids"], one["distance"]["median"] > 0) == (1, True)
    assert one["difference"] is None
    assert other["difference"]["mm"] == other["difference"]["low"] == 0
    assert {k: one[k] for k in ("distance", "misses", "detections")} == {
        k: other[k] for k in ("distance", "misses", "detections")
    }
    assert one["detections"] > 100


def test_two_cameras_test_smoothing(walking, tmp_path, capsys):
    log = tmp_path / "two.mcap"
    keep = ("/camera_0/*", "/camera_1/*", "/tf_static")
    process(walking, log, options=ProcessOptions(stages="T", topics=keep[:2], keep=keep))
    for command in (["compare", "--system", "raw", "--jobs", "1"], ["eval", "--leave-one-out"]):
        assert run([*command, str(log)]) == 0
        assert "smoothing, not fusion" in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize(
    ("arguments", "fault"),
    [
        ([], "Missing argument 'LOG'"),
        (["{log}", "--study", "weather"], "is no study; there is: cameras"),
        (["{log}", "--system", "hydra"], "no system 'hydra'"),
        (["{log}", "{log}", "--truth", "a.trc"], "needs exactly one LOG"),
        (["{log}", "--html", "/nowhere/at/all.html"], "no such folder"),
    ],
)
def test_faults_are_one_line(walking, capsys, arguments, fault):
    assert run(["compare", *(a.format(log=walking) for a in arguments)]) == 2
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1
    assert fault in captured.err


@pytest.fixture(scope="module")
def usual(crossing):
    return comparison([Task(crossing, Entry("fuse"))])[0]


@pytest.mark.parametrize("begin", [0, 52, 10**9 - 1])
def test_simulated_time_is_scored_as_any_other(usual, crossing, tmp_path, begin):
    """Logs from Gazebo (use_sim_time) begin at 52 s after 1970."""
    ahead = begin - start_of(crossing) // SECOND
    simulated = shifted(crossing, tmp_path / "sim.mcap", lambda topic: ahead)
    assert comparison([Task(simulated, Entry("fuse"))])[0].error == pytest.approx(usual.error, 0.02)
    process(simulated, tmp_path / "out.mcap")
    truth = find_truth(tmp_path / "out.mcap")
    assert truth is not None
    truth = truth.moved(start=start_of(tmp_path / "out.mcap"))
    (last,) = evaluate_log(tmp_path / "out.mcap", truth, ["/hiros/filtered"]).values()
    assert last.scores.mean == pytest.approx(usual.error, 0.02)


@pytest.mark.parametrize("command", [["eval"], ["compare", "--system", "fuse"]])
def test_a_truth_of_another_time_is_one_line(crossing, tmp_path, capsys, command):
    of_truth = lambda topic: 1000 * topic.startswith("/truth")  # noqa: E731
    other = shifted(crossing, tmp_path / "other.mcap", of_truth)
    assert run([*command, str(other)]) == 2
    assert re.search(r"other.mcap: /hiros/\w+: the truth covers no frame", capsys.readouterr().err)


@pytest.mark.parametrize("glob", ["/camera_*/skeletons", "/no/such"])
def test_eval_and_compare_refuse_a_truth_alike(crossing, capsys, glob):
    assert run(["eval", str(crossing), "--truth", glob]) == 2
    expected = capsys.readouterr().err
    assert run(["compare", str(crossing), "--system", "fuse", "--truth", glob]) == 2
    assert capsys.readouterr().err == expected
