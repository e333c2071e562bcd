"""Do the tests notice wrong code? Changes drawn at random, one at a time, and what the tests say.

    python benchmarks/mutations.py [--seed 0] [--changes 60] [--seconds 60] [--reach FILE]

Each change is made in a copy of the project: a comparison or an operator becomes another one, a
condition is negated, a number grows by 1, True becomes False. Folders have equal chances, then the
lines in them.

First all tests run once without a change. It is noted which functions each of them calls and how
long it takes. Tests that fail then are left out. This takes as long as the tests with one process;
``--reach`` keeps the result in a file for other seeds, until the code changes. A kernel is taken to
run where a function runs that names it.

Of the tests that call the changed function, those that are quick and call little else run first, up
to ``--seconds`` of their time, and stop at the first failure. Where none is known (it may run in
another process), the test files run that import the module or have its name. What fails, or does
not end, has to pass without the change. What is compiled goes to a folder that is deleted.

A change that goes unnoticed is printed: it may change nothing that counts, so look at each. Those
that were looked at stand in mutations_same.json, with the reason why nothing changes.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
from collections import Counter
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from hiros_mcap.kernels import cache_folder

ROOT = Path(__file__).resolve().parent.parent
FOLDERS = ("calibrate", "running", "stages", "io", "kernels", "plan", "many", "evaluate")
OPERATORS: dict[type[ast.AST], tuple[str, str]] = {
    ast.Lt: ("<", "<="), ast.LtE: ("<=", "<"), ast.Gt: (">", ">="), ast.GtE: (">=", ">"),
    ast.Eq: ("==", "!="), ast.NotEq: ("!=", "=="), ast.Add: ("+", "-"), ast.Sub: ("-", "+"),
    ast.Mult: ("*", "/"), ast.Div: ("/", "*"), ast.And: ("and", "or"), ast.Or: ("or", "and"),
}  # fmt: skip
SAME = Path(__file__).with_name("mutations_same.json")
"""Changes that change nothing that counts -> the reason."""
ORDER, REPORT = "HIROS_TESTS", "HIROS_REPORT"
"""Environment of pytest: a file with the tests to run, in order, and one for what it saw."""


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


# -- which tests call a function -------------------------------------------------------------------


class Case(NamedTuple):
    """A test that passed without a change."""

    name: str
    """As pytest names it: file::function[case]."""
    seconds: float
    calls: frozenset[str]
    """Functions, as path:line of their definition."""


class Watch:
    """A plugin of pytest: runs tests in a given order, and notes what each calls."""

    def __init__(self, report: Path) -> None:
        self.report = report
        self.seen: set[Any] = set()
        self.of_fixtures: dict[Any, set[Any]] = {}
        self.rows: list[dict[str, Any]] = []

    def start(self) -> None:
        """Note every function that is called from now on, in all threads."""
        add = self.seen.add

        def trace(frame: Any, event: str, argument: object) -> None:
            add(frame.f_code)

        threading.settrace(trace)
        sys.settrace(trace)

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: Any, request: Any) -> Iterator[None]:
        """Keep what a fixture calls for all tests that use it."""
        before, self.seen = self.seen, set()
        self.start()
        try:
            return (yield)
        finally:
            self.of_fixtures[fixturedef] = self.seen
            before |= self.seen
            self.seen = before
            self.start()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: Any, nextitem: Any) -> Iterator[None]:
        """Note a test's calls, its time (user and system, with its children), and its fixtures."""
        self.seen, self.passed, begin = set(), True, seconds()
        self.start()
        try:
            return (yield)
        finally:
            sys.settrace(None)
            threading.settrace(None)  # type: ignore[arg-type]
            calls = set(self.seen)
            for several in item._fixtureinfo.name2fixturedefs.values():
                for fixture in several:
                    calls |= self.of_fixtures.get(fixture, set())
            if self.passed:
                row = {"name": item.nodeid, "seconds": seconds() - begin, "calls": places(calls)}
                self.rows.append(row)

    def pytest_runtest_logreport(self, report: Any) -> None:
        """Leave out what is skipped or fails."""
        self.passed = self.passed and report.passed

    def pytest_sessionfinish(self) -> None:
        """Write what was seen; functions once, and their numbers in each row."""
        numbers: dict[str, int] = {}
        for row in self.rows:
            row["calls"] = [numbers.setdefault(place, len(numbers)) for place in row["calls"]]
        text = json.dumps({"functions": list(numbers), "tests": self.rows})
        self.report.write_text(text, encoding="utf-8")


class Ordered:
    """A plugin of pytest: runs given tests in a given order, and notes the first that fails."""

    def __init__(self, order: Sequence[str], report: Path) -> None:
        self.place = {name: k for k, name in enumerate(order)}
        self.report = report

    def pytest_collection_modifyitems(self, items: list[Any]) -> None:
        """Leave out other tests; without an order all stay."""
        if self.place:
            self._sort(items)

    def _sort(self, items: list[Any]) -> None:
        items[:] = sorted(
            (item for item in items if item.nodeid in self.place),
            key=lambda item: self.place[item.nodeid],
        )

    def pytest_runtest_logreport(self, report: Any) -> None:
        """Write the name of a test that fails."""
        if report.failed:
            self.report.write_text(report.nodeid, encoding="utf-8")


def pytest_configure(config: Any) -> None:
    """Choose the plugin; pytest was started with -p mutations."""
    order, report = os.environ.get(ORDER), Path(os.environ[REPORT])
    if order:
        names = json.loads(Path(order).read_text(encoding="utf-8"))
        config.pluginmanager.register(Ordered(names, report))
    else:
        config.pluginmanager.register(Watch(report))


def seconds() -> float:
    """Time that this process and its children took, s."""
    kinds = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    uses = [resource.getrusage(kind) for kind in kinds]
    return sum(use.ru_utime + use.ru_stime for use in uses)


def places(codes: set[Any]) -> list[str]:
    """Return functions of the library as path:line; a line is that of the first decorator."""
    library = str(Path.cwd() / "hiros_mcap") + os.sep
    return sorted(
        f"{code.co_filename[len(library) :]}:{code.co_firstlineno}"
        for code in codes
        if code.co_filename.startswith(library)
    )


class Function(NamedTuple):
    """A function of the library, or an assignment in the head of a module."""

    path: str
    begin: int
    end: int
    names: frozenset[str]
    """What its lines name."""
    gives: frozenset[str]
    """Under which names others call it."""
    compiled: bool
    """Whether no call of it is seen: a kernel, or an assignment."""

    @property
    def place(self) -> str:
        """Where it begins, as the plugin notes it."""
        return f"{self.path}:{self.begin}"


@cache
def functions() -> list[Function]:
    """Return the functions of the library."""
    found = []
    for path in sorted((ROOT / "hiros_mcap").rglob("*.py")):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                gives, decorators = {node.name}, node.decorator_list
            elif isinstance(node, ast.Assign) and node in tree.body:
                gives, decorators = set().union(*map(named, node.targets)), []
            else:
                continue
            begin = min([node.lineno, *(d.lineno for d in decorators)])
            kernel = any(named(d) & {"entry", "kernel", "inlined"} for d in decorators)
            compiled = kernel or isinstance(node, ast.Assign)
            relative = str(path.relative_to(ROOT / "hiros_mcap"))
            end = node.end_lineno or 0
            found.append(Function(relative, begin, end, named(node), frozenset(gives), compiled))
    return found


def named(node: ast.AST) -> frozenset[str]:
    """Return the names and attributes in a part of a syntax tree."""
    parts = [n for n in ast.walk(node) if isinstance(n, ast.Name | ast.Attribute)]
    return frozenset(n.id if isinstance(n, ast.Name) else n.attr for n in parts)


@cache
def imports(path: str) -> frozenset[str]:
    """Return the last names of the modules that a module may have imported, and its own."""
    tree = ast.parse((ROOT / "hiros_mcap" / path).read_text(encoding="utf-8"))
    found = [n for n in ast.walk(tree) if isinstance(n, ast.ImportFrom)]
    modules = {(n.module or "").rpartition(".")[2] for n in found}
    return frozenset(modules | {a.name for n in found for a in n.names} | {Path(path).stem})


def around(change: Change) -> list[Function]:
    """Return the functions around a change, the innermost first."""
    path = str(change.path.relative_to(ROOT / "hiros_mcap"))
    inside = [f for f in functions() if f.path == path and f.begin <= change.line <= f.end]
    return sorted(inside, key=lambda f: f.end - f.begin)


def callers(kernel: Function) -> set[str]:
    """Return the places of functions that name a kernel, or a kernel that names it, and so on."""
    found, waiting = {kernel}, [kernel]
    while waiting:
        compiled = waiting.pop()
        stem = Path(compiled.path).stem
        new = {f for f in functions() if f.names & compiled.gives and stem in imports(f.path)}
        waiting += [f for f in new - found if f.compiled]
        found |= new
    return {f.place for f in found}


def those_that_call(change: Change, cases: Sequence[Case]) -> list[Case]:
    """Return the tests that call the changed function, the best first.

    A test is good if it takes little time and calls few other functions. Of a test with many cases,
    the k-th counts k times.
    """
    wanted: set[str] = set()
    for function in around(change)[:1]:
        wanted |= callers(function) if function.compiled else {function.place}
    found = [case for case in cases if case.calls & wanted]
    found.sort(key=lambda case: (0.01 + case.seconds) * len(case.calls))
    seen: Counter[str] = Counter()
    rank = {}
    for case in found:
        test = case.name.partition("[")[0]
        seen[test] += 1
        rank[case.name] = seen[test] * (0.01 + case.seconds) * len(case.calls)
    return sorted(found, key=lambda case: rank[case.name])


def files_about(path: Path) -> list[str]:
    """Return the test files that have the name of a module, and those that import it."""
    module = ".".join(path.relative_to(ROOT).with_suffix("").parts)
    files = sorted((ROOT / "tests").rglob("test_*.py"))
    same = [p for p in files if p.stem.removeprefix("test_") in (path.stem, path.parent.name)]
    importing = [p for p in files if module in p.read_text(encoding="utf-8")]
    return [str(p.relative_to(ROOT)) for p in dict.fromkeys(same + importing)]


def within(cases: Sequence[Case], limit: float) -> list[Case]:
    """Return the first tests that together take no more than a time, s."""
    chosen, total = [], 0.0
    for case in cases:
        if total + case.seconds <= limit:
            total += case.seconds
            chosen.append(case)
    return chosen


# -- running ---------------------------------------------------------------------------------------


class Copy(NamedTuple):
    """A copy of the project, in which tests run."""

    root: Path
    scratch: Path

    def pytest(self, *arguments: str, limit: float | None = None, **more: str) -> int | None:
        """Run pytest; return its exit code, None if the time did not suffice."""
        self.report.unlink(missing_ok=True)
        folders = (self.root, *(self.root / n for n in ("cli", "schemas", "viewer", "benchmarks")))
        environment = {
            **os.environ, REPORT: str(self.report), "PYTHONDONTWRITEBYTECODE": "1",
            "PYTHONPATH": os.pathsep.join(map(str, folders)),
            "NUMBA_CACHE_DIR": str(self.scratch / "compiled"), **more,
        }  # fmt: skip
        command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider"]
        process = subprocess.Popen(
            [*command, "-p", "no:xdist", "-p", "mutations", *arguments], cwd=self.root,
            env=environment, start_new_session=True,
            stdout=(self.scratch / "pytest.log").open("w"), stderr=subprocess.STDOUT,
        )  # fmt: skip
        try:
            return process.wait(limit)
        except subprocess.TimeoutExpired:
            return None
        finally:  # also when this script is interrupted
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)  # with the commands that the tests started
                process.wait()

    @property
    def report(self) -> Path:
        """What pytest writes."""
        return self.scratch / "report.json"

    def failing(self, files: Sequence[str], cases: Sequence[str], limit: float) -> str | None:
        """Return the first test that fails; "" if none does, None if the time is over.

        With ``cases`` only these tests of the files run, in this order.
        """
        order = self.scratch / "order.json"
        order.write_text(json.dumps(list(cases)), encoding="utf-8")
        code = self.pytest("-x", *files, limit=limit, **{ORDER: str(order)})
        if code in (None, 0):
            return None if code is None else ""
        return (
            self.report.read_text(encoding="utf-8")
            if self.report.exists()
            else "no test could begin"
        )

    def reached(self) -> str:
        """Run all tests; return which functions each calls, as JSON."""
        self.pytest()
        return self.report.read_text(encoding="utf-8")


def read_cases(text: str) -> list[Case]:
    """Return the tests that passed, from what the plugin has written."""
    content = json.loads(text)
    names = content["functions"]
    return [
        Case(row["name"], row["seconds"], frozenset(names[k] for k in row["calls"]))
        for row in content["tests"]
    ]


def verdict(change: Change, copy: Copy, cases: Sequence[Case], seconds: float) -> str:
    """Return what became of a change, and by which of so many ``seconds`` of tests."""
    reaching = those_that_call(change, cases)
    some = within(reaching, seconds)
    chosen = [case.name for case in some]
    files = list(dict.fromkeys(name.partition("::")[0] for name in chosen))
    if not (files := files or files_about(change.path)):
        return "not called"
    limit = 60 + 10 * sum(case.seconds for case in some) if some else 900
    target = copy.root / change.path.relative_to(ROOT)
    source = target.read_text(encoding="utf-8")
    target.write_text(change.apply(source), encoding="utf-8")
    try:
        found = copy.failing(files, chosen, limit)
    finally:
        target.write_text(source, encoding="utf-8")
    if found == "":
        ran = f"{len(chosen)} of {len(reaching)} tests" if chosen else ", ".join(files)
        return f"not noticed ({ran})"
    if found and "::" in found:
        files, chosen = [found.partition("::")[0]], [found]
    if copy.failing(files, chosen, limit) != "":
        return f"no baseline ({found})"
    return f"noticed ({found or 'no end'})"


def summary(counts: Counter[str]) -> str:
    """Return what became of all changes."""
    text = f"{counts.total()} drawn: " + ", ".join(f"{n} {what}" for what, n in counts.items())
    noticed = counts["noticed"]
    counted = noticed + counts["not noticed"] + counts["not called"]
    share = f"{noticed / counted:.0%}" if counted else "none"
    return f"{text}; noticed of those that change behaviour: {share}"


def main() -> None:
    """Print the verdicts."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--changes", type=int, default=60)
    parser.add_argument("--begin", type=int, default=0, help="leave out so many of them")
    parser.add_argument("--seconds", type=float, default=60.0, help="of tests for a change")
    parser.add_argument("--reach", type=Path, help="file that keeps which test calls what")
    options = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit("ended"))  # which deletes the copy
    same = json.loads(SAME.read_text(encoding="utf-8"))
    counts: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        copy = Copy(Path(folder) / "hiros", Path(folder))
        names = subprocess.check_output(["git", "ls-files", "-z"], cwd=ROOT, text=True)
        for name in filter(None, names.split("\0")):
            (copy.root / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, copy.root / name)
        if (compiled := cache_folder()).is_dir():
            shutil.copytree(compiled, copy.scratch / "compiled" / compiled.name)
        if options.reach and options.reach.exists():
            text = options.reach.read_text(encoding="utf-8")
        else:
            text = copy.reached()
            if options.reach:
                options.reach.write_text(text, encoding="utf-8")
        cases = read_cases(text)
        for change in drawn(options.seed, options.changes)[options.begin :]:
            result = verdict(change, copy, cases, options.seconds)
            if result.startswith("not ") and (reason := same.get(change.key)):
                result = f"no change of behaviour ({reason})"
            counts[result.partition(" (")[0]] += 1
            print(f"{result}: {change}", flush=True)
    print(summary(counts))


if __name__ == "__main__":
    main()
