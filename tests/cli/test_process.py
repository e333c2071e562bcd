"""``hiros process`` from outside: what it prints, what it writes, what it refuses."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time

import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from hiros_cli.app import run
from hiros_mcap.body.limb_table import LimbTable

CHANNELS = [
    f"/hiros/{name}" for name in ("filtered", "merged", "optimized", "tracked", "uncertainty")
]


def counts(path):
    with path.open("rb") as file:
        summary = make_reader(file, validate_crcs=True).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    messages = summary.statistics.channel_message_counts
    return {channel.topic: messages.get(i, 0) for i, channel in summary.channels.items()}


HIROS = ("--system", "hiros")
WINDOWS = "optimize.calibration_windows"


def refused(capsys, *arguments):
    """Run a command that must fail, and return its one line."""
    assert run([str(argument) for argument in arguments]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    lines = [line for line in captured.err.splitlines() if "compiling kernels" not in line]
    assert len(lines) == 1
    assert lines[0].startswith("hiros: error: ")
    return lines[0]


def test_all_four_channels_and_the_read_ones(crossing, tmp_path):
    assert run(["process", str(crossing), "-o", str(tmp_path / "out.mcap"), "-q"]) == 0
    written, read = counts(tmp_path / "out.mcap"), counts(crossing)
    assert [topic for topic in sorted(written) if topic.startswith("/hiros/")] == CHANNELS
    assert written["/tf_static"] == 1
    assert all(written[topic] == n for topic, n in read.items() if topic.startswith("/camera"))
    assert written["/truth/skeletons"] == read["/truth/skeletons"]


def test_the_summary_accounts_for_every_message(crossing, tmp_path, capsys):
    assert run(["process", str(crossing), "-o", str(tmp_path / "out.mcap"), "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert [person["id"] for person in summary["people"]] == [0, 1]
    for camera in summary["cameras"]:
        assert camera["messages"] == counts(crossing)[camera["topic"]]
        assert camera["messages"] == camera["used"] + sum(camera["skipped"].values())
    written = counts(tmp_path / "out.mcap")
    assert summary["written"] == {topic: written[topic] for topic in summary["written"]}


def test_the_summary_for_a_person_names_cameras_people_and_channels(crossing, tmp_path, capsys):
    assert run(["process", str(crossing), "-o", str(tmp_path / "out.mcap")]) == 0
    captured = capsys.readouterr()
    assert all(word in captured.out for word in (*CHANNELS[:4], "/camera_0/skeletons", "Person"))
    assert "times real time" in captured.out
    assert "\x1b" not in captured.out


def test_the_default_output_lies_beside_the_input(walking, tmp_path):
    source = tmp_path / "lab.mcap"
    source.write_bytes(walking.read_bytes())
    assert run(["process", str(source), "-q", "--stages", "T"]) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["lab.hiros.mcap", "lab.mcap"]


def test_the_same_run_again_replaces_the_output_by_the_same_bytes(walking, tmp_path):
    target = tmp_path / "out.mcap"
    assert run(["process", str(walking), "-o", str(target), "-q"]) == 0
    first = target.read_bytes()
    assert run(["process", str(walking), "-o", str(target), "-q"]) == 0
    assert target.read_bytes() == first


def test_the_output_of_the_current_folder_lies_beside_it(walking, tmp_path, monkeypatch):
    bag = tmp_path / "bag"
    bag.mkdir()
    (bag / "bag_0.mcap").write_bytes(walking.read_bytes())
    monkeypatch.chdir(bag)
    assert run(["process", ".", "-q", "--stages", "T"]) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bag", "bag.hiros.mcap"]


@pytest.mark.parametrize(
    ("stages", "channels"),
    [
        ("T", ["/hiros/tracked"]),
        ("tmf", ["/hiros/filtered", "/hiros/merged", "/hiros/tracked", "/hiros/uncertainty"]),
    ],
)
def test_stages_chooses_the_chain(stages, channels, walking, tmp_path):
    target = tmp_path / "out.mcap"
    assert run(["process", str(walking), "-o", str(target), "--stages", stages, "-q"]) == 0
    assert [topic for topic in sorted(counts(target)) if topic.startswith("/hiros/")] == channels


def test_keep_nothing_copies_nothing(walking, tmp_path):
    target = tmp_path / "out.mcap"
    assert run(["process", str(walking), "-o", str(target), "--keep", "", "-q"]) == 0
    assert sorted(counts(target)) == CHANNELS


@pytest.mark.parametrize(
    "options",
    [
        ["--system", "hiros-realtime", "--set", "optimize.calibration=two-pass"],
        ["--preset", "paper", "--set", f"{WINDOWS}=[[0,0.8]]"],
        ["--system", "hiros", "--set", "optimize.solver=ceres"],
        ["--topic", "/c*"],
    ],
)
def test_options_with_a_name_of_their_own(options, short, tmp_path):
    target = tmp_path / "out.mcap"
    assert run(["process", str(short), "-o", str(target), "-q", *options]) == 0
    assert target.exists()


def test_malaguti_saves_the_limbs_that_it_finds_and_uses_those_of_a_file(crossing, tmp_path):
    limbs, again = tmp_path / "limbs.toml", tmp_path / "again.toml"
    command = ["process", str(crossing), "-o", str(tmp_path / "out.mcap"), "--system", "malaguti"]
    assert run([*command, "--save-limbs", str(limbs), "-q"]) == 0
    table = LimbTable.load(limbs)
    assert table.people
    assert run([*command, "--limbs", str(limbs), "--save-limbs", str(again), "-q"]) == 0
    assert LimbTable.load(again).people == table.people


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--keep", "/nope*", "--keep", "/tf*"], "keep: the log has no channel /nope*"),
        (
            ["--system", "hiros", "--set", f"{WINDOWS}=[[2.99,9]]"],
            "limb lengths not calibrated: nobody was seen in the calibration windows",
        ),
        (["--system", "hiros", "--set", f"{WINDOWS}=[[0,2]]"], ""),
    ],
)
def test_what_an_option_did_not_find_is_noted(options, said, whole_walking, tmp_path, capsys):
    command = ["process", str(whole_walking), "-o", str(tmp_path / "out.mcap"), "--json"]
    assert run([*command, *options]) == 0
    notes = json.loads(capsys.readouterr().out)["notes"]
    asked = [note for note in notes if note.startswith(("keep", "limb lengths"))]
    assert asked == ([said] if said else [])


def an_mcap(path, schema="std_msgs/msg/String"):
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2", "somebody else")
        ident = writer.register_schema(schema, "ros2msg", b"string data")
        channel = writer.register_channel("/chatter\x1b[2J", "cdr", ident)
        writer.add_message(channel, 1, b"\0\1\0\0\1\0\0\0\0", 1)
        writer.finish()
    return path


BAD_INPUTS = {
    "empty": (lambda path, sample: path.write_bytes(b""), "in.mcap"),
    "text": (lambda path, sample: path.write_text("no log at all\n" * 99), "in.mcap"),
    "cut": (lambda path, sample: path.write_bytes(sample.read_bytes()[:100_000]), "in.mcap"),
    "folder": (lambda path, sample: path.mkdir(), "folder"),
    "other": (lambda path, sample: an_mcap(path), "SkeletonGroup"),
    "bag": (lambda path, sample: path.write_bytes(b"#ROSBAG V2.0\n" * 9), "ROS 1 bag"),
}


@pytest.mark.parametrize("kind", BAD_INPUTS)
def test_bad_input_is_one_line_and_no_output(kind, walking, tmp_path, capsys):
    make, said = BAD_INPUTS[kind]
    source = tmp_path / "in.mcap"
    make(source, walking)
    line = refused(capsys, "process", source)
    assert said in line
    assert "\x1b" not in line
    assert [path.name for path in tmp_path.iterdir()] == ["in.mcap"]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--set", "merge.max_delta_tim=1"], "did you mean merge.max_delta_time?"),
        (["--set", "nonsense"], "not of the form"),
        (["--set", "track.max_distance=-1"], "track.max_distance: should be greater than 0"),
        (["--preset", "papre"], "did you mean paper?"),
        (["--stages", "MOF"], "TMOF"),
        (["--clock", "camera_0"], "--clock: 'camera_0' is not of the form CAMERA=SECONDS"),
        (["--clock", "camera_0=soon"], "--clock: 'camera_0=soon' is not of the form"),
        (["--clock", "camera_0=nan"], "--clock: 'camera_0=nan' is not of the form CAMERA=SECONDS"),
        (["--clock", "camera_0=1e300"], "clock.camera_0: should be less than or equal to"),
        (["--clock", "camera_0=2e9"], "a stamp lies outside the years 1901 to 2038"),
        (["--clock", "left=1"], "no camera 'left' (there are: camera_0, camera_1, camera_2)"),
        ([*HIROS, "--set", f"{WINDOWS}=[[20,10]]"], "start must precede end"),
        ([*HIROS, "--set", f"{WINDOWS}=[[-5,1]]"], "start must precede end"),
        (
            [*HIROS, "--set", f"{WINDOWS}=[[3.1,9]]"],
            "ends after 3.0 s, before the calibration window 3.1:9",
        ),
        (
            [*HIROS, "--set", f"{WINDOWS}=[[20,30]]"],
            "ends after 3.0 s, before the calibration window 20:30",
        ),
        (
            ["--stages", "T", "--limbs", "x.toml"],
            "x.toml: nothing uses or finds limb lengths: system fuse with the stages tracked h",
        ),
        (["--stages", "T", "--save-limbs", "x.toml"], "x.toml: nothing uses or finds limb lengths"),
        (
            ["--system", "lee", "--limbs", "x.toml"],
            "x.toml: nothing uses or finds limb lengths: system lee",
        ),
        (
            ["--preset", "paper", "--system", "fuse"],
            "preset paper is of hiros and means nothing to",
        ),
        (["--set", "optimize.debias=false"], "optimize.debias has no effect: --system fuse does n"),
        (["--system", "malaguti", "--limbs", "missing.toml"], "missing.toml"),
        (["--topic", "/nobody/*"], "/nobody/*"),
        (["--fixed-frame", "mars"], "mars"),
        (["--limbs", "missing.toml"], "missing.toml"),
        (["--extrinsics", "missing.toml"], "missing.toml"),
        (["--config", "missing.toml"], "missing.toml"),
    ],
)
def test_a_wrong_option_is_one_line_and_no_output(options, said, whole_walking, tmp_path, capsys):
    assert said in refused(capsys, "process", whole_walking, "-o", tmp_path / "out.mcap", *options)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_that_cannot_be_written_is_one_line(walking, tmp_path, capsys):
    tmp_path.chmod(0o500)
    assert "Permission denied" in refused(capsys, "process", walking, "-o", tmp_path / "out.mcap")


def test_a_full_disk_is_one_line_and_no_output(walking, tmp_path):
    target = tmp_path / "out.mcap"
    limited = f'ulimit -f 100; trap "" XFSZ; exec "$0" -m hiros_cli process {walking} -o {target}'
    command = ["sh", "-c", limited, sys.executable]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (result.returncode, result.stdout) == (2, "")
    assert result.stderr == f"hiros: error: {target}: cannot be written: File too large\n"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_a_signal_leaves_nothing_behind(name, crossing, tmp_path):
    command = [sys.executable, "-m", "hiros_cli", "process", str(crossing)]
    command += ["-o", str(tmp_path / "out.mcap")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        while process.poll() is None and not list(tmp_path.glob(".hiros-*.tmp")):
            time.sleep(0.01)
        process.send_signal(getattr(signal, name))
        _, stderr = process.communicate()
    assert process.returncode == 128 + getattr(signal, name)
    assert stderr == b""
    assert list(tmp_path.iterdir()) == []


def test_a_result_is_not_processed_again_by_accident(walking, tmp_path, capsys):
    source = tmp_path / "walk.mcap"
    shutil.copy(walking, source)
    assert run(["process", str(source), "-q"]) == 0
    assert run(["process", str(tmp_path / "walk.hiros.mcap")]) == 2
    assert "is a result of hiros already" in capsys.readouterr().err
    assert sorted(p.name for p in tmp_path.iterdir()) == ["walk.hiros.mcap", "walk.mcap"]
    (tmp_path / "bag").mkdir()
    shutil.move(tmp_path / "walk.hiros.mcap", tmp_path / "bag")
    assert run(["process", str(tmp_path / "bag")]) == 2
    again = ["process", str(tmp_path / "bag"), "-o", str(tmp_path / "again.mcap")]
    assert run([*again, "-q"]) == 0
