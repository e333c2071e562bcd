"""Many logs: throughput of several processes against one, overhead per log, and 10 000 hours.

    python benchmarks/many_logs.py [LOGS [SECONDS [JOBS]]]

Simulates a few logs and processes LOGS copies of them (64) of SECONDS (30): some by a command each,
all in one process, then in JOBS (2). Prints wall and CPU time. The overhead per log is what a log
takes beyond its run: finding, hashing, planning, manifest, hand-over; the start of the processes is
apart.

Only the time counts here, so the simulated detector is the ideal one.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from hiros_mcap.config import Settings
from hiros_mcap.many.find import find_logs
from hiros_mcap.many.jobs import ProcessJob
from hiros_mcap.many.manifest import LogRecord
from hiros_mcap.many.run_logs import run_logs
from hiros_mcap.simulate import SimulateParams
from hiros_mcap.simulate.simulation import write_log

DIFFERENT = 4
HOURS = 10_000


def recordings(folder: Path, logs: int, seconds: float) -> list[str]:
    """Write logs; some are copies, since the simulator takes longer than the run."""
    folder.mkdir()
    for k in range(logs):
        path = folder / f"log{k:03}.mcap"
        if k < DIFFERENT:
            write_log(path, SimulateParams(people=2, cameras=3, seconds=seconds, seed=k))
        else:
            shutil.copy(folder / f"log{k % DIFFERENT:03}.mcap", path)
    return find_logs([str(folder)])


def cpu() -> float:
    """Return the CPU time, s, of this process and of those that it has waited for."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in used)


def measure(logs: list[str], out: Path, jobs: int) -> tuple[float, float, list[LogRecord]]:
    """Return wall time from the first to the last log, time before the first, and the records."""
    start, first, records = time.perf_counter(), 0.0, []
    for record, _ in run_logs(ProcessJob(Settings()), logs, str(out), jobs):
        first = first or time.perf_counter() - start
        records.append(record)
    return time.perf_counter() - start, first, records


def by_command(logs: list[str], folder: Path) -> float:
    """Return the wall time of `hiros process` for one log after the other."""
    start = time.perf_counter()
    for log in logs:
        command = [sys.executable, "-m", "hiros_cli", "process", log, "-q"]
        subprocess.run([*command, "-o", str(folder / "out.mcap")], check=True)
    return time.perf_counter() - start


def main() -> None:
    given = [float(text) for text in sys.argv[1:]]
    count, seconds, jobs = (*given, *(64.0, 30.0, 2.0)[len(given) :])
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        logs = recordings(folder / "in", int(count), seconds)
        size = sum(Path(log).stat().st_size for log in logs) / len(logs) / 1e6
        print(f"{len(logs)} logs of {seconds:g} s, {size:.1f} MB each")
        wall = by_command(logs[:DIFFERENT], folder) / DIFFERENT
        print(f"a command per log: {wall:.2f} s per log, {seconds / wall:.1f} times real time")
        rates = []
        for n in (1, int(jobs)):
            before = cpu()
            wall, first, records = measure(logs, folder / f"out{n}", n)
            used = (cpu() - before) / len(logs)
            runs = [record.values["log_s"] / record.values["times_real_time"] for record in records]
            overhead = (wall - first) * n / (len(logs) - n) - sum(runs) / len(logs)
            rates.append(len(logs) / wall)
            mean = sum(runs) / len(logs)
            print(
                f"{n} at once: {wall:.1f} s, {seconds * rates[-1]:.1f} times real time, first log "
                f"after {first:.1f} s; per log {used:.2f} s CPU, {mean:.2f} s run, "
                f"{overhead:.2f} s overhead"
            )
            written = sum(sum(record.files.values()) for record in records) / len(records) / 1e6
            shutil.rmtree(folder / f"out{n}")
        print(f"{int(jobs)} against 1: {rates[1] / rates[0]:.2f} times the throughput")
        times = HOURS * 3600 / seconds
        print(
            f"{HOURS} hours of such logs: {used * times / 3600:.0f} core hours, "
            f"{size * times / 1e6:.1f} TB in, {written * times / 1e6:.1f} TB out"
        )


if __name__ == "__main__":
    main()
