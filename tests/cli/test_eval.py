"""``hiros eval`` from outside."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from hiros_cli.app import run
from hiros_mcap.errors import ConfigError
from hiros_mcap.evaluate import load_truth
from hiros_mcap.evaluate.comparison import Entry, Task, comparison
from hiros_mcap.evaluate.logs import evaluate_log, fused_topics, start_of
from hiros_mcap.io.channels import add_skeleton_channel
from hiros_mcap.io.codec import Encoder
from hiros_mcap.io.container import McapWriter
from hiros_mcap.running.pipeline import ProcessOptions, process
from hiros_mcap.simulate import SimulateParams, simulate
from hiros_mcap.simulate.simulation import write_log


@pytest.fixture(scope="module")
def processed(walking, tmp_path_factory):
    out = tmp_path_factory.mktemp("eval") / "out.mcap"
    process(walking, out)
    return out


def test_scores_of_a_result(processed, capsys):
    assert run(["eval", str(processed), "--joints"]) == 0
    text = capsys.readouterr().out
    for word in ("/hiros/tracked", "/hiros/filtered", "HOTA", "left elbow", "WRIST_RIGHT"):
        assert word in text


def test_scores_as_json(processed, capsys):
    assert run(["eval", str(processed), "--json", "--channel", "/hiros/f*"]) == 0
    data = json.loads(capsys.readouterr().out)
    scores = data["channels"]["/hiros/filtered"]
    assert list(data["channels"]) == ["/hiros/filtered"]
    assert 5 < scores["mean"] < 40
    assert scores["tracking"]["mota"] == 1
    assert len(scores["joints"]) == 32


def test_a_recording_is_processed_first(walking, processed, capsys):
    assert run(["eval", str(walking), "--json"]) == 0
    raw = json.loads(capsys.readouterr().out)["channels"]
    assert run(["eval", str(processed), "--json"]) == 0
    assert raw == json.loads(capsys.readouterr().out)["channels"]


def test_a_camera_as_the_reference_is_not_in_what_is_compared_with_it(walking, tmp_path, capsys):
    """Two cameras capture, the third is the truth: as if these two alone had been processed."""
    reference, capture = "/camera_2/skeletons", ("/camera_0/*", "/camera_1/*")
    process(walking, tmp_path / "two.mcap", options=ProcessOptions(topics=capture))
    expected = evaluate_log(tmp_path / "two.mcap", load_truth(walking, reference))
    assert run(["eval", str(walking), "--truth", reference, "--json"]) == 0
    channels = json.loads(capsys.readouterr().out)["channels"]
    for topic, result in expected.items():
        assert channels[topic]["mean"] == pytest.approx(result.scores.mean)
        assert channels[topic]["deviation"] == pytest.approx(result.scores.deviation)
    outcome = comparison([Task(walking, Entry("fuse"), truth=reference)])[0]
    assert outcome.cameras == ("camera_0", "camera_1")
    assert outcome.error == pytest.approx(expected["/hiros/filtered"].scores.mean)
    process(walking, tmp_path / "one.mcap", options=ProcessOptions(stages="T", keep=capture[:1]))
    with pytest.raises(ConfigError, match="no camera is left besides"):
        fused_topics(tmp_path / "one.mcap", "/camera_0/skeletons")


def test_markers_without_a_truth_are_named(processed, tmp_path, capsys):
    table = tmp_path / "truth.csv"
    rows = [f"{t},0,{name},0,0,1" for t in np.arange(0, 3.6, 0.4) for name in ("PELVIS", "NECK")]
    table.write_text("\n".join(["time,person,marker,x,y,z", *rows]))
    assert run(["eval", str(processed), "--truth", str(table), "--match-distance", "9"]) == 0
    text = capsys.readouterr().out
    assert "against the truth, 1 person" in text
    note = next(line for line in text.splitlines() if "no truth for 30 markers" in line)
    assert "WRIST_LEFT" in note
    assert not {"PELVIS", "NECK"} & set(re.findall(r"\w+", note))


def test_a_result_without_its_cameras_is_scored_if_a_truth_is_given(
    walking, processed, tmp_path, capsys
):
    """`process --keep ''`, and a truth in a file of motion capture: times count from the start."""
    bare, whole = tmp_path / "bare.mcap", json_of(processed, capsys)["channels"]
    process(walking, bare, options=ProcessOptions(keep=()))
    assert json_of(bare, capsys, "--truth", str(walking))["channels"] == whole
    truth = load_truth(walking)
    capture = write_csv(tmp_path / "truth.csv", truth, seconds_from=start_of(bare))
    scores = json_of(bare, capsys, "--truth", str(capture))["channels"]["/hiros/filtered"]
    assert scores["mean"] == pytest.approx(whole["/hiros/filtered"]["mean"], abs=0.01)
    assert scores["lag"] == pytest.approx(whole["/hiros/filtered"]["lag"], abs=0.1)


def json_of(log, capsys, *options):
    assert run(["eval", str(log), "--json", *options]) == 0
    data: dict[str, Any] = json.loads(capsys.readouterr().out)
    return data


def write_csv(path, truth, scale=1.0, seconds_from=0):
    assert truth.model is not None
    rows = [
        f"{(stamp - seconds_from) / 1e9:.9f},0,{name},{','.join(f'{scale * x:.4f}' for x in point)}"
        for stamp, (pose,) in zip(truth.stamps.tolist(), truth.positions, strict=True)
        for name, point in zip(truth.model.marker_names, pose.tolist(), strict=True)
    ]
    path.write_text("\n".join(["time,person,marker,x,y,z", *rows]))
    return path


def test_without_cameras_and_truth_there_is_one_line_with_the_remedy(walking, tmp_path, capsys):
    camera = ("/camera_0/*",)
    process(walking, tmp_path / "bare.mcap", options=ProcessOptions(keep=(), topics=camera))
    only_truth = ProcessOptions(keep=("/truth/*",), topics=camera, stages="T")
    process(walking, tmp_path / "both.mcap", options=only_truth)
    assert run(["eval", str(tmp_path / "bare.mcap")]) == 2
    assert re.fullmatch(
        "hiros: error: .*bare.mcap: has no truth, and no cameras .* --truth FILE\n",
        capsys.readouterr().err,
    )
    assert run(["eval", str(tmp_path / "bare.mcap"), "--leave-one-out"]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert run(["eval", str(tmp_path / "both.mcap"), "-q"]) == 0


def test_a_truth_is_perfect_against_itself(tmp_path, capsys):
    truth = tmp_path / "truth.mcap"
    simulation = simulate(SimulateParams(seconds=1.0, cameras=1))
    with McapWriter(truth) as writer:
        channel = add_skeleton_channel(writer, "/truth/skeletons")
        for frame in simulation.truth:
            writer.write(channel, frame.log_time, Encoder(simulation.model).encode(frame))
        writer.commit()
    scores = json_of(truth, capsys, "--truth", str(truth))["channels"]["/truth/skeletons"]
    assert (scores["mean"], scores["missing"], scores["false"]) == (0, 0, 0)
    assert run(["eval", str(truth)]) == 2
    assert "holds a truth but no result" in capsys.readouterr().err


def test_a_channel_without_any_message_misses_everybody(tmp_path, capsys):
    simulation, log = simulate(SimulateParams(seconds=1.0, cameras=1)), tmp_path / "empty.mcap"
    with McapWriter(log) as writer:
        add_skeleton_channel(writer, "/hiros/filtered")
        channel = add_skeleton_channel(writer, "/truth/skeletons")
        for frame in simulation.truth:
            writer.write(channel, frame.log_time, Encoder(simulation.model).encode(frame))
        writer.commit()
    scores = json_of(log, capsys)["channels"]["/hiros/filtered"]
    assert (scores["frames"], scores["silent"], scores["missing"]) == (0, 30, 30)
    assert scores["tracking"]["mota"] == scores["tracking"]["hota"] == 0
    assert run(["eval", str(log), "--html", str(tmp_path / "empty.html")]) == 0


def test_silence_is_a_warning_also_when_quiet(walking, processed, tmp_path, capsys):
    """The truth goes on for 2 s after the result has ended."""
    truth = load_truth(walking)
    late = np.concatenate([truth.stamps, truth.stamps[-1] + np.arange(1, 61) * 33_333_333])
    more = np.concatenate([truth.positions, np.repeat(truth.positions[-1:], 60, axis=0)])
    capture = write_csv(tmp_path / "truth.csv", replace(truth, stamps=late, positions=more))
    assert run(["eval", str(processed), "--truth", str(capture), "-q"]) == 0
    warning = capsys.readouterr().err
    assert warning.startswith("hiros: warning: instants of the truth without a frame")
    data = json_of(processed, capsys, "--truth", str(capture))
    scores = data["channels"]["/hiros/filtered"]
    assert 55 <= scores["silent"] == scores["missing"] <= 65
    assert scores["tracking"]["mota"] < 0.7
    assert len(data["warnings"]) == 1


def test_a_truth_of_one_of_two_people(tmp_path, capsys):
    log, one = tmp_path / "two.mcap", tmp_path / "one.csv"
    scene = {"people": 2, "action": "cross", "seconds": 3.0, "cameras": 2}
    write_log(log, SimulateParams.model_validate(scene))
    truth = load_truth(log)
    write_csv(one, replace(truth, positions=truth.positions[:, :1], people=(0,)))
    process(log, tmp_path / "out.mcap", options=ProcessOptions(keep=()))
    found = {
        covers: json_of(
            tmp_path / "out.mcap", capsys, "--truth", str(one), "--truth-covers", covers
        )
        for covers in ("all", "partial")
    }
    scores = {covers: f["channels"]["/hiros/filtered"] for covers, f in found.items()}
    assert scores["all"]["false"] > 60
    assert abs(scores["all"]["tracking"]["mota"]) < 0.1
    assert scores["partial"]["false"] is None
    assert scores["partial"]["tracking"]["mota"] > 0.95
    assert found["partial"]["truth_covers"] == "partial"
    assert "--truth-covers partial" in found["all"]["warnings"][0]
    assert found["partial"]["warnings"] == []


def test_without_truth(walking, capsys):
    assert run(["eval", str(walking), "--leave-one-out", "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert len(data["cameras"]) == 3
    assert run(["eval", str(walking), "--leave-one-out"]) == 0
    assert "Mirrored" in capsys.readouterr().out


@pytest.mark.parametrize(("away", "wrong"), [(0.0, False), (800.0, True)])
def test_a_truth_that_nobody_is_near_to_may_have_another_frame(
    processed, walking, tmp_path, capsys, away, wrong
):
    truth = load_truth(walking)
    table = write_csv(
        tmp_path / "truth.csv", replace(truth, positions=truth.positions + np.array([0, 0, away]))
    )
    assert run(["eval", str(processed), "--truth", str(table)]) == 0
    out = capsys.readouterr().out
    assert ("Is the truth in metres, in the log's fixed frame" in out) == wrong
    assert not wrong or re.search(r"truth \(.*, 80\d\.\d\), result \(.*, 0\.8\d*\)", out)


def test_joints_that_the_result_lacks_are_listed(processed, tmp_path, capsys):
    table = tmp_path / "truth.csv"
    names = ("PELVIS", "C7", "jRightT4")
    rows = [f"{t},0,{name},0,0,1" for t in np.arange(0, 3.6, 0.4) for name in names]
    table.write_text("\n".join(["time,person,marker,x,y,z", *rows]))
    data = json_of(processed, capsys, "--truth", str(table))
    assert any(text.endswith("that the result lacks: C7, jRightT4") for text in data["notes"])
    table.write_text("\n".join(["time,person,marker,x,y,z", *rows[1::3], *rows[2::3]]))
    assert run(["eval", str(processed), "--truth", str(table)]) == 2
    assert "share no marker: C7, jRightT4 against PELVIS" in capsys.readouterr().err


@pytest.mark.parametrize(
    "command", ["eval {log}", "eval {log} --leave-one-out", "compare {raw} --system raw --jobs 1"]
)
def test_quiet_prints_nothing(command, processed, walking, capsys):
    arguments = command.format(log=processed, raw=walking).split()
    assert run([*arguments, "-q"]) == 0
    assert capsys.readouterr() == ("", "")
    assert run([*arguments, "-q", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)


@pytest.mark.parametrize("options", [[], ["--leave-one-out"]], ids=["truth", "no truth"])
def test_the_page_is_one_file(processed, tmp_path, options):
    page = tmp_path / "report.html"
    assert run(["eval", str(processed), "--html", str(page), *options]) == 0
    text = page.read_text(encoding="utf-8")
    assert text.count("<img") >= 1
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
        (["{log}", "--system", "hiros"], "is a result, and is scored as it is"),
        (["{log}", "--set", "fuse.lookahead=0"], "are for recordings"),
        (["{log}", "--leave-one-out", "--truth", "/truth"], "takes no --truth"),
        (["{log}", "--shift", "1000"], "the truth covers no frame"),
        (["{log}", "--shift", "inf"], "'--shift'"),
        (["{log}", "--shift", "nan"], "'--shift'"),
    ],
)
def test_faults_are_one_line(processed, capsys, arguments, fault):
    given = [a.format(log=processed) for a in arguments]
    assert run(["eval", *given]) == 2
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1
    assert fault in captured.err


@pytest.mark.parametrize(("ms", "way"), [(30, "earlier"), (-30, "later")])
def test_a_truth_that_fits_at_another_time_says_so(processed, tmp_path, capsys, ms, way):
    """A capture whose first instant is not the log's: 34 mm for 9, and nothing else shows it."""
    truth = load_truth(processed)
    path = write_csv(tmp_path / "truth.csv", truth.moved(ms / 1000))
    notes = json_of(processed, capsys, "--truth", str(path))["notes"]
    (note,) = [note for note in notes if "--align-time" in note]
    assert re.match(rf"the truth fits better (2[5-9]|3[0-5]) ms {way}: ", note)
    assert not [n for n in json_of(processed, capsys)["notes"] if "--align-time" in n]
    assert run(["compare", str(processed), "--system", "fuse", "--truth", str(path)]) == 0
    assert f"ms {way}: " in capsys.readouterr().out
