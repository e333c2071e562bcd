"""Feeds odd text to every reader of text for as long as you like; prints what no reader may raise.

PYTHONPATH=.:cli:schemas:viewer:tests python benchmarks/fuzz.py --examples 5000
"""

from __future__ import annotations

import argparse
import tempfile
import traceback
from pathlib import Path

from hypothesis import HealthCheck, given, seed, settings
from text_readers import READERS, odd_text

from hiros_mcap.errors import HirosError

WORDS_OF_OTHERS = {"events", "report"}
"""Their callers name the attachment, for any ValueError."""


def fuzz(name: str, examples: int, first_seed: int) -> set[str]:
    """Return the unexpected errors of a reader."""
    kind, read = READERS[name]
    found: set[str] = set()

    @seed(first_seed)
    @settings(
        max_examples=examples,
        deadline=None,
        database=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(data=odd_text(kind))
    def once(data: bytes) -> None:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / f"x.{kind}"
            path.write_bytes(data)
            try:
                read(path)
            except HirosError:
                pass
            except Exception as error:  # noqa: BLE001
                if not (isinstance(error, ValueError) and name in WORDS_OF_OTHERS):
                    found.add(f"{traceback.format_exc().splitlines()[-1]}: {data[:200]!r}")

    once()
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--examples", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    given_options = parser.parse_args()
    for name in READERS:
        found = fuzz(name, given_options.examples, given_options.seed)
        print(f"{name}: {given_options.examples} texts, {len(found)} faults", flush=True)
        for line in sorted(found):
            print(f"    {line}")


if __name__ == "__main__":
    main()
