"""A whole run, from a file to a file, on the sample logs."""

from __future__ import annotations

import math
import re
import subprocess
import sys
from dataclasses import fields, replace
from inspect import signature
from pathlib import Path

import numpy as np
import pytest
from builders import same
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

import hiros_mcap
from hiros_mcap.body.limb_table import LimbTable
from hiros_mcap.body.transforms import transform_to_fixed
from hiros_mcap.config import load_config
from hiros_mcap.errors import ConfigError, LogError
from hiros_mcap.evaluate import Truth, evaluate
from hiros_mcap.evaluate.logs import evaluate_log, read_channel
from hiros_mcap.io.container import ChunkCopier, McapReader, McapWriter
from hiros_mcap.io.log import STALE, open_log
from hiros_mcap.running.pipeline import ProcessOptions, process
from hiros_mcap.running.process_options import ProcessChoices
from hiros_mcap.running.recording import Recording
from hiros_mcap.skeletons import ACCELERATION, ORIENTATION, POSITION, STATE, VELOCITY
from hiros_mcap.systems import LETTERS, SYSTEMS, chain_of

SAMPLES = Path(__file__).parents[2] / "sample_data"
WALKING = SAMPLES / "one_person_walking.mcap"
PLAYED = ("/hiros/filtered", "/hiros/markers", "/hiros/joint_states")


def truth_of(path):
    with open_log(path, topics=["/truth/*"]) as log:
        return Truth.of(transform_to_fixed(log.frames(), log.transforms, log.fixed_frame))


def test_the_public_names_are_listed_before_their_first_use():
    code = "import hiros_mcap; print(*dir(hiros_mcap))"
    listed = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True).stdout
    assert set(listed.decode().split()) >= set(hiros_mcap.__all__)


@pytest.mark.parametrize("chain", SYSTEMS["hiros"].chains)
def test_every_chain_of_the_paper_runs(walking, chain, tmp_path):
    out = tmp_path / "out.mcap"
    summary = process(walking, out, options=ProcessOptions("hiros", stages=chain, keep=()))
    with McapReader(out) as reader:
        topics = {channel.topic for channel in reader.channels.values()}
    assert topics == {f"/hiros/{LETTERS[letter]}" for letter in chain}
    assert [person.id for person in summary.people] == [0]
    before = ["open", "read", "calibrate"] if summary.poses else ["open", "read"]
    steps = [*before, *(LETTERS[letter] for letter in chain), "write"]
    assert [step.name for step in summary.stages if step.cpu_s > 0] == steps


@pytest.mark.parametrize("chain", ["M", "F", "MF", "FT", "TOM", "X"])
def test_other_chains_are_refused(walking, chain, tmp_path):
    with pytest.raises(ConfigError, match="cannot run the stages"):
        process(walking, tmp_path / "out.mcap", options=ProcessOptions("hiros", stages=chain))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("system", ["fuse", "hiros"])
def test_the_error_falls_at_every_stage(crossing, system, tmp_path):
    out, truth = tmp_path / "out.mcap", truth_of(crossing)
    process(crossing, out, options=ProcessOptions(system))
    scores = []
    for channel in LETTERS.values():
        with open_log(out, topics=[f"/hiros/{channel}"], output_prefix="/truth") as log:
            scores.append(evaluate(log.frames(), truth, log.model))
    errors = [s.mean for s in scores]
    assert errors == sorted(errors, reverse=True)
    assert scores[1].deviation < 0.8 * scores[0].deviation
    assert scores[3].limb_variation < 0.01
    assert [s.switches for s in scores] == [0, 0, 0, 0]
    assert (scores[3].missing, scores[3].false) == (0, 0)


def test_what_the_paper_prints_runs_and_is_behind_the_defaults(walking, tmp_path):
    """Presets paper and upstream: nobody is lost or renamed, and the error is larger."""
    truth, channel, errors = truth_of(walking), "/hiros/filtered", {}
    for preset in ("default", "paper", "upstream"):
        config = load_config(preset=preset, system="hiros")
        process(walking, tmp_path / preset, config=config, options=ProcessOptions("hiros"))
        scores = evaluate_log(tmp_path / preset, truth, [channel])[channel].scores
        assert (scores.switches, scores.missing) == (0, 0)
        errors[preset] = scores.mean
    assert errors["default"] < min(errors["paper"], errors["upstream"])
    assert max(errors.values()) < 60


def test_progress_is_told(walking, tmp_path):
    told: list[tuple[int, int]] = []

    class Watcher:
        def update(self, done, total):
            told.append((done, total))

    process(walking, progress=Watcher())
    assert told[-1][0] == told[-1][1] > 0
    assert [done for done, _ in told] == sorted(done for done, _ in told)


def test_an_output_of_a_file_is_logged_at_the_time_of_its_data(walking, tmp_path):
    live = load_config(None, ["output.log_time=causal"])
    process(walking, tmp_path / "causal", config=live, markers=True)
    process(walking, tmp_path / "stamp", markers=True)
    for channel in LETTERS.values():
        causal, stamped = (
            read_channel(tmp_path / name, f"/hiros/{channel}")[0] for name in ("causal", "stamp")
        )
        assert all(frame.log_time == frame.stamp for frame in stamped)
        assert all(frame.log_time >= frame.stamp for frame in causal)
        assert all(
            same(a.replace(log_time=a.stamp), b) for a, b in zip(causal, stamped, strict=True)
        )
    with (tmp_path / "stamp").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        first_second = min(frame.stamp for frame in stamped) + 10**9
        topics = [*PLAYED, "/hiros/log"]
        decoded = list(reader.iter_decoded_messages(topics, ending_before=first_second))
    shown = [(c.topic, m.log_time, d) for _, c, m, d in decoded if c.topic in PLAYED]
    for _, log_time, data in shown:
        header = data.markers[0].header if hasattr(data, "markers") else data.header
        assert header.stamp.sec * 1_000_000_000 + header.stamp.nanosec == log_time
    assert {topic for topic, _, _ in shown} == set(PLAYED)
    assert all(m.log_time == d.stamp.sec * 10**9 + d.stamp.nanosec for _, c, m, d in decoded
               if c.topic == "/hiros/log")  # fmt: skip
    scores = [
        evaluate_log(tmp_path / name, truth_of(walking))["/hiros/filtered"].scores.mean
        for name in ("causal", "stamp")
    ]
    assert scores[0] == scores[1]


def states(path, channel):
    """Every number of the markers and links of a channel."""
    frames, _, _ = read_channel(path, f"/hiros/{channel}")
    rows = [np.concatenate([f.markers, f.links], axis=1).reshape(-1, STATE) for f in frames]
    return np.concatenate(rows)


def run_to(log, path, stages="", system="hiros", *assignments):
    options = ProcessOptions(system=system, stages=stages, keep=())
    process(log, path, config=load_config(None, assignments, system=system), options=options)
    return path


@pytest.mark.parametrize(
    ("system", "stages", "derived"),
    [
        ("hiros", "TMOF", "filtered"),
        ("hiros", "TM", "merged"),
        ("hiros", "T", "tracked"),
        ("fuse", "TMOF", "filtered"),
        ("fuse-realtime", "TMOF", "filtered"),
        ("malaguti", "TMO", "optimized"),
        ("lee", "TMF", "filtered"),
    ],
)
def test_derivatives_are_in_the_last_channel_of_the_chain(
    walking, system, stages, derived, tmp_path
):
    out = run_to(walking, tmp_path / "out.mcap", stages, system)
    for letter in stages:
        numbers = states(out, LETTERS[letter])
        assert np.isfinite(numbers[:, VELOCITY]).any() == (LETTERS[letter] == derived)
        assert np.isfinite(numbers[:, ACCELERATION.start :]).any() <= (LETTERS[letter] == derived)
        assert np.isfinite(numbers[:, POSITION]).any()
        assert np.isfinite(numbers[:, ORIENTATION]).any()


def test_derivatives_of_all_channels_can_be_written(walking, tmp_path):
    out = run_to(walking, tmp_path / "out.mcap", "", "hiros", "output.derivatives=all")
    for channel in LETTERS.values():
        assert np.isfinite(states(out, channel)[:, VELOCITY]).any()


def test_what_is_left_out_changes_nothing_that_is_written(walking, tmp_path):
    """Stages work on all numbers; only the file holds fewer and rounder ones."""
    options = "output.derivatives=all", "output.precision=full"
    small, full = (
        run_to(walking, tmp_path / "small"),
        run_to(walking, tmp_path / "full", "", "hiros", *options),
    )
    for channel in LETTERS.values():
        some, others = states(small, channel), states(full, channel)
        columns = slice(0, STATE if channel == "filtered" else ORIENTATION.stop)
        some, others = some[:, columns], others[:, columns]
        assert np.array_equal(np.isnan(some), np.isnan(others))
        known = ~np.isnan(some)
        off = np.abs(some[known] - others[known])
        assert off.max() > 0
        assert np.all(off <= np.abs(others[known]) * 2.0**-21)
    assert small.stat().st_size < 0.3 * full.stat().st_size


@pytest.mark.parametrize("system", ["fuse", "hiros", "malaguti", "lee", "maf", "average", "raw"])
def test_every_skeleton_has_the_box_of_its_markers(crossing, system, tmp_path):
    process(crossing, tmp_path / "out", options=ProcessOptions(system=system))
    for channel in chain_of(system):
        frames, *_ = read_channel(tmp_path / "out", f"/hiros/{channel}")
        boxes = np.concatenate([frame.boxes for frame in frames])
        positions = np.concatenate([frame.positions for frame in frames])
        assert len(boxes)
        for side, limit in ((-0.5, np.nanmin), (0.5, np.nanmax)):
            corners = boxes[:, :3] + side * boxes[:, [20, 21, 19]]
            assert corners == pytest.approx(limit(positions, axis=1), abs=1e-5)
        assert (boxes[:, ORIENTATION] == [0, 0, 0, 1]).all()


def test_provenance_and_configuration_are_in_the_output(walking, tmp_path):
    process(walking, tmp_path / "out.mcap")
    with McapReader(tmp_path / "out.mcap") as reader:
        assert [name for name, _ in reader.contents.metadata] == ["hiros.provenance"]
        found = {a.name: reader.attachment(a.name) for a in reader.contents.attachments}
    names = ("config.toml", "events.json", "report.json")
    assert sorted(found) == [f"hiros/{name}" for name in names]
    assert b"[track]" in bytes(found["hiros/config.toml"])
    assert str(tmp_path).encode() not in bytes(found["hiros/report.json"])


@pytest.mark.parametrize(
    ("system", "stages", "switch", "merging"),
    [
        ("hiros", "TMF", [], "flips,outliers,mean"),
        ("hiros", "TM", ["merge.max_position_delta=0"], "flips,outliers,mean"),
        ("hiros", "TF", [], None),
        ("lee", "TM", [], None),
        ("average", "TM", [], "mean"),
    ],
)
def test_provenance_tells_the_order_of_stages_and_of_the_merger(
    walking, tmp_path, system, stages, switch, merging
):
    config = load_config(None, switch, system=system)
    options = ProcessOptions(system=system, stages=stages, keep=())
    process(walking, tmp_path / "out.mcap", config=config, options=options)
    with McapReader(tmp_path / "out.mcap") as reader:
        ((_, provenance),) = reader.contents.metadata
    assert provenance["stages"] == ",".join(LETTERS[letter] for letter in stages)
    assert provenance.get("merging") == merging


@pytest.mark.parametrize("options", [{"system": "lee"}, {"stages": "TMF"}])
@pytest.mark.parametrize("name", ["limbs_in", "limbs_out"])
def test_limb_lengths_are_refused_where_no_stage_uses_them(walking, options, name, tmp_path):
    more = {name: tmp_path / "limbs.toml"}
    with pytest.raises(ConfigError, match=r"limbs\.toml: .* has no optimizer"):
        process(walking, None, options=ProcessOptions(**options, **more))


@pytest.mark.parametrize("system", ["fuse", "fuse-realtime", "hiros"])
def test_limb_lengths_that_are_given_are_not_measured_again(walking, system, tmp_path):
    given, saved = tmp_path / "given.toml", tmp_path / "saved.toml"
    process(walking, None, options=ProcessOptions(system, limbs_out=given))
    longer = LimbTable.load(given)
    for limbs in longer.people.values():
        limbs.update(
            {name: replace(limb, length=1.01 * limb.length) for name, limb in limbs.items()}
        )
    longer.save(given)
    options = ProcessOptions(system, limbs_in=given, limbs_out=saved)
    settings = ["optimize.calibration=two-pass"] if system == "hiros" else []
    config = load_config(None, settings, system=system)
    out = tmp_path / "out.mcap"
    process(walking, out, config=config, options=options)
    assert LimbTable.load(saved).people == LimbTable.load(given).people
    frames, model, _ = read_channel(out, "/hiros/optimized")
    poses = np.stack([frame.positions[0] for frame in frames if frame.n_people])[30:]
    shin = model.link_names.index("KNEE_LEFT")
    lengths = np.linalg.norm(
        poses[:, model.links[shin, 0]] - poses[:, model.links[shin, 1]], axis=1
    )
    assert np.median(lengths) == pytest.approx(longer.people[0]["KNEE_LEFT"].length, rel=0.003)


def test_an_output_holds_the_poses_of_the_file_instead_of_the_logs(walking, tmp_path):
    extrinsics = camera_file(tmp_path / "cameras.toml", 2.0)
    process(walking, tmp_path / "out", options=ProcessOptions(extrinsics=extrinsics))
    with open_log(tmp_path / "out") as log:
        for camera in log.cameras:
            pose = log.pose_of(camera)
            assert pose is not None
            assert pose.translation.tolist() == [0.0, 0.0, 2.0]


def test_clocks_of_a_camera_file_correct_the_stamps(walking, tmp_path):
    clock = '[clock]\n"camera_1" = 0.25\n"camera_7" = 3.0\n'
    extrinsics = camera_file(tmp_path / "cameras.toml", 2.0, clock)
    options = ProcessOptions(extrinsics=extrinsics, stages="T")
    process(walking, tmp_path / "as_is", options=ProcessOptions(stages="T"))
    process(walking, tmp_path / "out", options=options)
    shift = first_stamp(tmp_path / "out", "camera_1") - first_stamp(tmp_path / "as_is", "camera_1")
    assert shift == 250_000_000


def camera_file(path, height, more=""):
    """Write a file that puts all cameras of the log at one place."""
    pose = f"translation = [0.0, 0.0, {height}]\nquaternion_xyzw = [0.0, 0.0, 0.0, 1.0]\n"
    with open_log(WALKING) as log:
        names = [camera.frames[0] for camera in log.cameras]
    path.write_text("".join(f'[[camera]]\nframe = "{name}"\n{pose}' for name in names) + more)
    return path


def first_stamp(path, source):
    frames, *_ = read_channel(path, "/hiros/tracked")
    return min(frame.stamp for frame in frames if frame.source == source)


def test_a_watcher_sees_every_frame_as_the_stages_made_it(walking, tmp_path):
    calls: list[str] = []

    class Sees:
        def begin(self, log, chain):
            calls.append(f"begin {','.join(chain)}")

        def frame(self, channel, frame):
            calls.append(channel)
            velocities.setdefault(channel, []).append(frame.velocities)

        def end(self, events):
            calls.append("end")

    velocities: dict[str, list[np.ndarray]] = {}
    options = ProcessOptions(stages="TM")
    summary = process(walking, tmp_path / "out", options=options, watcher=Sees())
    assert (calls[0], calls[-1]) == ("begin tracked,merged", "end")
    assert calls.count("merged") == summary.written["/hiros/merged"]
    assert calls.count("detections") >= calls.count("tracked") > 0
    assert np.isfinite(np.concatenate(velocities["tracked"])).any()


def test_input_after_the_last_result_is_copied_too(walking, tmp_path):
    source, target = tmp_path / "in.mcap", tmp_path / "out.mcap"
    with McapReader(walking) as reader, McapWriter(source) as writer:
        copier = ChunkCopier(reader, writer, reader.channels)
        copier.finish()
        late = max(chunk.end_time for chunk in reader.contents.chunks) + 10**10
        writer.write(writer.add_channel("/truth/late", 0), late, b"late")
        writer.commit()
    process(source, target, options=ProcessOptions(stages="T"))
    with target.open("rb") as file:
        (found,) = make_reader(file).iter_messages(topics=["/truth/late"])
    assert found[2].data == b"late"


def test_the_head_of_a_recording_has_the_messages_that_were_asked_for(walking):
    recording = Recording.read(walking, load_config(), ProcessOptions())
    frames = list(recording.frames())
    for n in (1, 100, len(frames)):
        head = list(recording.head(n).frames())
        assert n <= len(head) < n + max(map(len, recording.blocks))
        assert all(map(same, head, frames))


def test_options_may_stand_by_themselves(walking):
    with pytest.raises(TypeError, match=r"no argument 'sytem'; did you mean system\? \(there are"):
        process(walking, sytem="hiros")
    summary = process(walking, system="hiros-realtime", calibrate="off", progress=True)
    assert (summary.system, summary.poses) == ("hiros-realtime", ())


def test_options_take_what_people_write(walking, tmp_path):
    options = ProcessOptions(topics="/camera_0/*", keep=[], extrinsics="cameras.toml")  # type: ignore[arg-type]
    assert (options.topics, options.keep) == (("/camera_0/*",), ())
    assert options.extrinsics == Path("cameras.toml")
    known = "'off', 'auto', 'require'"
    with pytest.raises(ConfigError, match=f"^calibrate: 'on' is none of {known}$"):
        process(walking, calibrate="on")


def test_warnings_of_a_run_are_logged_once(crossing, tmp_path, caplog):
    late = load_config(overrides=["clock.camera_0=100"])
    with caplog.at_level("DEBUG", "hiros_mcap"):
        summary = process(crossing, tmp_path / "out.mcap", config=late, calibrate="off")
    warnings = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert summary.warnings
    assert warnings == [f"{crossing}: {text}" for text in summary.warnings]
    steps = [record.getMessage() for record in caplog.records if record.levelname == "INFO"]
    assert f"{crossing}: camera_0, camera_1, camera_2; fixed frame world" in steps
    assert f"{crossing}: wrote {tmp_path / 'out.mcap'}" in steps


def test_a_notebook_shows_the_bar_and_a_pipe_does_not(walking, monkeypatch, capsys):
    monkeypatch.delitem(sys.modules, "ipykernel", raising=False)
    process(walking, calibrate="off", progress=True)
    assert capsys.readouterr().err == ""
    monkeypatch.setitem(sys.modules, "ipykernel", sys)
    process(walking, calibrate="off", progress=True)
    assert "100%" in capsys.readouterr().err
    process(walking, calibrate="off")
    assert capsys.readouterr().err == ""


def odd_walk(target):
    """Somebody walks: nobody sends from 1.0 to 2.2 s; one message repeated, one logged in 2300."""
    with open_log(WALKING) as log, McapWriter(target) as writer:
        writer.copy_definitions(log.reader, log.reader.channels)
        start, far = log.span[0], 0
        for m in log.reader.messages():
            after = m.log_time - start
            if 1.0e9 < after < 2.2e9:
                continue
            data, topic = bytes(m.data), log.reader.channels[m.channel_id].topic
            writer.write(m.channel_id, m.log_time, data)
            if topic == "/camera_0/skeletons" and after > 2.3e9 and not far:
                writer.write(m.channel_id, m.log_time + 1000, data)
                far, last = m.channel_id, data
        stamped_2038 = last[:4] + b"\xff\xff\xff\x7f" + last[8:]
        writer.write(far, 2**63 + 5, stamped_2038)
        writer.commit()
    return target


def test_a_repeat_and_few_lost_messages_are_told(tmp_path):
    summary = process(odd_walk(tmp_path / "odd.mcap"), calibrate="off")
    (few,) = (text for text in summary.warnings if "not used" in text)
    assert few == (
        "a few messages were not used: /camera_0/skeletons: 1 log time after the year 2262"
    )
    notes = "\n".join(summary.notes)
    assert "repeat" not in notes  # the table of cameras counts them
    (camera,) = (one for one in summary.cameras if one.topic == "/camera_0/skeletons")
    assert camera.skipped[STALE] == 1


def test_process_shows_each_option_to_an_editor_and_in_help():
    names = {field.name for field in fields(ProcessOptions)}
    assert set(ProcessChoices.__annotations__) == names
    assert names <= set(signature(process).parameters)


@pytest.mark.parametrize(
    ("name", "value", "fault"),
    [
        ("recover", "yes", "'yes' is no bool"),
        ("memory", "1", "'1' is no float"),
        ("memory", math.nan, "nan is no number of GiB above 0"),
        ("memory", -1, "-1 is no number of GiB above 0"),
        ("keep", (1, 2), "(1, 2) is neither a glob nor a list of globs"),
        ("topics", 5, "5 is neither a glob nor a list of globs"),
        ("extrinsics", {}, "{} is no name of a file"),
        ("config", {}, "{} is neither a Config nor the name of a file"),
        ("progress", 5, "5 is no bool and has no method update()"),
    ],
)
def test_a_wrong_type_is_one_line(walking, name, value, fault):
    with pytest.raises(ConfigError, match=f"^{re.escape(f'{name}: {fault}')}$"):
        process(walking, **{name: value})


def test_the_limit_of_memory_is_in_gib(walking):
    with pytest.raises(LogError, match="--memory GIB raises the limit"):
        process(walking, memory=10_000 / 2**30)


def test_a_file_of_parameters_may_be_named(tmp_path):
    (tmp_path / "mine.toml").write_text("[filter]\nctoff = 3\n")
    with pytest.raises(ConfigError, match=r"mine\.toml: no parameter filter\.ctoff"):
        process("lab.mcap", config=tmp_path / "mine.toml")


def test_a_note_says_which_cameras_detections_were_ignored(crossing):
    """Whose they are is asked first where something was left out."""
    config = load_config(None, ["track.min_skeleton_confidence=0.8"])
    summary = process(crossing, calibrate="off", config=config)
    (note,) = (text for text in summary.notes if "confidence below" in text)
    total = int(note.split()[0])
    cameras = re.findall(r"(\d+) of (camera_\d)", note)
    assert len(cameras) > 1
    assert sum(int(n) for n, _ in cameras) == total
