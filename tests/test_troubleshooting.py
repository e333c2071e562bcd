"""docs/troubleshooting.md explains every error, warning and note of the program."""

from __future__ import annotations

import ast
import html
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PAGE = ROOT / "docs" / "troubleshooting.md"

ERRORS = {"LogError", "ConfigError", "HirosError", "MemoryError"}
NOTES = (
    "hiros_mcap/running/report.py",
    "hiros_mcap/running/clock_alignment.py",
    "hiros_mcap/running/pose_alignment.py",
    "hiros_mcap/running/shared_frames.py",
    "hiros_mcap/calibrate/survey.py",
    "hiros_mcap/calibrate/given_poses.py",
    "hiros_mcap/calibrate/moved_cameras.py",
    "hiros_mcap/running/observe.py",
    "hiros_mcap/evaluate/remarks.py",
    "hiros_mcap/evaluate/match.py",
    "hiros_mcap/io/camera_clock.py",
    "hiros_mcap/io/log_times.py",
    "hiros_mcap/io/live_log_times.py",
    "hiros_mcap/events.py",
    "hiros_mcap/io/log_accounts.py",
)
"""Modules that say something only as a warning or a note."""
NO_MESSAGE = {
    "filter: time not increasing",  # the keys of what is counted, not what a user reads
    "predict: time not increasing",
    "... ms per s",  # the size of a drift, in messages that the page has
}


def text(node):
    """Return a string with ``...`` for what is not fixed."""
    match node:
        case ast.Constant(value=str(value)):
            return value
        case ast.JoinedStr(values=values):
            return "".join(map(text, values))
    return "..."


def errors(tree):
    """Yield the text of every error that is made with a literal."""
    for node in ast.walk(tree):
        match node:
            case ast.Call(func=ast.Name(id=name), args=[message, *_]) if name in ERRORS:
                yield text(message)


def notes(tree):
    """Yield every string of some words that is neither a docstring nor a part of another."""
    strings = [n for n in ast.walk(tree) if isinstance(n, ast.Constant | ast.JoinedStr)]
    inside = {part for n in strings if isinstance(n, ast.JoinedStr) for part in n.values}
    docs = {n.value for n in ast.walk(tree) if isinstance(n, ast.Expr)}
    for node in strings:
        if node not in inside | docs and (found := text(node)) not in NO_MESSAGE:
            yield from [found] if found.count(" ") > 2 else []


def fixed_part(message):
    """Return the first words of a message that are always the same, three to six if it can."""
    parts = [part.strip(" :,.()") for part in re.split(r"\.\.\.|\{\w+\}|[`;]|\. ", message)]
    part = next((part for part in parts if part.count(" ") > 1), max(parts, key=len))
    return " ".join(part.split(" ")[:6]).rstrip(" :,.()")


def sources():
    folders = (ROOT / name for name in ("hiros_mcap", "cli", "viewer"))
    return sorted(path for folder in folders for path in folder.rglob("*.py"))


@pytest.fixture(scope="module")
def messages():
    """Errors and notes by source."""
    found = {}
    for path in sources():
        name, tree = path.relative_to(ROOT).as_posix(), ast.parse(path.read_text(encoding="utf-8"))
        found[name] = [*errors(tree), *(notes(tree) if name in NOTES else ())]
    return found


def test_the_page_has_every_message(messages):
    page = html.unescape(PAGE.read_text(encoding="utf-8"))
    parts = [(name, fixed_part(text)) for name, texts in messages.items() for text in texts]
    assert [(name, part) for name, part in parts if part.count(" ") and part not in page] == []


def test_messages_are_found(messages):
    assert messages.keys() >= set(NOTES)
    assert sum(len(texts) for name, texts in messages.items() if name not in NOTES) > 150
