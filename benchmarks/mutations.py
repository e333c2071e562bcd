"""Do the tests notice wrong code? Changes drawn at random, one at a time, and what the tests say.

    python benchmarks/mutations.py [--seed 0] [--changes 60] [--seconds 900]

Each change is made in a copy of the project: a comparison or an operator becomes another one, a
condition is negated, a number grows by 1, True becomes False. Folders have equal chances, then the
lines in them.

The test files run that reach the changed module by imports, those over the fewest first, for up to
``--seconds``, and stop at the first failure. What fails, or does not end, has to pass without the
change. What is compiled goes to a folder that is deleted.

A change that goes unnoticed is printed: it may change nothing that counts, so look at each. Those
that were looked at stand in mutations_same.json, with the reason why nothing changes.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from hiros_mcap.kernels import cache_folder

ROOT = Path(__file__).resolve().parent.parent
FOLDERS = ("calibrate", "rays", "running", "stages", "io", "kernels", "plan", "many", "evaluate")
OPERATORS: dict[type[ast.AST], tuple[str, str]] = {
    ast.Lt: ("<", "<="), ast.LtE: ("<=", "<"), ast.Gt: (">", ">="), ast.GtE: (">=", ">"),
    ast.Eq: ("==", "!="), ast.NotEq: ("!=", "=="), ast.Add: ("+", "-"), ast.Sub: ("-", "+"),
    ast.Mult: ("*", "/"), ast.Div: ("/", "*"), ast.And: ("and", "or"), ast.Or: ("or", "and"),
}  # fmt: skip
SAME = Path(__file__).with_name("mutations_same.json")
"""Changes that change nothing that counts -> the reason."""
REPORT = "HIROS_REPORT"
"""Environment of pytest: a file for the name of the test that runs."""
_ONE_TEST = 600.0
"""s that a single test may take, with what is compiled for it."""


# -- changes ---------------------------------------------------------------------------------------


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

    @property
    def key(self) -> str:
        """The change without the number of its line, which other changes of the file move."""
        line = self.path.read_text(encoding="utf-8").split("\n")[self.line - 1].strip()
        place = f"{self.path.relative_to(ROOT)}:{self.column + 1}"
        return f"{place}: {self.before!r} -> {self.after!r} in: {line}"

    def __str__(self) -> str:
        return f"line {self.line} of {self.key}"


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
                text = lines[node.lineno - 1][node.col_offset : node.end_col_offset]
                yield Change(path, node.lineno, node.col_offset, text, f"({text} + 1)")


def drawn(seed: int, n: int) -> list[Change]:
    """Return n different changes, drawn at random."""
    dice = random.Random(seed)
    table = {
        folder: [
            change
            for path in sorted((ROOT / "hiros_mcap" / folder).rglob("*.py"))
            for change in changes_in(path)
        ]
        for folder in FOLDERS
    }
    found: dict[Change, None] = {}
    while len(found) < n:
        found[dice.choice(table[dice.choice(FOLDERS)])] = None
    return list(found)


# -- tests -----------------------------------------------------------------------------------------


@cache
def imported(path: Path) -> frozenset[Path]:
    """Return the files of the project that a file imports, anywhere in it."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names = {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names = {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
        else:
            continue
        for name in names:
            place = name.replace(".", "/")
            for folder in (ROOT, ROOT / "cli", ROOT / "viewer", ROOT / "tests", path.parent):
                files = folder / f"{place}.py", folder / place / "__init__.py"
                found |= {file for file in files if file.exists()}
    return frozenset(found)


def nearest_tests(module: Path) -> list[str]:
    """Return the test files that reach a module by imports, those over the fewest first.

    Of those that are equally near, files named after the module or its folder come first.
    """
    every = [p for f in ("hiros_mcap", "cli", "tests") for p in sorted((ROOT / f).rglob("*.py"))]
    distances, reached = {module: 0}, {module}
    while reached:
        reached = {p for p in every if p not in distances and imported(p) & reached}
        distances |= dict.fromkeys(reached, max(distances.values()) + 1)
    stems = (module.stem, module.parent.name)
    tests = [p for p in distances if p.name.startswith("test_")]
    tests.sort(key=lambda p: (p.stem.removeprefix("test_") not in stems, distances[p], p))
    return [str(p.relative_to(ROOT)) for p in tests]


class Current:
    """A plugin of pytest: notes which test runs, or ran last."""

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        """Write the name of a test before it runs."""
        Path(os.environ[REPORT]).write_text(nodeid, encoding="utf-8")


def pytest_configure(config: Any) -> None:
    """Add the plugin; pytest was started with -p mutations."""
    config.pluginmanager.register(Current())


# -- running ---------------------------------------------------------------------------------------


class Copy(NamedTuple):
    """A copy of the project, in which tests run."""

    root: Path
    scratch: Path
    broken: set[str]
    """Tests that fail without a change."""

    def failing(self, tests: Sequence[str], limit: float) -> str | None:
        """Return the first test that fails, or has not ended after ``limit`` s; None if all pass.

        It is "" if none could begin.
        """
        report = self.scratch / "test"
        report.write_text("", encoding="utf-8")
        folders = (self.root, *(self.root / n for n in ("cli", "schemas", "viewer", "benchmarks")))
        environment = {
            **os.environ, REPORT: str(report), "PYTHONDONTWRITEBYTECODE": "1",
            "PYTHONPATH": os.pathsep.join(map(str, folders)),
            "NUMBA_CACHE_DIR": str(self.scratch / "compiled"),
        }  # fmt: skip
        left_out = [f"--deselect={name}" for name in sorted(self.broken)]
        process = subprocess.Popen(
            [sys.executable, "-m", "pytest", "-xq", "-p", "mutations", "-p", "no:cacheprovider",
             "-p", "no:xdist", *left_out, *tests], cwd=self.root,
            env=environment, start_new_session=True,
            stdout=(self.scratch / "pytest.log").open("w"), stderr=subprocess.STDOUT,
        )  # fmt: skip
        try:
            passed = process.wait(limit) in (0, 5)  # 5: there are no tests
        except subprocess.TimeoutExpired:
            passed = False
        finally:  # also when this script is interrupted
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)  # with the commands that the tests started
                process.wait()
        return None if passed else report.read_text(encoding="utf-8")

    def failing_with(self, change: Change, tests: Sequence[str], limit: float) -> str | None:
        """Return the same with a change."""
        target = self.root / change.path.relative_to(ROOT)
        source = target.read_text(encoding="utf-8")
        target.write_text(change.apply(source), encoding="utf-8")
        try:
            return self.failing(tests, limit)
        finally:
            target.write_text(source, encoding="utf-8")


def verdict(change: Change, copy: Copy, seconds: float) -> str:
    """Return what became of a change within so many ``seconds`` of tests."""
    files, begin, end = nearest_tests(change.path), 0, time.monotonic() + seconds
    while some := files[begin : 2 * begin + 3]:  # to collect all takes longer than most tests
        if (left := end - time.monotonic()) <= 0:
            return f"not noticed (by {begin} files in {seconds:.0f} s)"
        if (found := copy.failing_with(change, some, left)) is None:
            begin += len(some)
            continue
        again = [found] if found else some
        if time.monotonic() >= end and copy.failing_with(change, again, _ONE_TEST) is None:
            return f"not noticed (in {seconds:.0f} s, until {found})"
        if copy.failing(again, _ONE_TEST) is None:
            return f"noticed ({found or 'no test could begin'})"
        copy.broken.update(again)
    return f"not noticed (by {len(files)} files, all that reach it)"


def summary(counts: Counter[str]) -> str:
    """Return what became of all changes."""
    text = f"{counts.total()} drawn: " + ", ".join(f"{n} {what}" for what, n in counts.items())
    noticed = counts["noticed"]
    counted = noticed + counts["not noticed"]
    share = f"{noticed / counted:.0%}" if counted else "none"
    return f"{text}; noticed of those that change behaviour: {share}"


def main() -> None:
    """Print the verdicts."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--changes", type=int, default=60)
    parser.add_argument("--begin", type=int, default=0, help="leave out so many of them")
    parser.add_argument("--seconds", type=float, default=900.0, help="of tests for a change")
    options = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit("ended"))  # which deletes the copy
    same = json.loads(SAME.read_text(encoding="utf-8"))
    counts: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        copy = Copy(Path(folder) / "hiros", Path(folder), set())
        names = subprocess.check_output(["git", "ls-files", "-z"], cwd=ROOT, text=True)
        for name in filter(None, names.split("\0")):
            (copy.root / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, copy.root / name)
        if (compiled := cache_folder()).is_dir():
            shutil.copytree(compiled, copy.scratch / "compiled" / compiled.name)
        for change in drawn(options.seed, options.changes)[options.begin :]:
            result = verdict(change, copy, options.seconds)
            if result.startswith("not ") and (reason := same.get(change.key)):
                result = f"no change of behaviour ({reason})"
            counts[result.partition(" (")[0]] += 1
            print(f"{result}: {change}", flush=True)
    print(summary(counts))


if __name__ == "__main__":
    main()
