"""Systems on the same log."""

from __future__ import annotations

import json
import time
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hiros_cli.app import run
from hiros_mcap.config import load_config
from hiros_mcap.errors import ConfigError
from hiros_mcap.evaluate import comparison_tables
from hiros_mcap.evaluate.comparison import (
    DEFAULT,
    Entry,
    Outcome,
    Task,
    by_number_of_cameras,
    camera_orderings,
    camera_subsets,
    check_orderings,
    comparison,
    run_task,
)
from hiros_mcap.evaluate.logs import evaluate_log, find_truth
from hiros_mcap.evaluate.published import (
    LEE,
    LEE_CAMERAS,
    LEE_RADII,
    MALAGUTI,
    MALAGUTI_COLUMNS,
)
from hiros_mcap.evaluate.scores import Scores
from hiros_mcap.running.pipeline import ProcessOptions, process
from hiros_mcap.simulate.body import MARKERS
from hiros_mcap.skeletons import Frame
from hiros_mcap.stages.cluster import LEE_JOINTS
from hiros_mcap.systems import SYSTEMS
from hiros_mcap.systems.run import System


def test_entries_are_read_and_checked() -> None:
    entry = Entry.parse("lee:tm,cluster.radius=0.2")
    assert (entry.system, entry.stages, entry.assignments) == ("lee", "TM", ("cluster.radius=0.2",))
    assert entry.name == "lee:TM,cluster.radius=0.2"
    assert Entry.parse("hiros").name == "hiros"
    for text in ("hydra", "hiros:FT", "lee,cluster.size=1", "lee,cluster.radius=-1"):
        with pytest.raises(ConfigError):
            Entry.parse(text)


def test_the_scores_are_those_of_processing_and_evaluating(walking: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.mcap"
    process(walking, out, options=ProcessOptions(system="malaguti", keep=()))
    truth = find_truth(walking)
    assert truth is not None
    expected = evaluate_log(out, truth)["/hiros/optimized"].scores
    outcome = run_task(Task(walking, Entry("malaguti")))
    assert outcome.scores is not None
    assert outcome.scores.mean == pytest.approx(expected.mean)
    assert outcome.scores.tracking == expected.tracking
    assert outcome.milliseconds > 0


def test_side_by_side_as_one_after_the_other(walking: Path) -> None:
    tasks = [Task(walking, Entry(name)) for name in ("raw", "hiros", "average")]
    together, alone = comparison(tasks, jobs=2), comparison(tasks, jobs=1)
    assert [o.name for o in together] == ["raw", "hiros", "average"]
    assert [o.rank for o in together] == [o.rank for o in alone]
    header, rows = comparison_tables.ranked(together)
    assert header[:2] == ("System", "Mean")
    assert [row[0] for row in rows] == ["hiros", "average", "raw"]


def test_what_the_first_call_of_a_kernel_costs_is_not_timed(
    walking: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    called: list[int] = []

    def slow_at_first(frames: Iterable[Frame]) -> Iterator[Frame]:
        if not called:
            end = time.process_time() + 0.5
            while time.process_time() < end:
                pass
        called.append(0)
        yield from frames

    one_stage = System("", lambda _: {"tracked": slow_at_first}, ("T",))
    monkeypatch.setitem(SYSTEMS, "slow", one_stage)
    outcome = run_task(Task(walking, Entry("slow")))
    assert len(called) == 2
    assert outcome.milliseconds < 0.5


def test_the_realtime_preset_takes_part_as_a_system(crossing: Path, tmp_path: Path) -> None:
    process(crossing, tmp_path / "a.mcap", config=load_config(preset="realtime"))
    process(crossing, tmp_path / "b.mcap", options=ProcessOptions(system="hiros-realtime"))
    truth = find_truth(crossing)
    assert truth is not None
    each = [
        evaluate_log(tmp_path / name, truth)["/hiros/filtered"].scores.mean
        for name in ("a.mcap", "b.mcap")
    ]
    outcomes = comparison([Task(crossing, Entry(name)) for name in DEFAULT[:2]], jobs=1)
    assert [o.name for o in outcomes] == ["hiros", "hiros-realtime"]
    assert each[0] == each[1] == pytest.approx(outcomes[1].rank)
    assert outcomes[0].rank < outcomes[1].rank


@pytest.mark.parametrize("name", ["hiros", "malaguti", "lee-a4"])
def test_every_subset_of_the_cameras(walking: Path, name: str) -> None:
    tasks = camera_subsets(Task(walking, Entry(name)))
    assert [len(task.sources or ()) for task in tasks] == [1, 1, 1, 2, 2, 2, 3]
    table = by_number_of_cameras(comparison(tasks, jobs=1))
    errors = [table[name][n][0] for n in (1, 2, 3)]
    assert errors[0] > errors[1] > errors[2]
    (ordering,) = camera_orderings(table)
    assert ordering.holds


def test_four_systems_and_sixteen_joints_in_one_command(
    walking: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Malaguti's Table I has four columns, Lee's Tables A1 to A6 have 16 rows."""
    assert run(["compare", str(walking), "--study", "malaguti", "--jobs", "1"]) == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert ["Sequence", *MALAGUTI_COLUMNS] in lines
    (own,) = (line for line in lines if line[:1] == [walking.name])
    assert own.count("+-") == 4
    lee = [f"lee-a{k},cluster.joints=lee16" for k in (1, 3, 4, 5)]
    systems = [text for name in lee for text in ("--system", name)]
    arguments = ["--study", "lee", "--jobs", "1", *systems]
    assert run(["compare", str(walking), *arguments]) == 0
    first = [line.split(maxsplit=1)[:1] for line in capsys.readouterr().out.splitlines()]
    joints = [word for words in first for word in words if word in MARKERS]
    assert sorted(joints) == sorted(name.replace("NAVEL", "NAVAL") for name in LEE_JOINTS)


def outcome(scores: Scores, name: str, mean: float) -> Outcome:
    parts = {part: replace(stats, mean=mean) for part, stats in scores.parts.items()}
    return Outcome("log", name, ("a",), 0.1, replace(scores, mean=mean, parts=parts))


@pytest.fixture(scope="module")
def scores() -> Scores:
    walking = Path(__file__).parents[2] / "sample_data" / "one_person_walking.mcap"
    found = run_task(Task(walking, Entry("raw"))).scores
    assert found is not None
    return found


def test_orders_of_the_papers(scores: Scores) -> None:
    names = ("malaguti", "raw", "openptrack", "maf", "lee-a5", "lee-a4", "lee-a3", "lee-a1")
    rising = [outcome(scores, name, 10.0 + k) for k, name in enumerate(names)]
    assert [o.holds for o in check_orderings(rising)] == [True, True]
    falling = [outcome(scores, name, 10.0 - k) for k, name in enumerate(names)]
    assert [o.holds for o in check_orderings(falling)] == [False, False]
    radii = [
        outcome(scores, f"lee-a4,cluster.radius={radius:g}", error)
        for radius, error in zip(LEE_RADII, (12, 10, 11, 15), strict=True)
    ]
    assert [o.holds for o in check_orderings(radii)] == [True]
    assert list(check_orderings(rising[:1])) == []


def test_fixtures_agree_with_what_the_papers_say_of_them() -> None:
    """Means of Malaguti's Table I; A5 is the mean over the radii (M27, L19, L20, L21)."""
    means = np.array(list(MALAGUTI.values())).mean(axis=0)[:, 0]
    assert means == pytest.approx([9.42, 17.66, 15.45, 7.46], abs=0.006)
    assert 1 - means[3] / means[0] == pytest.approx(0.208, abs=0.001)
    assert 1 - means[3] / means[2] == pytest.approx(0.517, abs=0.001)
    radii = np.array(list(LEE_RADII.values())).mean(axis=0)[:, 0]
    assert radii == pytest.approx([pair[0] for pair in LEE["lee-a5"]], abs=0.11)
    for part in range(3):
        errors = [LEE_CAMERAS[n][part][0] for n in (1, 2, 3, 4)]
        assert errors == sorted(errors, reverse=True)


def test_tables_in_the_papers_layouts(scores: Scores) -> None:
    names = ("raw", "maf", "openptrack", "malaguti")
    rows = comparison_tables.malaguti_rows([outcome(scores, n, 50.0) for n in names])
    assert rows[0][0] == "log"
    assert rows[0][1].startswith("5.00 +- ")
    assert rows[-1] == (
        "paper: mean", "9.42 +- 8.48", "17.66 +- 9.22", "15.45 +- 7.77", "7.46 +- 4.26",
    )  # fmt: skip
    (lee,) = comparison_tables.lee_rows([outcome(scores, "lee-a1", 30.0)])
    assert lee[0] == "lee-a1"
    assert lee[2].endswith("[90.9 (44.9)]")
    radii = [outcome(scores, f"lee-a4,cluster.radius={r:g}", 30.0) for r in LEE_RADII]
    upper = [row[2].partition(" [")[2] for row in comparison_tables.lee_rows(radii)]
    assert upper == ["60.2 (36.2)]", "51.6 (26.7)]", "53.5 (26.6)]", "58.1 (27.8)]"]
    header, rows = comparison_tables.joint_rows([outcome(scores, "lee-a1", 30.0)])
    assert header == ("Joint", "lee-a1")
    assert rows[0][0] == "PELVIS"
    assert len(rows) == 32
    two = replace(outcome(scores, "malaguti", 20.0), people=2.0)
    times = comparison_tables.malaguti_times([two])
    assert [row[1] for row in times] == [f"{n * 0.05:.3f}" for n in range(1, 7)]
    assert [row[3] for row in times] == ["13.4", "26.8", "40.2", "53.6", "67.0", "80.4"]
    assert [row[4] for row in times] == ["74.6", "37.3", "24.9", "18.7", "14.9", "12.4"]
    header, rows = comparison_tables.camera_rows({"hiros": {1: (30.0, 5.0), 2: (20.0, 4.0)}})
    assert header == ("System", "1", "2")
    assert rows[0] == ("hiros", "30.0 (5.0)", "20.0 (4.0)")
    assert rows[2] == ("Lee's paper: upper limbs", "125.6 (64.2)", "103.5 (57.5)")


def test_from_outside(walking: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = tmp_path / "a.html"
    arguments = ["--system", "raw", "--system", "hiros:TM", "--jobs", "1"]
    assert run(["compare", str(walking), *arguments, "--html", str(page)]) == 0
    text = capsys.readouterr().out
    assert text.index("hiros:TM") < text.index("raw")
    assert "hiros:TM" in page.read_text(encoding="utf-8")
    assert run(["compare", str(walking), *arguments, "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert {o["name"] for o in data["outcomes"]} == {"raw", "hiros:TM"}


def test_without_a_truth_the_camera_left_out_ranks(
    walking: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bare = tmp_path / "bare.mcap"
    process(walking, bare, options=ProcessOptions(stages="T", keep=("/camera_*", "/tf_static")))
    assert run(["compare", str(bare), "--system", "hiros", "--system", "raw", "--jobs", "1"]) == 0
    assert "Left out" in capsys.readouterr().out
    assert run(["compare", str(bare), "--study", "cameras"]) == 2
    assert "needs a truth" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "fault"),
    [
        ([], "needs a LOG"),
        (["{log}", "--study", "weather"], "none of cameras, radius, people"),
        (["{log}", "--study", "people"], "leave LOG out"),
        (["{log}", "--system", "hydra"], "no system 'hydra'"),
        (["{log}", "{log}", "--truth", "a.trc"], "of one LOG"),
        (["{log}", "--rrd", "/nowhere/at/all.rrd"], "no such folder"),
    ],
)
def test_faults_are_one_line(
    walking: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], fault: str
) -> None:
    assert run(["compare", *(a.format(log=walking) for a in arguments)]) == 2
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1
    assert fault in captured.err
