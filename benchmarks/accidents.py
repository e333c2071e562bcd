"""Accidents while hiros works: signals, a full disk, files that change, two runs onto one output.

Each case happens at random times or places, whose seed is printed. Right is a whole result, or one
clear line and the documented exit code. Printed is what is not: half a result under its final name,
a changed input, a traceback, another exit code.

PYTHONPATH=.:cli:schemas:viewer python benchmarks/accidents.py --times 20
"""

from __future__ import annotations

import argparse
import hashlib
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

HIROS = (sys.executable, "-m", "hiros_cli")
SAMPLE = Path(__file__).parent.parent / "sample_data" / "two_people_crossing.mcap"
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGKILL)
COMMANDS = {
    "process": ("process", "lab.mcap", "-o", "out.mcap"),
    "export": ("export", "clean.mcap", "-o", "out.csv"),
    "plot": ("plot", "clean.mcap", "-o", "out.html"),
    "view": ("view", "clean.mcap", "--save", "out.rrd"),
    "compare": ("compare", "lab.mcap", "--table", "out.csv"),
    "many": ("process", "lab.mcap", "twin.mcap", "-o", "out"),
}
"""Each writes files whose names begin with "out", beside its inputs."""


class Room:
    """A folder with inputs; says afterwards what an accident did to it."""

    def __init__(self, folder: Path, clean: Path) -> None:
        self.folder = folder
        shutil.copyfile(SAMPLE, folder / "lab.mcap")
        shutil.copyfile(SAMPLE, folder / "twin.mcap")
        shutil.copyfile(clean, folder / "clean.mcap")
        self._inputs = self._digests()

    def start(self, arguments: tuple[str, ...], **more: object) -> subprocess.Popen[bytes]:
        """Start hiros here, as head of a group of processes."""
        return subprocess.Popen(
            (*HIROS, *arguments),
            cwd=self.folder,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            start_new_session=True,
            **more,  # type: ignore[call-overload]
        )

    def faults(
        self, process: subprocess.Popen[bytes], codes: set[int], whole: dict[str, str]
    ) -> Iterator[str]:
        """Yield what may not be; ``codes`` may, ``whole`` has the digests of whole results."""
        _, stderr = process.communicate(timeout=120)
        text = stderr.decode(errors="replace")
        if process.returncode not in codes:
            yield f"exit code {process.returncode}: {text[-300:]}"
        if "Traceback" in text or "bug:" in text:
            yield text[-500:]
        alone = all(line.startswith("hiros: ") for line in text.splitlines())
        if process.returncode == 2 and not (alone and text.count("hiros: error:") == 1):
            yield f"not one line of error: {text[-300:]}"
        changed = {n: d for n, d in self._digests().items() if self._inputs.get(n) != d}
        for name, digest in changed.items():
            if name in self._inputs:
                yield f"input changed: {name}"
            elif name.endswith(".mcap") and not _is_whole(self.folder / name):
                yield f"half a log under its final name: {name}"
            elif name in whole and digest != whole[name]:
                yield f"half a result under its final name: {name}"

    def _digests(self) -> dict[str, str]:
        files = (f for f in self.folder.rglob("*") if f.is_file() and not f.name.startswith("."))
        return {str(f.relative_to(self.folder)): _digest(f) for f in files}


def _is_whole(path: Path) -> bool:
    return path.read_bytes().endswith(b"\x89MCAP0\r\n")


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


@contextmanager
def rooms(clean: Path) -> Iterator[Callable[[], Room]]:
    """Give a maker of fresh rooms below one folder, which goes at the end."""
    with tempfile.TemporaryDirectory() as folder:
        yield lambda: Room(Path(tempfile.mkdtemp(dir=folder)), clean)


def whole_results(room: Room, arguments: tuple[str, ...]) -> tuple[dict[str, str], float]:
    """Return digests of what an undisturbed run writes, and how long it takes, s."""
    start = time.monotonic()
    before = room._digests()
    process = room.start(arguments)
    _, stderr = process.communicate()
    if process.returncode:
        raise SystemExit(f"{arguments}: {stderr.decode()}")
    files = {n: d for n, d in room._digests().items() if n not in before}
    return files, time.monotonic() - start


def signalled(room: Room, arguments: tuple[str, ...], at: float, number: int) -> subprocess.Popen:
    """Run, and send a signal to the process alone after ``at`` seconds."""
    process = room.start(arguments)
    time.sleep(at)
    with suppress(ProcessLookupError):
        process.send_signal(number)
    if number == signal.SIGKILL:
        with suppress(ProcessLookupError):  # its workers, which nobody else ends
            os.killpg(process.pid, number)
    return process


def case_signals(make: Callable[[], Room], times: int, chance: random.Random) -> Iterator[str]:
    """Each command ends at once by a signal, and leaves no half result."""
    for name, arguments in COMMANDS.items():
        whole, seconds = whole_results(make(), arguments)
        # Pages and tables of comparisons state when or how fast they were made.
        stable = {
            file: digest
            for file, digest in whole.items()
            if file.endswith(".mcap") or name == "export"
        }
        for _ in range(times):
            number = chance.choice(SIGNALS)
            at = chance.uniform(0.05, seconds)
            room = make()
            process = signalled(room, arguments, at, number)
            codes = {0, -number, 128 + number}
            for fault in room.faults(process, codes, stable):
                yield f"{name}, {number.name} after {at:.2f} s: {fault}"


def case_same_output(make: Callable[[], Room], times: int, chance: random.Random) -> Iterator[str]:
    """Two runs onto one file or one folder: each log is one of the two whole results."""
    for name in ("process", "many"):
        arguments = (*COMMANDS[name], "--force")
        other = (*arguments, "--system", "hiros")
        wholes = [whole_results(make(), a)[0] for a in (arguments, other)]
        for _ in range(times):
            room, delay = make(), chance.uniform(0.0, 1.0)
            first = room.start(arguments)
            time.sleep(delay)
            second = room.start(other)
            for process in (first, second):
                for fault in room.faults(process, {0, 2}, {}):
                    yield f"{name}, two runs, {delay:.2f} s apart: {fault}"
            for file in (file for file in wholes[0] if file.endswith(".mcap")):
                out = room.folder / file
                if out.exists() and _digest(out) not in [whole[file] for whole in wholes]:
                    yield f"{name}, two runs, {delay:.2f} s apart: {file} is neither's"


def case_full_disk(make: Callable[[], Room], times: int, chance: random.Random) -> Iterator[str]:
    """A limit of file size at a random place stands for a full disk."""
    import resource

    for name in ("process", "export", "view"):
        whole, _ = whole_results(make(), COMMANDS[name])
        for k in range(times):
            room, size = make(), chance.randrange(1, 400_000) if k else 0

            def limit(size: int = size) -> None:
                signal.signal(signal.SIGXFSZ, signal.SIG_IGN)  # EFBIG, as a full disk's ENOSPC
                resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))

            process = room.start(COMMANDS[name], preexec_fn=limit)
            for fault in room.faults(process, {0, 2}, whole if name != "view" else {}):
                yield f"{name}, disk full after {size} bytes: {fault}"


def case_changing_input(
    make: Callable[[], Room], times: int, chance: random.Random
) -> Iterator[str]:
    """A log is cut short or replaced while it is read."""
    arguments = COMMANDS["process"]
    _, seconds = whole_results(make(), arguments)
    for _ in range(times):
        room, at = make(), chance.uniform(0.05, seconds)
        log = room.folder / "lab.mcap"
        size = log.stat().st_size
        process = room.start(arguments)
        time.sleep(at)
        kind = chance.choice(("cut", "replaced", "grown"))
        if kind == "cut":
            os.truncate(log, chance.randrange(size))
        elif kind == "grown":
            with log.open("ab") as file:
                file.write(chance.randbytes(chance.randrange(100_000)))
        else:
            (room.folder / "new.mcap").write_bytes(b"another file")
            (room.folder / "new.mcap").replace(log)
        room._inputs["lab.mcap"] = _digest(log)
        room._inputs.pop("new.mcap", None)
        for fault in room.faults(process, {0, 2}, {}):
            yield f"input {kind} after {at:.2f} s: {fault}"


CASES = {
    "signals": case_signals,
    "same-output": case_same_output,
    "full-disk": case_full_disk,
    "changing-input": case_changing_input,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("cases", nargs="*", metavar="CASE", help=", ".join(CASES))
    parser.add_argument("--times", type=int, default=20)
    parser.add_argument("--seed", type=int, default=random.SystemRandom().randrange(10**6))
    options = parser.parse_args()
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background ignores it
    print(f"seed {options.seed}")
    with tempfile.TemporaryDirectory() as folder:
        clean = Path(folder) / "clean.mcap"
        subprocess.run([*HIROS, "process", SAMPLE, "-o", clean, "--quiet"], check=True)
        for name in options.cases or CASES:
            with rooms(clean) as make:
                faults = list(CASES[name](make, options.times, random.Random(options.seed)))
            print(f"{name}: {len(faults)} faults", *faults, sep="\n  ", flush=True)


if __name__ == "__main__":
    main()
