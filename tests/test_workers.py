"""Tasks in several processes: in any order, and over at once when they are to be."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from worker_tasks import die, dies_once, hold_second, refuse, square, where

from hiros_mcap.errors import HirosError, LogError
from hiros_mcap.workers import run_tasks

SAMPLES = Path(__file__).parent.parent / "sample_data"


@pytest.mark.parametrize("jobs", [1, 9])
def test_every_task_is_done_once(jobs):
    found = dict(run_tasks(square, [(n,) for n in range(5)], jobs))
    assert found == {n: n * n for n in range(5)}


def test_nothing_to_do():
    assert list(run_tasks(square, [], 2)) == []


def test_one_job_is_done_in_this_process_and_two_in_others():
    assert {pid for _, pid in run_tasks(where, [(0,), (1,)], 1)} == {os.getpid()}
    others = {pid for _, pid in run_tasks(where, [(0,), (1,)], 2)}
    assert os.getpid() not in others


def test_an_error_is_raised_as_it_was():
    with pytest.raises(LogError, match="is damaged") as caught:
        list(run_tasks(refuse, [(n,) for n in range(5)], 2))
    assert (caught.value.path, caught.value.topic) == ("lab.mcap", "/camera")


@pytest.mark.skipif(os.name != "posix", reason="kills by a signal")
def test_a_killed_process_is_an_error_that_says_so():
    with pytest.raises(HirosError, match="killed by signal 9; is there enough memory"):
        list(run_tasks(die, [(n,) for n in range(5)], 2))


@pytest.mark.skipif(os.name != "posix", reason="kills by a signal")
def test_a_task_whose_process_was_killed_is_tried_again(tmp_path):
    tasks = [(str(tmp_path / "a"),), (str(tmp_path / "b"),), (str(tmp_path / "c"),)]
    answers = dict(run_tasks(dies_once, tasks, 2, lost=lambda k, why: -1))
    assert sorted(answers) == [0, 1, 2]
    assert all(pid > 0 for pid in answers.values())


@pytest.mark.skipif(os.name != "posix", reason="kills by a signal")
def test_a_task_that_kills_every_process_is_lost_and_the_others_are_not():
    tasks = [(n,) for n in range(6)]
    answers = dict(run_tasks(die, tasks, 2, lost=lambda k, why: f"{k}: {why}"))
    assert answers.pop(2).startswith("2: a process was killed by signal 9")
    assert answers == {n: n for n in range(6) if n != 2}


def test_whoever_stops_asking_stops_the_processes(tmp_path):
    tasks = run_tasks(hold_second, [(str(tmp_path), 0), (str(tmp_path), 1)], 2)
    assert next(tasks)[0] == 0
    while not (held := [path.read_text() for path in tmp_path.glob("*.started")]) or not held[0]:
        time.sleep(0.01)
    start = time.monotonic()
    tasks.close()  # type: ignore[attr-defined]
    assert time.monotonic() - start < 5
    assert not Path(held[0]).parent.exists()


@pytest.mark.skipif(os.name != "posix", reason="needs process groups")
@pytest.mark.parametrize(
    ("name", "seconds"),
    [("SIGINT", 0.5), ("SIGTERM", 0.8), ("SIGHUP", 1.5)],  # Python alone, before, is not silent
)
def test_a_signal_to_all_processes_ends_them_silently(name, seconds, tmp_path):
    suite = SAMPLES / "suite.toml"
    command = [sys.executable, "-m", "hiros_cli", "check", str(suite), "--jobs", "2"]
    with subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
        env={**os.environ, "TMPDIR": str(tmp_path)},
    ) as process:
        time.sleep(seconds)
        os.killpg(process.pid, getattr(signal, name))
        _, stderr = process.communicate(timeout=20)
    if process.returncode != 0:  # a fast machine is done
        assert process.returncode in (128 + getattr(signal, name), -getattr(signal, name))
    assert stderr == b""
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(os.name != "posix", reason="kills by a signal")
def test_the_processes_end_with_the_first_however_that_ends(tmp_path):
    code = (
        f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r})\n"
        "from worker_tasks import hold; from hiros_mcap.workers import run_tasks\n"
        f"if __name__ == '__main__': list(run_tasks(hold, [({str(tmp_path)!r},)] * 2, 2))"
    )
    script = tmp_path / "run.py"
    script.write_text(code)
    with subprocess.Popen([sys.executable, str(script)]) as first:
        while len(started := list(tmp_path.glob("*.started"))) < 2:
            time.sleep(0.01)
        first.kill()
    end = time.monotonic() + 20
    while any(is_running(int(path.stem)) for path in started):
        assert time.monotonic() < end
        time.sleep(0.01)


def is_running(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    state = Path(f"/proc/{pid}/stat")
    return not state.exists() or state.read_text().rpartition(")")[2].split()[0] != "Z"
