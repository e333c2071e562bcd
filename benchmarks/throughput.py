"""Speed of whole commands: one table for one version of hiros, or two versions side by side.

    python benchmarks/throughput.py [--seconds S] [--people N] [--cameras N] [--runs N]
                                    [--log FILE] [--before PYTHON]

The log is simulated (60 s, 4 people, 5 cameras at 30 Hz) unless --log names one. Each row is the
median of N runs (3). PYTHON is the interpreter of another environment, with the version to compare
with; its runs alternate with ours. Wall times hold for a machine that does nothing else: the first
line prints its load and how long ten million additions in a loop of Python take.

- whole: a `hiros process` from its start to its end; CPU of all threads, peak memory.
- start: CPU until the log is opened. Compiled: kernels compiled in a process with an empty home.
- warm: the third run in one process.
- live: CPU of tracker, merger, optimizer and filter per merged frame of a causal system.
- jobs: a fourth of the log's length, 8 logs, --jobs 2 against --jobs 1.

Only the time counts here, so the simulated detector is the ideal one.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from hiros_mcap.simulate import SimulateParams
from hiros_mcap.simulate.simulation import write_log

Row = dict[str, float]
SYSTEMS = ("hiros", "fuse")
LIVE = ("hiros-realtime", "fuse-realtime")
COMMAND = """
import runpy, sys, time
def run(words):
    sys.argv = ["hiros", *words]
    try:
        runpy.run_module("hiros_cli", run_name="__main__")
    except SystemExit as end:
        assert not end.code, end.code
"""
START = """
def opened(event, given):
    if event == "open" and given[0] == sys.argv[2]:
        print(time.process_time(), flush=True)
        os._exit(0)
import os
sys.addaudithook(opened)
"""
COMPILED = """
from numba.core import event
with event.install_recorder("numba:compile") as compiled:
    run(sys.argv[1:])
print(sum(e.is_start for _, e in compiled.buffer))
"""
WARM = """
words = sys.argv[1:]
for _ in range(3):
    began = time.perf_counter()
    run(words)
print(time.perf_counter() - began)
"""


def call(python: str, *words: str, home: str | None = None) -> tuple[str, Row]:
    """Run a command; return what it printed, and its wall time, CPU time (s) and memory (MB)."""
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    if home:
        environment |= {"HOME": home, "XDG_CACHE_HOME": home}
    began = time.perf_counter()
    command = [python, *words]
    with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) as run:
        assert run.stdout
        printed = run.stdout.read()
        _, status, used = os.wait4(run.pid, 0)
        run.returncode = os.waitstatus_to_exitcode(status)
    if run.returncode:
        raise SystemExit(f"{' '.join(command)} ended with {run.returncode}")
    cpu, memory = used.ru_utime + used.ru_stime, used.ru_maxrss / 1024
    return printed, {"wall s": time.perf_counter() - began, "CPU s": cpu, "MB": memory}


class Measures:
    """The rows of the table, each measured by one run of a version of hiros."""

    def __init__(self, log: Path, folder: Path) -> None:
        self.log, self.folder = log, folder
        self.seconds = 0.0

    def rows(self) -> dict[str, Callable[[str], Row]]:
        """The runs to measure, by the name of their row."""
        whole = {f"whole, {name}": lambda p, s=name: self.whole(p, s) for name in SYSTEMS}
        warm = {f"warm, {name}": lambda p, s=name: self.warm(p, s) for name in SYSTEMS}
        live = {f"live, {name}": lambda p, s=name: self.live(p, s) for name in LIVE}
        return {**whole, "start": self.start, **warm, **live, "jobs": self.jobs}

    def _process(self, system: str, *more: str) -> list[str]:
        target = str(self.folder / "out.mcap")
        return ["process", str(self.log), "-o", target, "-f", "--system", system, *more]

    def whole(self, python: str, system: str) -> Row:
        """A whole process."""
        printed, row = call(python, "-m", "hiros_cli", *self._process(system, "--json"))
        self.seconds = json.loads(printed)["log_s"]
        return {**row, "x real time": self.seconds / row["wall s"]}

    def start(self, python: str) -> Row:
        """CPU until the log is opened, and compilations of a fresh process."""
        words = self._process("fuse", "-q")
        printed, _ = call(python, "-c", COMMAND + START + "run(sys.argv[1:])", *words)
        with tempfile.TemporaryDirectory() as home:
            compiled, _ = call(python, "-c", COMMAND + COMPILED, *words, home=home)
        return {"CPU s": float(printed), "compiled": float(compiled)}

    def warm(self, python: str, system: str) -> Row:
        """The third run of a process."""
        printed, _ = call(python, "-c", COMMAND + WARM, *self._process(system, "-q"))
        return {"wall s": float(printed), "x real time": self.seconds / float(printed)}

    def live(self, python: str, system: str) -> Row:
        """CPU of a causal system per merged frame, without reading and writing."""
        printed, _ = call(python, "-m", "hiros_cli", *self._process(system, "--json"))
        summary = json.loads(printed)
        fused = [s["cpu_s"] for s in summary["stages"] if s["name"] not in ("read", "write")]
        return {"ms": sum(fused) / summary["written"]["/hiros/merged"] * 1000}

    def jobs(self, python: str) -> Row:
        """Eight logs in two worker processes against one."""
        source, out = self.folder / "logs", self.folder / "results"
        wall = []
        for jobs in ("2", "1"):
            shutil.rmtree(out, ignore_errors=True)
            words = ["process", str(source), "-o", f"{out}/", "-q", "--jobs", jobs]
            wall.append(call(python, "-m", "hiros_cli", *words)[1]["wall s"])
        return {"wall s": wall[0], "x one job": wall[1] / wall[0]}


def loop() -> float:
    """Return the time, s, of ten million additions in a loop of Python."""
    began, total = time.perf_counter(), 0
    for k in range(10_000_000):
        total += k
    return time.perf_counter() - began


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--people", type=int, default=4)
    parser.add_argument("--cameras", type=int, default=5)
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--log", type=Path)
    parser.add_argument("--before", help="the interpreter of another environment")
    given = parser.parse_args()
    print(f"load {os.getloadavg()[0]:.1f}, ten million additions {loop():.2f} s")
    versions = {"before": given.before, "now": sys.executable}
    versions = {name: python for name, python in versions.items() if python}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "logs").mkdir()
        scene = {"people": given.people, "cameras": given.cameras}
        if not given.log:
            write_log(folder / "log.mcap", SimulateParams(**scene, seconds=given.seconds, seed=1))
        for k in range(8):
            short = SimulateParams(**scene, seconds=given.seconds / 4, seed=k % 2)
            if k < 2:
                write_log(folder / f"logs/{k}.mcap", short)
            else:
                shutil.copy(folder / f"logs/{k % 2}.mcap", folder / f"logs/{k}.mcap")
        measures = Measures((given.log or folder / "log.mcap").absolute(), folder)
        for title, measure in measures.rows().items():
            taken: dict[str, list[Row]] = {version: [] for version in versions}
            for _ in range(given.runs):
                for version, python in versions.items():
                    taken[version].append(measure(python))
            for version, runs in taken.items():
                row = {key: statistics.median(run[key] for run in runs) for key in runs[0]}
                figures = "  ".join(f"{value:7.2f} {key}" for key, value in row.items())
                print(f"{title:22}{version if len(versions) > 1 else '':8}{figures}", flush=True)


if __name__ == "__main__":
    main()
