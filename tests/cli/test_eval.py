"""``hiros eval`` from outside."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from hiros_cli.app import run
from hiros_mcap.errors import ConfigError
from hiros_mcap.evaluate import load_truth
from hiros_mcap.evaluate.comparison import Entry, Task, run_task
from hiros_mcap.evaluate.logs import evaluate_log, fused_topics
from hiros_mcap.running.pipeline import ProcessOptions, process


@pytest.fixture(scope="module")
def processed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("eval") / "out.mcap"
    process(Path(__file__).parents[2] / "sample_data" / "one_person_walking.mcap", out)
    return out


def test_scores_of_a_result(processed: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["eval", str(processed), "--joints"]) == 0
    text = capsys.readouterr().out
    for word in ("/hiros/tracked", "/hiros/filtered", "HOTA", "left elbow", "WRIST_RIGHT"):
        assert word in text


def test_scores_as_json(processed: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["eval", str(processed), "--json", "--channel", "/hiros/f*"]) == 0
    data = json.loads(capsys.readouterr().out)
    scores = data["channels"]["/hiros/filtered"]
    assert list(data["channels"]) == ["/hiros/filtered"]
    assert 5 < scores["mean"] < 40
    assert scores["tracking"]["mota"] == 1
    assert len(scores["joints"]) == 32


def test_a_recording_is_processed_first(
    walking: Path, processed: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["eval", str(walking), "--json"]) == 0
    raw = json.loads(capsys.readouterr().out)["channels"]
    assert run(["eval", str(processed), "--json"]) == 0
    assert raw == json.loads(capsys.readouterr().out)["channels"]


def test_a_camera_as_the_reference_is_not_in_what_is_compared_with_it(
    walking: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Two cameras capture, the third is the truth: as if these two alone had been processed."""
    reference, capture = "/camera_2/skeletons", ("/camera_0/*", "/camera_1/*")
    process(walking, tmp_path / "two.mcap", options=ProcessOptions(topics=capture))
    expected = evaluate_log(tmp_path / "two.mcap", load_truth(walking, reference))
    assert run(["eval", str(walking), "--truth", reference, "--json"]) == 0
    channels = json.loads(capsys.readouterr().out)["channels"]
    for topic, result in expected.items():
        assert channels[topic]["mean"] == pytest.approx(result.scores.mean)
        assert channels[topic]["deviation"] == pytest.approx(result.scores.deviation)
    outcome = run_task(Task(walking, Entry("hiros"), truth=reference))
    assert outcome.cameras == ("camera_0", "camera_1")
    assert outcome.error == pytest.approx(expected["/hiros/filtered"].scores.mean)
    process(walking, tmp_path / "one.mcap", options=ProcessOptions(stages="T", keep=capture[:1]))
    with pytest.raises(ConfigError, match="no camera is left besides"):
        fused_topics(tmp_path / "one.mcap", "/camera_0/skeletons")


def test_markers_without_a_truth_are_named(
    processed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    table = tmp_path / "truth.csv"
    rows = [f"{t},0,{name},0,0,1" for t in np.arange(0, 3.6, 0.4) for name in ("PELVIS", "NECK")]
    table.write_text("\n".join(["time,person,marker,x,y,z", *rows]))
    assert run(["eval", str(processed), "--truth", str(table), "--match-distance", "9"]) == 0
    text = capsys.readouterr().out
    assert "against the truth, 1 people" in text
    note = next(line for line in text.splitlines() if "no truth for 30 markers" in line)
    assert "WRIST_LEFT" in note
    assert not {"PELVIS", "NECK"} & set(re.findall(r"\w+", note))


def test_without_truth(walking: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["eval", str(walking), "--leave-one-out", "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert len(data["cameras"]) == len(data["disagreement"]) == 3
    assert run(["eval", str(walking), "--leave-one-out"]) == 0
    assert "Mirrored" in capsys.readouterr().out


@pytest.mark.parametrize(("scale", "wrong"), [(1.0, False), (1000.0, True)])
def test_a_truth_that_nobody_is_near_to_may_have_another_unit(
    processed: Path,
    walking: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    scale: float,
    wrong: bool,
) -> None:
    truth = load_truth(walking)
    assert truth.model is not None
    rows = [
        f"{stamp / 1e9:.9f},0,{name},{','.join(f'{scale * x:.4f}' for x in point)}"
        for stamp, (pose,) in zip(truth.stamps.tolist(), truth.positions, strict=True)
        for name, point in zip(truth.model.marker_names, pose.tolist(), strict=True)
    ]
    table = tmp_path / "truth.csv"
    table.write_text("\n".join(["time,person,marker,x,y,z", *rows]))
    assert run(["eval", str(processed), "--truth", str(table)]) == 0
    out = capsys.readouterr().out
    assert ("Is the truth in metres, in the log's fixed frame" in out) == wrong
    assert not wrong or re.search(r"truth \(.*, 8\d\d\.\d\), result \(.*, 0\.8\d*\)", out)


@pytest.mark.parametrize(
    "command",
    ["eval {log}", "eval {log} --leave-one-out", "compare {raw} --system raw --jobs 1"],
)
def test_quiet_prints_nothing(
    command: str, processed: Path, walking: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = command.format(log=processed, raw=walking).split()
    assert run([*arguments, "-q"]) == 0
    assert capsys.readouterr() == ("", "")
    assert run([*arguments, "-q", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)


@pytest.mark.parametrize("options", [[], ["--leave-one-out"]], ids=["truth", "no truth"])
def test_the_page_is_one_file(processed: Path, tmp_path: Path, options: list[str]) -> None:
    page = tmp_path / "report.html"
    assert run(["eval", str(processed), "--html", str(page), *options]) == 0
    text = page.read_text(encoding="utf-8")
    assert text.count("<svg") >= 1
    assert not re.findall(r"""(?:src|href)=["'](?!#|data:)""", text)
    for name in ("left elbow", "WRIST_LEFT") if not options else ("Of nobody",):
        assert name in text


@pytest.mark.parametrize(
    ("arguments", "fault"),
    [
        ([], "Missing argument 'LOG'"),
        (["{log}", "--truth", "nowhere.trc"], "neither a file nor a channel"),
        (["{log}", "--truth", "/nothing"], "/nothing"),
        (["{log}", "--up", "x"], "neither z nor y"),
        (["{log}", "--channel", "/hiros/none"], "/hiros/none"),
        (["{log}", "--html", "/nowhere/at/all.html"], "no such folder"),
        (["{log}", "--shift", "1000"], "the truth covers no frame"),
        (["{log}", "--shift", "inf"], "'--shift'"),
        (["{log}", "--shift", "nan"], "'--shift'"),
    ],
)
def test_faults_are_one_line(
    processed: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], fault: str
) -> None:
    given = [a.format(log=processed) for a in arguments]
    assert run(["eval", *given]) == 2
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1
    assert fault in captured.err
