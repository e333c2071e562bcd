"""Do the tests notice wrong code? Changes drawn at random, one at a time, and what the tests say.

    python benchmarks/mutations.py [--seed 0] [--changes 60] [--begin 0] [--limit 300] [--jobs 1]

Each change is made in a copy of the project: a comparison or an operator becomes another one, a
condition is negated, a number grows by 1, True becomes False. Folders have equal chances, then the
lines in them. Tests run that import the module or have its name; without such, those that import
something from its folder; they stop at the first failure. Before, the same tests have to pass
without the change. A change that goes unnoticed is printed: it may change nothing that counts, so
look at each. Baselines that fail, and changes for which the time did not suffice, are no verdicts.
"""

from __future__ import annotations

import argparse
import ast
import os
import random
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parent.parent
FOLDERS = ("calibrate", "running", "stages", "io", "kernels", "plan", "many", "evaluate")
COPIED = ("hiros_mcap", "cli", "schemas", "viewer", "tests", "sample_data", "docs", "benchmarks")
OPERATORS: dict[type[ast.AST], tuple[str, str]] = {
    ast.Lt: ("<", "<="), ast.LtE: ("<=", "<"), ast.Gt: (">", ">="), ast.GtE: (">=", ">"),
    ast.Eq: ("==", "!="), ast.NotEq: ("!=", "=="), ast.Add: ("+", "-"), ast.Sub: ("-", "+"),
    ast.Mult: ("*", "/"), ast.Div: ("/", "*"), ast.And: ("and", "or"), ast.Or: ("or", "and"),
}  # fmt: skip


class Change(NamedTuple):
    """Some text of a line that becomes another one."""

    path: Path
    line: int
    column: int
    before: str
    after: str

    def apply(self, source: str) -> str:
        """Return the changed source."""
        lines = source.split("\n")
        text = lines[self.line - 1]
        end = self.column + len(self.before)
        lines[self.line - 1] = text[: self.column] + self.after + text[end:]
        return "\n".join(lines)

    def __str__(self) -> str:
        line = self.path.read_text(encoding="utf-8").split("\n")[self.line - 1].strip()
        place = f"{self.path.relative_to(ROOT)}:{self.line}:{self.column + 1}"
        return f"{place}: {self.before!r} -> {self.after!r} in: {line}"


def changes_in(path: Path) -> Iterator[Change]:
    """Yield the changes that can be made in functions of a module, none across two lines."""
    source = path.read_text(encoding="utf-8")
    if not source.isascii():  # columns of the syntax tree are bytes
        return
    lines = source.split("\n")

    def between(one: ast.expr, other: ast.expr, operator: ast.AST) -> Iterator[Change]:
        row, begin, end = one.end_lineno or 0, one.end_col_offset or 0, other.col_offset
        before, after = OPERATORS.get(type(operator), ("", ""))
        if before and row == other.lineno and before in (text := lines[row - 1][begin:end]):
            yield Change(path, row, begin + text.index(before), before, after)

    functions = [n for n in ast.walk(ast.parse(source)) if isinstance(n, ast.FunctionDef)]
    nodes = {id(n): n for f in functions for part in f.body for n in ast.walk(part)}
    for node in nodes.values():
        match node:
            case ast.Compare(left=left, ops=[operator], comparators=[right]):
                yield from between(left, right, operator)
            case ast.BinOp(left=left, op=operator, right=right):
                yield from between(left, right, operator)
            case ast.BoolOp(op=operator, values=[left, right, *_]):
                yield from between(left, right, operator)
            case ast.UnaryOp(op=ast.Not()):
                yield Change(path, node.lineno, node.col_offset, "not ", "")
            case ast.Constant(value=bool(value)):
                yield Change(path, node.lineno, node.col_offset, str(value), str(not value))
            case ast.Constant(value=int() | float()):
                text = ast.get_source_segment(source, node) or ""
                yield Change(path, node.lineno, node.col_offset, text, f"({text} + 1)")


def drawn(seed: int, n: int) -> list[Change]:
    """Return n changes, drawn at random."""
    dice = random.Random(seed)
    table = {
        folder: [
            change
            for path in sorted((ROOT / "hiros_mcap" / folder).rglob("*.py"))
            for change in changes_in(path)
        ]
        for folder in FOLDERS
    }
    return [dice.choice(table[dice.choice(FOLDERS)]) for _ in range(n)]


def tests_of(path: Path) -> list[str]:
    """Return the test files that import a module, or else something from its folder."""
    module = ".".join(path.relative_to(ROOT).with_suffix("").parts)
    tests = {p: p.read_text(encoding="utf-8") for p in sorted((ROOT / "tests").rglob("test_*.py"))}
    for name in (module, module.rpartition(".")[0]):
        named = f"test_{path.stem}"  # it may import the module's contents from its folder
        found = [
            str(p.relative_to(ROOT)) for p, text in tests.items() if name in text or p.stem == named
        ]
        if found:
            return found
    return ["tests/running"]


def passes(copy: Path, tests: list[str], limit: float, jobs: int) -> bool | None:
    """Whether tests pass in a copy; None if the time did not suffice."""
    folders = (copy, *(copy / name for name in ("cli", "schemas", "viewer")))
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, folders))}
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider"]
    command += ["-n", str(jobs)] if jobs > 1 else []
    process = subprocess.Popen(
        [*command, *tests], cwd=copy, env=environment, start_new_session=True,
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        return process.wait(limit) == 0
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, 9)  # with the workers and commands that the tests have started
        process.wait()
        return None


def verdict(change: Change, copy: Path, limit: float, jobs: int) -> str:
    """Return what became of a change."""
    target, tests = copy / change.path.relative_to(ROOT), tests_of(change.path)
    source = target.read_text(encoding="utf-8")
    target.write_text(change.apply(source), encoding="utf-8")
    try:
        found = passes(copy, tests, limit, jobs)
    finally:
        target.write_text(source, encoding="utf-8")
    if found is None:
        return "out of time"
    if found:
        return "unnoticed"
    return "noticed" if passes(copy, tests, limit, jobs) else "no baseline"


def main() -> None:
    """Print the verdicts."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--changes", type=int, default=60)
    parser.add_argument("--begin", type=int, default=0, help="leave out so many of them")
    parser.add_argument("--limit", type=float, default=300.0, help="s for the tests of a change")
    parser.add_argument("--jobs", type=int, default=1, help="processes of pytest")
    options = parser.parse_args()
    counts: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "hiros"
        for name in COPIED:
            shutil.copytree(ROOT / name, copy / name)
        for path in filter(Path.is_file, ROOT.iterdir()):
            shutil.copy(path, copy)
        for change in drawn(options.seed, options.changes)[options.begin :]:
            result = verdict(change, copy, options.limit, options.jobs)
            counts[result] += 1
            print(f"{result}: {change}", flush=True)
    judged = counts["noticed"] + counts["unnoticed"]
    without = f"{counts['out of time']} out of time, {counts['no baseline']} without a baseline"
    print(f"{counts['noticed']} of {judged} changes noticed; without a verdict: {without}")


if __name__ == "__main__":
    main()
