"""What a suite found, for machines (JSON, JUnit XML) and for a pull request (Markdown)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any
from xml.etree import ElementTree

from hiros_mcap.outputs import JUNIT_MARK, MARKDOWN_MARK
from hiros_mcap.regression.metrics import shown
from hiros_mcap.regression.suite import CaseResult
from hiros_mcap.summary import plain

_SHOWN = ("mpjpe", "id_switches", "limb_cv", "jitter")
_MARKS = {"equal": "✅ equal", "different": "❌ different", "error": "⚠️ error"}


def as_dict(results: Sequence[CaseResult]) -> dict[str, Any]:
    """Plain data for JSON."""
    return {
        "equal": sum(r.status == "equal" for r in results),
        "different": sum(r.status == "different" for r in results),
        "errors": sum(r.status == "error" for r in results),
        "logs": [plain(r) for r in results],
    }


def junit(results: Sequence[CaseResult], name: str) -> str:
    """JUnit XML: a difference is a failure, a log that cannot be processed an error."""
    suite = ElementTree.Element(
        "testsuite",
        name=name,
        tests=str(len(results)),
        failures=str(sum(r.status == "different" for r in results)),
        errors=str(sum(r.status == "error" for r in results)),
        time=f"{sum(r.seconds for r in results):.3f}",
    )
    for result in results:
        case = ElementTree.SubElement(
            suite, "testcase", classname=name, name=result.name, time=f"{result.seconds:.3f}"
        )
        if result.status != "equal":
            kind = "error" if result.status == "error" else "failure"
            fault = ElementTree.SubElement(case, kind, message=_xml_text(result.faults[0]))
            fault.text = _xml_text("\n".join([*result.faults, *first_lines(result)]))
        lines = [f"{k} = {shown(k, v)}" for k, v in result.metrics.items()]
        ElementTree.SubElement(case, "system-out").text = "\n".join([*lines, *result.notes])
    root = ElementTree.Element("testsuites")
    root.append(suite)
    ElementTree.indent(root)
    body = ElementTree.tostring(root, encoding="unicode")
    return f'<?xml version="1.0" encoding="utf-8"?>\n{JUNIT_MARK}\n{body}\n'


def _xml_text(text: str) -> str:
    """Return text without the characters that XML does not allow."""
    return "".join(c if c in "\t\n" or c >= " " else "?" for c in text)


def first_lines(result: CaseResult) -> list[str]:
    """Where each channel begins to differ, one line each."""
    return [
        f"{topic}: first in frame {d.frame}, {d.seconds:.3f} s: {d.what}"
        for topic, d in result.first
    ]


def markdown(results: Sequence[CaseResult], name: str) -> str:
    """Summary for a pull request: a table, and the details of what is not equal folded below."""
    good = sum(r.status == "equal" for r in results)
    lines = [
        f"{MARKDOWN_MARK}{_cell(name)}: {good} of {len(results)} logs as expected",
        "",
        "| log | | " + " | ".join(_SHOWN) + " | what |",
        "|---|---|" + "---:|" * len(_SHOWN) + "---|",
    ]
    for r in results:
        numbers = [shown(m, r.metrics[m]) if m in r.metrics else "" for m in _SHOWN]
        what = r.faults[0] if r.faults else (r.notes[0] if r.notes else "")
        more = f" (and {len(r.faults) - 1} more)" if len(r.faults) > 1 else ""
        row = [_cell(r.name), _MARKS[r.status], *numbers, _cell(what) + more]
        lines.append("| " + " | ".join(row) + " |")
    for r in results:
        if r.faults:
            detail = "\n".join([*r.faults, *first_lines(r)])
            fence = "```" if "```" not in detail else "~~~~"
            lines += ["", f"<details><summary>{_cell(r.name)}</summary>", "", fence, detail, fence]
            lines += ["", "</details>"]
    return "\n".join(lines) + "\n"


def _cell(text: str) -> str:
    """Return text that cannot break out of a table's cell."""
    flat = " ".join(text.split())
    return flat.replace("|", "\\|").replace("<", "&lt;")
