"""Cost of a command: CPU of each step, how often it opens files and decompresses their chunks.

    python benchmarks/steps.py LOG... [--system SYSTEM] [--truth FILE] [--again N]

Runs `process`, then `eval` of the result (against the truth, if there is one), `eval` with each
camera left out, and `compare` of one system, in this process. CPU is that of all threads.
Decompressions are counted in chunks, and as the share of the chunks of the file that the command
was given: 2.0 means that each was decompressed twice. Other files, also temporary ones, count, too.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import io
import tempfile
import time
from collections import Counter
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

from hiros_cli.commands import dispatch
from hiros_mcap.config import load_config
from hiros_mcap.io.container import McapReader
from hiros_mcap.io.container.reader import Records
from hiros_mcap.io.container.records import Chunk
from hiros_mcap.running.pipeline import process
from hiros_mcap.running.process_options import ProcessOptions

COUNTS: Counter[str] = Counter()


def count() -> None:
    """Count from here on what every reader opens and decompresses."""
    opened, load = McapReader.__init__, McapReader._read_chunk

    def counted_open(self: McapReader, *args: object, **options: object) -> None:
        COUNTS["opened"] += 1
        opened(self, *args, **options)  # type: ignore[arg-type]

    def counted_load(self: McapReader, chunk: Chunk) -> Records:
        COUNTS["chunks"] += 1
        return load(self, chunk)

    McapReader.__init__ = counted_open  # type: ignore[method-assign, assignment]
    McapReader._read_chunk = counted_load  # type: ignore[method-assign]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("logs", type=Path, nargs="+")
    parser.add_argument("--system", default="fuse")
    parser.add_argument("--truth", type=Path)
    parser.add_argument("--again", type=int, default=1, help="print the least CPU of so many runs")
    given = parser.parse_args()
    count()
    for log in given.logs:
        print(f"\n{log.name}, {given.system}", flush=True)
        with tempfile.TemporaryDirectory() as folder:
            out = Path(folder) / f"{log.stem}.out.mcap"
            steps(log, out, given.system)
            truth = ["--truth", str(given.truth)] if given.truth else []
            commands = {
                "process": ["process", str(log), "-o", str(out), "--force"],
                "eval of the result": ["eval", str(out), *truth],
                "eval, one left out": ["eval", str(log), "--leave-one-out"],
                "compare": ["compare", str(log), *truth, "--jobs", "1"],
            }
            for name, arguments in commands.items():
                file = out if name == "eval of the result" else log
                measure(name, [*arguments, "--system", given.system, "-q"], file, given.again)


def steps(log: Path, out: Path, system: str) -> None:
    """Print the CPU of each step of the second run; the first one loads the kernels."""
    for _ in range(2):
        options = ProcessOptions(system=system)
        summary = process(log, out, config=load_config(system=system), options=options, force=True)
    for step in summary.stages:
        print(f"    {step.name:18} {1000 * step.cpu_s:8.0f} ms")


def measure(name: str, arguments: list[str], file: Path, again: int) -> None:
    """Run a command; print what it costs."""
    least = float("inf")
    for _ in range(again):
        COUNTS.clear()
        start = time.process_time()
        with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
            code = dispatch(arguments)
        least = min(least, time.process_time() - start)
    opened, chunks = COUNTS["opened"], COUNTS["chunks"]
    with McapReader(file) as reader:
        share = chunks / max(len(reader.contents.chunks), 1)
    print(
        f"  {name:20} {1000 * least:8.0f} ms CPU, {opened:3} files opened, "
        f"{chunks:5} chunks decompressed ({share:.1f} times the log)"
        + (f", exit code {code}" if code else ""),
        flush=True,
    )


if __name__ == "__main__":
    main()
