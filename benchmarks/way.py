"""Cost of a message on its way through a run: calls, copies, orderings, holding, page faults.

    python benchmarks/way.py LOG [--systems fuse hiros fuse-realtime] [--callers N]

Runs `process` four times in this process: to warm up; plain, for the CPU of each step and the page
faults; with the arrays of people counted; with every call of the main thread counted. Counting
makes a run many times slower, so no time is taken from the last two. All figures but the CPU are
divided by the number of the log's messages.

- python: calls of Python functions in the main thread.
- kernels: calls of compiled kernels in the main thread, and how many kernels these are.
- made: bytes of the arrays of people that are made, by People.allocate or by rows that are chosen.
- ordered: functions of hiros_mcap that sort or keep a heap at least once per 100 messages.
- held: calls that give frames to something that keeps them.
- faults: minor page faults of the process.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import resource
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

from hiros_mcap.running.pipeline import process
from hiros_mcap.running.summary import Summary
from hiros_mcap.skeletons import People

ORDERING = {"argsort", "lexsort", "sort", "sorted", "heappush", "heappop", "heapreplace", "merge"}
HOLDING = ("HeldFrames.add", "TimeOrder.push", "Delay.push", "LogOrder.push", "LookAhead.add")
_RARE = 0.01  # orderings per message below which a function counts as preparation


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("log", type=Path)
    parser.add_argument("--systems", nargs="+", default=["fuse", "hiros", "fuse-realtime"])
    parser.add_argument("--callers", type=int, default=0, help="print the N most called functions")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        for system in options.systems:
            target = Path(folder, "out.mcap")

            def run(system: str = system, target: Path = target) -> Summary:
                return process(options.log, target, system=system, force=True)

            measure(system, run, options.callers)


def measure(system: str, run: Callable[[], Summary], callers: int) -> None:
    """Print the figures of one system."""
    run()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    summary = run()
    faults = resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
    messages = sum(camera.messages for camera in summary.cameras)
    with made_people() as made:
        run()
    python, kernels, ordered = counted_calls(run)
    held = sum(n for name, n in python.items() if name.endswith(HOLDING))
    steady = {name: n / messages for name, n in ordered.items() if n > _RARE * messages}
    print(f"{system}: {messages} messages")
    print(f"  python   {python.total() / messages:8.1f} calls")
    print(f"  kernels  {kernels.total() / messages:8.2f} calls, {len(kernels)} kernels")
    print(f"  made     {made[0] / messages / 1024:8.1f} KiB")
    print(f"  ordered  {sum(steady.values()):8.2f} calls, {len(steady)} functions")
    for name, n in sorted(steady.items(), key=lambda item: -item[1]):
        print(f"           {n:8.2f} {name}")
    print(f"  held     {held / messages:8.2f} calls")
    print(f"  faults   {faults / messages:8.1f}")
    print("  cpu      " + ", ".join(f"{step.name} {step.cpu_s:.2f} s" for step in summary.stages))
    for name, n in python.most_common(callers):
        print(f"           {n / messages:8.2f} {name}")


@contextmanager
def made_people() -> Iterator[list[int]]:
    """Yield a list whose number counts the bytes of people's arrays that are made meanwhile."""
    made, allocate, at = [0], People.allocate, People.at

    def size(people: People) -> int:
        return sum(array.nbytes for array in people if isinstance(array, np.ndarray))

    def counted_allocate(*shape: Any) -> People:
        people = allocate(*shape)
        made[0] += size(people)
        return people

    def counted_at(people: People, rows: Any) -> People:
        chosen = at(people, rows)
        made[0] += 0 if isinstance(rows, slice) else size(chosen)
        return chosen

    People.allocate = counted_allocate  # type: ignore[method-assign, assignment]
    People.at = counted_at  # type: ignore[method-assign, assignment]
    try:
        yield made
    finally:
        People.allocate = allocate  # type: ignore[method-assign]
        People.at = at  # type: ignore[method-assign]


def counted_calls(run: Callable[[], object]) -> tuple[Counter[str], Counter[str], Counter[str]]:
    """Return how often the main thread calls Python functions, kernels, and sorts, by the name."""
    codes: Counter[Any] = Counter()
    kernels: Counter[str] = Counter()
    ordered: Counter[Any] = Counter()

    def see(frame: FrameType, event: str, function: Any) -> None:
        if event == "call":
            codes[frame.f_code] += 1
        elif event == "c_call":
            if (getattr(function, "__module__", None) or "").startswith("hiros_mcap"):
                kernels[function.__name__] += 1
            elif function.__name__ in ORDERING:
                ordered[caller(frame)] += 1

    sys.setprofile(see)
    try:
        run()
    finally:
        sys.setprofile(None)
    python: Counter[str] = Counter()
    for code, n in codes.items():
        python[name_of(code)] += n
    named: Counter[str] = Counter()
    for code, n in ordered.items():
        if "hiros_mcap" in code.co_filename:
            named[name_of(code)] += n
    return python, kernels, named


def caller(frame: FrameType) -> Any:
    """Return the code of the function of hiros_mcap that a call comes from, else the nearest."""
    at: FrameType | None = frame
    while at is not None and "hiros_mcap" not in at.f_code.co_filename:
        at = at.f_back
    return (at or frame).f_code


def name_of(code: Any) -> str:
    """Return the module and the name of a function."""
    return f"{Path(code.co_filename).stem}.{code.co_qualname}"


if __name__ == "__main__":
    main()
