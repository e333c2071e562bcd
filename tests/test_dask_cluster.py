"""Many logs on a real Dask cluster of several processes, some of which are killed."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
from worker_tasks import die

from hiros_cli.app import run
from hiros_mcap.many import cluster_runner
from hiros_mcap.many.cluster_runner import on_cluster

ROOT = Path(__file__).parents[1]
HIROS = [sys.executable, "-m", "hiros_cli"]
PATIENCE_S = 120.0

pytestmark = pytest.mark.skipif(os.name != "posix", reason="kills by a signal")


@contextmanager
def started(folder, workers):
    """Start a scheduler and workers, each below a nanny that replaces it; yield file, scheduler."""
    file = folder / "scheduler.json"
    path = os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")])
    environment = {
        **os.environ,
        "PYTHONPATH": path,
        "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "1",
        # A worker that replaces a killed one need not import all anew.
        "DASK_DISTRIBUTED__WORKER__MULTIPROCESSING_METHOD": "forkserver",
    }
    common = ["--scheduler-file", str(file), "--no-dashboard", "--host", "127.0.0.1"]
    scheduler = ["-m", "distributed.cli.dask_scheduler", *common, "--port", "0"]
    worker = ["-m", "distributed.cli.dask_worker", *common, "--nworkers", str(workers)]
    with (folder / "log").open("wb") as log:
        processes = [
            subprocess.Popen(
                [sys.executable, *command],
                stdout=log,
                stderr=log,
                cwd=folder,
                env=environment,
                start_new_session=True,
            )
            for command in (scheduler, [*worker, "--nthreads", "1"])
        ]
        yield file, processes[0]
        for process in reversed(processes):
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGTERM)
            process.wait(PATIENCE_S)


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    with started(tmp_path_factory.mktemp("cluster"), 2) as (file, _):
        yield file


@pytest.fixture
def client(cluster):
    from distributed import Client

    wait_for(cluster.exists)
    with Client(scheduler_file=str(cluster), timeout=PATIENCE_S) as client:
        client.wait_for_workers(2, timeout=PATIENCE_S)
        yield client


def wait_for(condition):
    end = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)


def test_a_killed_workers_logs_are_done_by_others(cluster, client, walking, tmp_path):
    (tmp_path / "in").mkdir()
    for k in range(5):
        shutil.copy(walking, tmp_path / "in" / f"{k}.mcap")
    out = tmp_path / "out"
    command = [*HIROS, "process", str(tmp_path / "in"), "-o", str(out), "--cluster", str(cluster)]
    victim = next(iter(client.run(os.getpid).values()))
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=os.environ) as hiros:
        assert hiros.stderr is not None
        lines = iter(hiros.stderr.readline, "")
        assert next(line for line in lines if line.startswith("[1/5]"))
        os.kill(victim, signal.SIGSTOP)  # in the middle of a log, or with some handed over
        assert next(lines)
        os.kill(victim, signal.SIGKILL)
        rest = list(lines)
    assert hiros.returncode == 0, rest
    records = json.loads((out / "hiros-process.json").read_text())["logs"]
    assert [record["verdict"] for record in records] == ["done"] * 5
    by_victim = [r for r in records if r["worker"].endswith(f":{victim}")]
    assert len(by_victim) <= 3
    assert len({(out / f"{k}.hiros.mcap").read_bytes() for k in range(5)}) == 1


def test_a_task_that_kills_workers_is_given_up_and_the_others_are_not(cluster, client):
    runner = on_cluster(str(cluster), [])
    answers = dict(runner(die, [(n,) for n in range(4)], lost=lambda k, why: -k))
    assert answers == {0: 0, 1: 1, 2: -2, 3: 3}


def test_a_scheduler_that_dies_is_one_line_and_what_is_done_is_kept(walking, tmp_path):
    (tmp_path / "in").mkdir()
    for k in range(3):
        shutil.copy(walking, tmp_path / "in" / f"{k}.mcap")
    command = [*HIROS, "process", str(tmp_path / "in"), "-o", str(tmp_path / "out"), "--cluster"]
    command.append(str(tmp_path / "scheduler.json"))
    with (
        started(tmp_path, 1) as (_, scheduler),
        subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as hiros,
    ):
        assert next(line for line in hiros.stderr if line.startswith("[1/3]"))
        os.killpg(scheduler.pid, signal.SIGKILL)
        said = [line for line in hiros.stderr if not line.startswith("[")]
    fault = "hiros: error: the connection to the cluster is lost; the same command goes on\n"
    assert (hiros.returncode, said) == (2, [fault])
    assert list((tmp_path / "out").glob("*.hiros.mcap"))


def test_workers_that_do_not_see_the_logs_are_refused(cluster, capsys):
    from hiros_mcap.errors import ConfigError

    with pytest.raises(ConfigError, match="does not see /nowhere/lab.mcap; logs and results"):
        list(on_cluster(str(cluster), ["/nowhere/lab.mcap"])(die, [(0,)], lost=max))


def test_a_scheduler_that_is_not_there_is_one_line(walking, tmp_path, monkeypatch, capsys):
    command = ["process", str(walking), "-o", str(tmp_path / "out")]
    assert run([*command, "--cluster", "nonsense"]) == 2
    assert "no scheduler answers there" in capsys.readouterr().err
    monkeypatch.setattr(cluster_runner, "_CONNECT_S", 0.2)
    assert run([*command, "--cluster", str(tmp_path / "nosuch.json")]) == 2
    assert "nosuch.json: there is no such file; `dask" in capsys.readouterr().err
