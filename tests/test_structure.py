"""The shape of the code: layers, sizes, names, circles and the number of parameters."""

from __future__ import annotations

import ast
import re
from collections import Counter
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]
FOLDERS = {
    "hiros_mcap": ROOT,
    "hiros_schemas": ROOT / "schemas",
    "hiros_cli": ROOT / "cli",
    "hiros_viewer": ROOT / "viewer",
}
MODULES = {
    ".".join(path.relative_to(folder).with_suffix("").parts).removesuffix(".__init__"): path
    for name, folder in FOLDERS.items()
    for path in sorted((folder / name).rglob("*.py"))
}
STEPS = {
    name
    for name, p in MODULES.items()
    if p.parts[-3:-2] + p.parts[-1:] == ("stages", "__init__.py")
}
LIBRARY = [name for name in MODULES if name.startswith("hiros_mcap")]
FUNCTIONS = ast.FunctionDef | ast.AsyncFunctionDef


@cache
def tree(name):
    """The syntax tree of a module."""
    return ast.parse(MODULES[name].read_text(encoding="utf-8"))


def parameters(function):
    """Number of parameters, without self and cls."""
    given = [*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs]
    return len([one for one in given if one.arg not in ("self", "cls")])


def imported(parent):
    """Names of modules that are imported, for types as well, wherever the statement stands."""
    for node in ast.iter_child_nodes(parent):
        if not isinstance(node, ast.stmt | ast.ExceptHandler | ast.match_case):
            continue  # no expression imports anything
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                full = f"{node.module}.{alias.name}"
                yield full if full in MODULES else node.module
        else:
            yield from imported(node)


@cache
def imports_of(name):
    """Modules of ours that a module imports."""
    return {other for other in imported(tree(name)) if other in MODULES}


def layer_of(name):
    """The row of the list of layers in which a module belongs."""
    package, *rest = name.split(".")
    if rest[:1] == ["stages"] and ".".join([package, *rest[:2]]) in STEPS:
        return rest[1]
    return rest[0] if rest and package == "hiros_mcap" else package


def layers():
    """The rows of CONTRIBUTING.md, from above."""
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    part = text.partition("## The layers")[2].partition("\n## ")[0]
    rows = re.findall(r"^ {4,}(\S+?)/?  ", part, re.MULTILINE)
    return [row.rpartition("/")[2].removesuffix(".py") for row in rows]


def test_imports_go_down_the_list_of_layers():
    order = {name: k for k, name in enumerate(layers())}
    assert {layer_of(name) for name in MODULES} == set(order)
    upwards = {
        (name, other)
        for name in MODULES
        for other in imports_of(name)
        if order[layer_of(name)] > order[layer_of(other)]
    }
    assert upwards == set()


def test_few_parameters():
    found = {}
    for name in LIBRARY:
        kernels = re.search("@(kernel|entry)", MODULES[name].read_text(encoding="utf-8"))
        most = 10 if kernels else 8
        functions = (node for node in ast.walk(tree(name)) if isinstance(node, FUNCTIONS))
        found |= {f"{name}.{f.name}": n for f in functions if (n := parameters(f)) > most}
    assert found == {}


def test_no_parameter_is_read_by_its_number():
    for name in LIBRARY:
        assert re.findall(r"numbers\[\d+\]", MODULES[name].read_text()) == [], name


def test_no_two_modules_share_a_name():
    names = Counter(name.rpartition(".")[2] for name, p in MODULES.items() if p.stem[:2] != "__")
    assert [name for name, n in names.items() if n > 1] == []


def test_no_two_classes_share_a_name():
    names = Counter(
        node.name
        for name in MODULES
        for node in ast.walk(tree(name))
        if isinstance(node, ast.ClassDef)
    )
    assert [name for name, n in names.items() if n > 1] == []


def test_the_top_of_the_library_is_short():
    public = [path.stem for path in (ROOT / "hiros_mcap").glob("*.py") if path.stem[0] != "_"]
    assert len(public) <= 15, public


def test_no_import_circles():
    done: set[str] = set()

    def visit(name, path):
        assert name not in path, " -> ".join([*path[path.index(name) :], name])
        if name not in done:
            for other in sorted(imports_of(name)):
                visit(other, [*path, name])
            done.add(name)

    for name in MODULES:
        visit(name, [])


def test_references_can_be_looked_up():
    """A requirement's number means nothing to a reader of the repository."""
    text = [*MODULES.values(), *ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")]
    found = {p.name: re.findall(r"\b[HMLX]\d{2}\b", p.read_text(encoding="utf-8")) for p in text}
    assert {name: ids for name, ids in found.items() if ids} == {}
