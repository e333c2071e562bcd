"""Feeds odd text to every reader of text, and altered files to whole commands, for as long as you
like; prints what neither may do.

PYTHONPATH=.:cli:schemas:viewer:tests python benchmarks/fuzz.py --examples 5000
PYTHONPATH=.:cli:schemas:viewer:tests python benchmarks/fuzz.py process recover --examples 300
"""

from __future__ import annotations

import argparse
import tempfile
import traceback
from collections.abc import Callable
from pathlib import Path

from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st
from text_readers import READERS, odd_text
from whole_commands import COMMANDS, TooSlow, altered, faults_of, write_files

from hiros_mcap.errors import HirosError

WORDS_OF_OTHERS = {"events", "report"}
"""Their callers name the attachment, for any ValueError."""


def fuzz(
    strategy: st.SearchStrategy[bytes],
    check: Callable[[bytes, Path], list[str]],
    examples: int,
    first_seed: int,
) -> dict[str, bytes]:
    """Return the faults that a check finds, each with the first data that has it."""
    faults: dict[str, bytes] = {}

    @seed(first_seed)
    @settings(
        max_examples=examples,
        deadline=None,
        database=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(data=strategy)
    def once(data: bytes) -> None:
        with tempfile.TemporaryDirectory() as folder:
            for fault in check(data, Path(folder)):
                faults.setdefault(fault.replace(folder, ""), data)

    once()
    return faults


def faults_of_reader(name: str, data: bytes, folder: Path) -> list[str]:
    kind, read = READERS[name]
    path = folder / f"x.{kind}"
    path.write_bytes(data)
    try:
        read(path)
    except HirosError:
        pass
    except Exception as error:  # noqa: BLE001
        if not (isinstance(error, ValueError) and name in WORDS_OF_OTHERS):
            return [traceback.format_exc().splitlines()[-1]]
    return []


def faults_of_command(name: str, files: Path, data: bytes, folder: Path) -> list[str]:
    try:
        return faults_of(name, files, data, folder)
    except TooSlow as error:
        return [f"too slow: {error}"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--examples", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("names", nargs="*", help="readers and commands; default: all")
    parser.add_argument("--keep", type=Path, help="folder for the files with which faults occur")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        files = Path(folder)
        write_files(files)
        for name in options.names or [*READERS, *COMMANDS]:
            if name in READERS:
                strategy = odd_text(READERS[name][0])
                faults = fuzz(
                    strategy,
                    lambda data, place, name=name: faults_of_reader(name, data, place),
                    options.examples,
                    options.seed,
                )
            else:
                faults = fuzz(
                    altered(name, files),
                    lambda data, place, name=name: faults_of_command(name, files, data, place),
                    options.examples,
                    options.seed,
                )
            print(f"{name}: {options.examples} examples, {len(faults)} faults", flush=True)
            for k, (fault, data) in enumerate(sorted(faults.items())):
                print(f"    {fault}: {data[:200]!r}")
                if options.keep:
                    options.keep.mkdir(exist_ok=True)
                    (options.keep / f"{name.replace(' ', '_')}.{k}").write_bytes(data)


if __name__ == "__main__":
    main()
