"""docs/troubleshooting.md explains messages that the program prints."""

from __future__ import annotations

import ast
import html
import re
from pathlib import Path

ROOT = Path(__file__).parent.parent
PAGE = ROOT / "docs" / "troubleshooting.md"


def text(node):
    """Return a string with ``...`` for what is not fixed."""
    match node:
        case ast.Constant(value=str(value)):
            return value
        case ast.JoinedStr(values=values):
            return "".join(map(text, values))
    return "..."


def strings_of_the_program():
    """Every string of the library, the command line and the viewer that is no docstring."""
    for path in (
        p for name in ("hiros_mcap", "cli", "viewer") for p in (ROOT / name).rglob("*.py")
    ):
        tree = ast.parse(path.read_text("utf-8"))
        docs = {node.value for node in ast.walk(tree) if isinstance(node, ast.Expr)}
        for node in ast.walk(tree):
            if isinstance(node, ast.Constant | ast.JoinedStr) and node not in docs:
                yield text(node)


def words(string):
    """The words of a string between what is not fixed, a list for each piece."""
    pieces = re.split(r"\.\.\.|\{\w+\}|\d+|[`,;:()]|\. ", string)
    return [piece.strip(" .").split() for piece in pieces]


def in_a_row(pieces, n):
    """All runs of n words of some pieces."""
    return {tuple(p[i : i + n]) for p in pieces for i in range(len(p) - n + 1)}


def test_every_message_of_the_page_is_one_of_the_program():
    rows = re.findall(r"^\| (`.*?`) \| ", PAGE.read_text("utf-8"), flags=re.MULTILINE)
    messages = [html.unescape(m) for row in rows for m in re.findall(r"`([^`]+)`", row)]
    pieces = [piece for string in strings_of_the_program() for piece in words(string)]
    program = set().union(*(in_a_row(pieces, n) for n in (1, 2, 3, 4)))
    assert len(messages) > 100
    runs = {m: in_a_row(words(m), min(4, max(map(len, words(m))))) for m in messages}
    assert [m for m, of_it in runs.items() if not of_it & program] == []
