"""Many logs: which are meant, how results are called, what is done again, what is reported."""

from __future__ import annotations

import csv
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

from hiros_cli.app import run
from hiros_cli.many_logs import exit_code
from hiros_mcap.config import Settings
from hiros_mcap.errors import ConfigError, LogError
from hiros_mcap.io.container import McapReader, McapWriter
from hiros_mcap.many.find import are_many, distinct_names, find_logs
from hiros_mcap.many.jobs import Finding, Job, ProcessJob
from hiros_mcap.many.manifest import HEAD, Identity, LogRecord, Manifest
from hiros_mcap.many.run_logs import column_means, locked, run_logs, run_one

SAMPLES = Path(__file__).parents[1] / "sample_data"
BAG = "rosbag2_bagfile_information:\n  version: 8\n"


@pytest.fixture
def recordings(tmp_path, walking, crossing):
    """Return a folder with three logs, two of which have the same name, and one that is cut off."""
    folder = tmp_path / "in"
    for name, source in (("a/lab", walking), ("b/lab", crossing), ("walk", walking)):
        path = folder / f"{name}.mcap"
        path.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(source, path)
    (folder / "cut.mcap").write_bytes(walking.read_bytes()[:300_000])
    return folder


def touch(folder, *names):
    for name in names:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(BAG if path.name == "metadata.yaml" else "")


def found(folder, *named):
    logs = find_logs([str(folder / name) for name in named])
    return [str(Path(log).relative_to(folder)) for log in logs]


def test_a_folder_is_searched_with_those_below_it(tmp_path):
    touch(tmp_path, "b.mcap", "a/c.bag", "a/d/e.db3", "notes.txt", ".hidden/x.mcap")
    assert found(tmp_path, ".") == ["a/c.bag", "a/d/e.db3", "b.mcap"]


def test_a_bag_folder_is_one_log_and_so_are_its_files(tmp_path):
    touch(tmp_path, "lab/metadata.yaml", "lab/lab_0.mcap", "lab/lab_1.mcap", "x.mcap")
    assert found(tmp_path, "") == ["lab", "x.mcap"]
    assert found(tmp_path, "*/*.mcap") == ["lab"]
    assert found(tmp_path, "lab/lab_1.mcap", "x.mcap") == ["lab", "x.mcap"]
    assert not are_many([str(tmp_path / "lab")])


def test_parts_of_a_recording_without_its_metadata_stay_one_log(tmp_path):
    touch(tmp_path, "lab/lab_0.mcap", "lab/lab_1.mcap", "day/walk_0.mcap", "day/walk_1.mcap")
    assert found(tmp_path, "") == ["day/walk_0.mcap", "day/walk_1.mcap", "lab"]


def test_other_metadata_do_not_make_a_folder_one_log(tmp_path):
    touch(tmp_path, "a.mcap", "b.mcap")
    (tmp_path / "metadata.yaml").write_text("title: our data\n")
    assert found(tmp_path, "") == ["a.mcap", "b.mcap"]


def test_nothing_found_is_an_error(tmp_path):
    with pytest.raises(ConfigError, match="there is no log"):
        find_logs([str(tmp_path)])
    with pytest.raises(FileNotFoundError):
        find_logs([str(tmp_path / "no.mcap"), str(tmp_path)])
    with pytest.raises(ConfigError, match="- is one log"):
        find_logs(["-", str(tmp_path)])


def test_a_folder_with_nothing_but_one_file_is_that_log(tmp_path):
    touch(tmp_path, "lab/walk.mcap")
    assert not are_many([str(tmp_path / "lab")])
    assert are_many([str(tmp_path)])
    touch(tmp_path, "lab/more/walk.bag")
    assert are_many([str(tmp_path / "lab")])


def test_one_file_a_missing_file_and_a_pipe_are_not_many(tmp_path):
    assert not any(are_many([name]) for name in ("-", str(tmp_path / "x.mcap")))
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs/y.mcap").touch()
    pattern = str(tmp_path / "logs/*.mcap")
    assert all(are_many(names) for names in ([str(tmp_path)], [pattern], ["a", "b"]))


def test_names_are_as_short_as_they_can_be_and_never_the_same():
    logs = ["/d/mon/lab.mcap", "/d/tue/lab.mcap", "/d/walk.mcap", "/d/WALK.bag", "/d/mon_lab.mcap"]
    names = distinct_names(logs, {})
    assert names["/d/tue/lab.mcap"] == "tue_lab"
    assert names["/d/mon/lab.mcap"] == "mon_lab"
    assert names["/d/mon_lab.mcap"] == "d_mon_lab"
    assert distinct_names(["/d/a.mcap", "/d/a.bag"], {}) == {
        "/d/a.mcap": "d_a", "/d/a.bag": "d_a-2"
    }  # fmt: skip
    assert len({name.casefold() for name in names.values()}) == len(logs)


def test_a_log_keeps_its_name_when_others_come():
    first = distinct_names(["/a/lab.mcap"], {})
    second = distinct_names(["/a/lab.mcap", "/b/lab.mcap"], first)
    assert second == {"/a/lab.mcap": "lab", "/b/lab.mcap": "b_lab"}


def records_of(folder):
    _, *lines = (folder / "hiros-process.jsonl").read_text().splitlines()
    return {row["name"]: row for row in map(json.loads, lines)}


def process(*named, jobs=1):
    *logs, out = map(str, named)
    return run(["process", *logs, "-o", out, "--jobs", str(jobs), "--quiet"])


def test_failures_do_not_stop_the_others(recordings, tmp_path):
    assert process(recordings, tmp_path / "out") == 2
    records = records_of(tmp_path / "out")
    verdicts = {name: row["verdict"] for name, row in records.items()}
    assert verdicts == {"a_lab": "done", "b_lab": "done", "cut": "failed", "walk": "done"}
    assert str(records["cut"]["error"]).startswith("truncated")
    names = {path.name for path in (tmp_path / "out").glob("*.mcap")}
    assert names == {"a_lab.hiros.mcap", "b_lab.hiros.mcap", "walk.hiros.mcap"}


def test_a_result_is_that_of_the_same_command_on_one_log(walking, tmp_path):
    assert process(walking, tmp_path / "out") == 0
    assert run(["process", str(walking), "-o", str(tmp_path / "one.mcap"), "-q"]) == 0
    result = tmp_path / "out" / "one_person_walking.hiros.mcap"
    assert result.read_bytes() == (tmp_path / "one.mcap").read_bytes()


def test_a_second_run_does_only_what_is_left(recordings, tmp_path):
    out = tmp_path / "out"
    process(recordings, out)
    before = {path.name: path.stat().st_mtime_ns for path in out.glob("*.mcap")}
    shutil.copy(recordings / "walk.mcap", recordings / "cut.mcap")  # mended
    shutil.copy(recordings / "walk.mcap", recordings / "b/lab.mcap")  # another log
    (out / "walk.hiros.mcap").unlink()
    assert process(recordings, out) == 0
    after = {path.name: path.stat().st_mtime_ns for path in out.glob("*.mcap")}
    assert {name for name in after if after[name] == before.get(name)} == {"a_lab.hiros.mcap"}


def test_a_log_of_another_time_is_done(tmp_path):
    log, out = tmp_path / "lab.mcap", str(tmp_path / "out")
    job, done = Nothing(), []
    for k in (0, 0, 1):
        log.write_bytes(b"one")
        os.utime(log, (k, k))
        ((_, now),) = run_logs(job, [str(log)], out, 1)
        done.append(now)
    assert done == [True, False, True]


def test_a_result_that_was_cut_is_made_again(walking, tmp_path):
    out = tmp_path / "out"
    process(walking, out)
    result = out / "one_person_walking.hiros.mcap"
    whole = result.read_bytes()
    result.write_bytes(whole[: len(whole) // 2])
    process("--force", walking, out)
    assert result.read_bytes() == whole


def test_other_parameters_do_everything_again(walking, tmp_path):
    out = tmp_path / "out"
    process(walking, out)
    (first,) = records_of(out).values()
    process("--set", "filter.cutoff=3", walking, out)
    (second,) = records_of(out).values()
    assert first["configuration"] != second["configuration"]
    assert first["files"] != second["files"]


def test_a_stopped_run_has_its_manifest(recordings, tmp_path):
    job, out = ProcessJob(Settings()), str(tmp_path / "out")
    runs = run_logs(job, find_logs([str(recordings)]), out, 1)
    done = [next(runs)[0], next(runs)[0]]
    runs.close()  # type: ignore[attr-defined]
    assert set(Manifest("process", Path(out)).records) == {record.log for record in done}


def test_a_log_that_kills_its_process_is_reported(recordings, monkeypatch):
    def deadly(function, tasks, jobs, lost):  # type: ignore[no-untyped-def]
        yield 0, lost(0, "a process was killed by signal 9")
        yield 1, function(*tasks[1])

    monkeypatch.setattr("hiros_mcap.many.run_logs.run_tasks", deadly)
    logs = find_logs([str(recordings / "walk.mcap"), str(recordings / "b")])
    walk, lab = (record for record, _ in run_logs(Nothing(), logs, ""))
    assert (walk.verdict, lab.verdict) == ("failed", "done")
    assert walk.error == "stopped its process more than once: a process was killed by signal 9"


class Nothing(Job):
    """A job without any work."""

    command = "info"

    def run(self, log, target):
        return Finding()


def test_a_fault_of_hiros_is_named_so(walking):
    class Broken(Nothing):
        def run(self, log, target):
            raise KeyError("tibia")

    record = run_one(Broken(), LogRecord(str(walking), "walk", "failed"), "")
    assert (record.verdict, record.bug, record.error) == ("failed", True, "bug: KeyError: 'tibia'")


def test_foreign_files_are_kept(walking, tmp_path):
    out = tmp_path / "out"
    touch(out, "x")
    (out / "one_person_walking.hiros.mcap").write_text("mine")
    assert process(walking, out) == 2
    assert (out / "one_person_walking.hiros.mcap").read_text() == "mine"


def test_two_runs_do_not_share_a_folder(tmp_path):
    with locked(tmp_path), pytest.raises(LogError, match="another run"), locked(tmp_path):
        pass


def test_results_among_the_recordings_are_no_recordings(walking, tmp_path):
    shutil.copy(walking, tmp_path / "walk.mcap")
    assert process(tmp_path, tmp_path / "out") == 0
    assert process(tmp_path, tmp_path / "out") == 0
    assert set(records_of(tmp_path / "out")) == {"walk"}
    assert process(tmp_path / "out", tmp_path / "again") == 0
    (record,) = records_of(tmp_path / "again").values()
    assert (record["verdict"], record["files"]) == ("skipped", {})
    assert record["error"] == "is a result of hiros, not a recording"


def test_a_truth_among_the_recordings_is_no_recording(walking, tmp_path):
    shutil.copy(walking, tmp_path / "walk.mcap")
    keep(walking, tmp_path / "walk.truth.mcap", "/truth")
    keep(walking, tmp_path / "detector_off.mcap", "/tf_static")
    assert process(tmp_path, tmp_path / "out") == 2
    records = records_of(tmp_path / "out")
    verdicts = {name: one["verdict"] for name, one in records.items()}
    assert verdicts == {"walk": "done", "walk.truth": "skipped", "detector_off": "failed"}
    assert records["walk.truth"]["error"] == "is a truth, not a recording"


def keep(source, target, prefix):
    """Copy the channels of a log that begin with ``prefix``."""
    with McapReader(source) as reader, McapWriter(target) as writer:
        for message in reader.messages():
            channel = reader.channels[message.channel_id]
            if channel.topic.startswith(prefix):
                writer.write_message(writer.adopt(channel, reader.schema(channel)), message)
        writer.commit()


DAMAGED = ["{}", "[1]", "no", HEAD.replace("2", "9"), HEAD + '\n{"log": 1}', "[" * 200_000]


@pytest.mark.parametrize("text", DAMAGED)
def test_a_damaged_manifest_is_one_line(text, walking, tmp_path):
    (tmp_path / "hiros-process.jsonl").write_text(f"{text}\n")
    assert process(walking, tmp_path) == 2


def change(manifest, **values):
    """Change fields of the only record of a manifest."""
    head, line = manifest.read_text().splitlines()
    manifest.write_text(f"{head}\n{json.dumps(json.loads(line) | values)}\n")


@pytest.mark.parametrize("name", ["../evil/mine", "/tmp/mine", "..", "a/b", "", "a\0b"])
def test_a_manifest_does_not_choose_where_results_go(name, walking, tmp_path, capsys):
    out = tmp_path / "out"
    process(walking, out)
    change(out / "hiros-process.jsonl", name=name, verdict="failed")
    before = sorted(tmp_path.rglob("*"))
    assert process(walking, out) == 2
    assert "is not a manifest of this version" in capsys.readouterr().err
    assert sorted(tmp_path.rglob("*")) == before


def test_a_foreign_file_that_a_manifest_names_is_kept(walking, tmp_path):
    out = tmp_path / "out"
    process(walking, out)
    result = out / "one_person_walking.hiros.mcap"
    change(out / "hiros-process.jsonl", files={result.name: 4}, configuration="")
    result.write_text("mine")
    assert process(walking, out) == 2
    assert result.read_text() == "mine"


def test_what_cannot_be_read_in_a_folder_is_named(walking, tmp_path, capsys):
    folder = tmp_path / "in"
    folder.mkdir()
    shutil.copy(walking, folder)
    (folder / "lost.mcap").symlink_to(tmp_path / "nowhere.mcap")
    os.mkfifo(folder / "pipe.mcap")
    assert process(folder, tmp_path / "out") == 2
    error = capsys.readouterr().err
    assert "lost.mcap: No such file or directory" in error
    assert "pipe.mcap: is a device or a pipe, not a file of a log" in error
    verdicts = {name: one["verdict"] for name, one in records_of(tmp_path / "out").items()}
    assert verdicts == {"one_person_walking": "done", "lost": "failed", "pipe": "failed"}
    sizes = {name: one["input"]["size"] for name, one in records_of(tmp_path / "out").items()}
    assert sizes == {"one_person_walking": walking.stat().st_size, "lost": 0, "pipe": 0}


@pytest.mark.skipif(os.name != "posix", reason="needs process groups")
def test_ctrl_c_leaves_no_part_of_a_result(recordings, tmp_path):
    out = tmp_path / "out"
    command = [sys.executable, "-m", "hiros_cli", "process", str(recordings), "-o", str(out)]
    with subprocess.Popen([*command, "--jobs", "2", "-q"], start_new_session=True) as hiros:
        while hiros.poll() is None and not list(out.glob(".hiros-*.tmp")):
            time.sleep(0.01)
        os.killpg(hiros.pid, signal.SIGINT)
    assert hiros.returncode == 128 + signal.SIGINT
    assert not list(out.glob(".*"))


@pytest.mark.parametrize(
    "arguments", [["s3://lab/walk.mcap"], ["walk.mcap", "a.mcap", "-o", "https://lab.org/out/"]]
)
def test_an_address_is_refused(arguments, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert run(["process", *arguments]) == 2
    assert "://" in (said := capsys.readouterr().err)
    assert "is an address; hiros reads and writes files of this machine" in said
    assert not list(tmp_path.iterdir())


def test_what_is_for_one_log_is_refused(walking, tmp_path, capsys):
    two = [str(walking), str(walking)]
    assert run(["process", *two]) == 2
    assert run(["process", *two, "-o", str(tmp_path / "o"), "--save-limbs", "l.toml"]) == 2
    assert run(["process", str(walking), "--csv", str(tmp_path / "t.csv")]) == 2
    said = capsys.readouterr().err.splitlines()
    assert [line.partition("error: ")[2][:22] for line in said] == [
        "with many logs, name a",
        "--save-limbs is for on",
        "--csv is for many logs",
    ]
    assert not list(tmp_path.iterdir())


@pytest.fixture(scope="module")
def results(tmp_path_factory, walking, crossing):
    """Return a folder with two results."""
    out = tmp_path_factory.mktemp("many") / "results"
    assert process(walking, crossing, out) == 0
    return out


def printed(capsys, *command):
    """Run a command on many logs with --json; return what became of each, by its name."""
    capsys.readouterr()
    run([*map(str, command), "--jobs", "1", "--json"])
    data = json.loads(capsys.readouterr().out)
    return {Path(row["log"]).name.partition(".")[0]: row for row in data["logs"]}


def test_eval_of_many_says_what_it_says_of_one(results, capsys):
    rows = printed(capsys, "eval", results)
    run(["eval", str(results / "one_person_walking.hiros.mcap"), "--json"])
    one = list(json.loads(capsys.readouterr().out)["channels"].values())[-1]
    assert rows["one_person_walking"]["values"]["mpjpe"] == pytest.approx(one["mean"])


def test_eval_finds_the_truth_of_each_log_by_its_name(results, walking, tmp_path, capsys):
    shutil.copy(walking, tmp_path / "one_person_walking.truth.mcap")
    rows = printed(capsys, "eval", results, "--truth", tmp_path)
    assert rows["one_person_walking"]["values"]["people"] == 1
    error = rows["two_people_crossing"]["error"]
    assert "has no truth two_people_crossing.truth.mcap (or .mcap, .trc, .c3d, .csv)" in error


def test_export_of_many_does_not_replace_foreign_files(results, tmp_path, capsys):
    command = ["export", str(results), "-o", str(tmp_path), "--format", "trc", "--jobs", "1", "-q"]
    (tmp_path / "two_people_crossing.hiros.1.trc").write_text("")
    (tmp_path / "two_people_crossing.1.trc").write_text("mine")
    assert run(command) == 2
    assert (
        "two_people_crossing.1.trc: exists and is not an export of hiros; --force"
        in capsys.readouterr().err
    )
    (tmp_path / "two_people_crossing.1.trc").unlink()
    assert run(command) == 0
    names = {path.name for path in tmp_path.glob("*.trc")} - {"two_people_crossing.hiros.1.trc"}
    assert names == {
        "one_person_walking.trc", "two_people_crossing.0.trc", "two_people_crossing.1.trc"
    }  # fmt: skip
    assert run([*command, "--what", "joints"]) == 0  # its own files
    (tmp_path / "one_person_walking.trc").write_text("corrected by hand")
    assert run(command) == 2
    assert (tmp_path / "one_person_walking.trc").read_text() == "corrected by hand"


def test_a_log_is_known_if_nothing_has_changed():
    record = LogRecord("/a.mcap", "a", "done", files={"a.mcap": 3}, input=Identity(7, ""))
    manifest = Manifest("process")
    manifest.add(record)
    assert manifest.knows(record, {"a.mcap": 3}) is record
    assert manifest.knows(record, {"a.mcap": 4}) is None
    others = {"name": "b", "version": "0", "configuration": "c", "input": Identity(8, "")}
    for field, value in others.items():
        assert manifest.knows(replace(record, **{field: value}), {"a.mcap": 3}) is None, field


def test_the_last_record_of_a_log_counts_and_a_line_that_was_cut_does_not(tmp_path):
    record = LogRecord("/a.mcap", "a", "failed")
    for verdict in ("failed", "done"):
        Manifest("process", tmp_path).add(replace(record, verdict=verdict))
    with (tmp_path / "hiros-process.jsonl").open("a") as file:
        file.write('{"log": "/b.mca')  # whoever wrote it was killed
    again = Manifest("process", tmp_path)
    again.add(replace(record, log="/c.mcap"))
    records = Manifest("process", tmp_path).records
    assert [(log, one.verdict) for log, one in records.items()] == [
        ("/a.mcap", "done"), ("/c.mcap", "failed")
    ]  # fmt: skip


def test_means_are_those_of_the_numbers_that_are_known():
    values = [1.0, 2, 6.0, float("nan"), "text"]
    records = [LogRecord(f"/{v}", "x", "done", values={"n": v}, seconds=4.0) for v in values]
    failed = LogRecord("/f", "x", "failed", seconds=0.1)
    assert column_means([*records, failed]) == {"n": 3.0, "took_s": 4.0}


def test_the_table_of_many_logs_as_csv(recordings, tmp_path, capsys):
    table = tmp_path / "table.csv"
    assert run(["info", str(recordings), "--jobs", "1", "--csv", str(table)]) == 2
    said = capsys.readouterr()
    assert "4 logs: 3 done, 1 failed" in said.out
    assert "cut.mcap: truncated" in said.out  # the reason stands below the table, too
    with table.open() as file:
        rows = {Path(row["log"]).name: row for row in csv.DictReader(file)}
    assert (rows["walk.mcap"]["verdict"], rows["walk.mcap"]["cameras"]) == ("done", "3")
    assert rows["cut.mcap"]["error"].startswith("truncated")
    assert sum("truncated" in line for line in said.err.splitlines()) == 1


@pytest.mark.parametrize(
    ("verdicts", "code"),
    [
        (["done", "doubtful", "skipped"], 0),
        (["done", "recovered"], 3),
        (["failed", "recovered"], 2),
    ],
)
def test_the_exit_code_says_the_worst(verdicts, code):
    records = [LogRecord(name, name, verdict) for name, verdict in zip("abc", verdicts)]  # noqa: B905
    assert exit_code(records) == code
    assert exit_code([*records, LogRecord("e", "e", "failed", bug=True)]) == 70
