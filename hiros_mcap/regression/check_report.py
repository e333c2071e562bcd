"""Reports of a suite, for machines (JSON, JUnit XML) and for a pull request (Markdown)."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from typing import Any
from xml.etree import ElementTree

from hiros_mcap.evaluate.measures import BRIEF, MEASURES, markdown_text
from hiros_mcap.outputs import JUNIT_MARK, MARKDOWN_MARK
from hiros_mcap.regression.suite import CaseResult, Status
from hiros_mcap.wording import plain

_MARKS: dict[Status, str] = {"equal": "✅ equal", "different": "❌ different", "error": "⚠️ error"}


def totals(results: Sequence[CaseResult]) -> str:
    """Return how many logs are as expected, in one line."""
    counts = Counter(result.status for result in results)
    seconds = sum(result.seconds for result in results)
    return (
        f"{counts['equal']} of {len(results)} logs as expected, {counts['different']} different, "
        f"{counts['error']} failed, {seconds:.1f} s"
    )


def as_dict(results: Sequence[CaseResult]) -> dict[str, Any]:
    """Return plain data for JSON."""
    counts = Counter(r.status for r in results)
    equal, different, errors = (counts[status] for status in _MARKS)
    logs = [plain(r) for r in results]
    return {"equal": equal, "different": different, "errors": errors, "logs": logs}


def lines(result: CaseResult) -> list[str]:
    """Return what is wrong with a log: its error, the differences, the first frame that differs."""
    begin = [
        f"{topic}: first in frame {d.frame}, {d.seconds:.3f} s: {d.what}"
        for topic, d in result.first
    ]
    return [*([result.error] if result.error else []), *map(str, result.differences), *begin]


def junit(results: Sequence[CaseResult], name: str) -> str:
    """Return JUnit XML: a difference is a failure, a log that cannot be processed is an error."""
    counts, title = Counter(r.status for r in results), _xml_text(name)
    root = ElementTree.Element("testsuites")
    suite = ElementTree.SubElement(
        root,
        "testsuite",
        name=title,
        tests=str(len(results)),
        failures=str(counts["different"]),
        errors=str(counts["error"]),
        time=f"{sum(r.seconds for r in results):.3f}",
    )
    for r in results:
        case = ElementTree.SubElement(
            suite, "testcase", classname=title, name=_xml_text(r.name), time=f"{r.seconds:.3f}"
        )
        if r.status != "equal":
            kind = "error" if r.status == "error" else "failure"
            faults = lines(r)
            fault = ElementTree.SubElement(case, kind, message=_xml_text(faults[0]))
            fault.text = _xml_text("\n".join(faults))
        metrics = [f"{m} = {MEASURES[m].shown(value)}" for m, value in r.metrics.items()]
        ElementTree.SubElement(case, "system-out").text = _xml_text("\n".join([*metrics, *r.notes]))
    ElementTree.indent(root)
    body = ElementTree.tostring(root, encoding="unicode")
    return f'<?xml version="1.0" encoding="utf-8"?>\n{JUNIT_MARK}\n{body}\n'


def _xml_text(text: str) -> str:
    """Return text without the characters that XML does not allow."""
    return re.sub("[^\t\n -\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]", "?", text)


def markdown(results: Sequence[CaseResult], name: str) -> str:
    """Return a summary for a pull request: a table of the logs, then the differences of each."""
    # A metric that no log has would be an empty column.
    measures = [m for m in BRIEF if any(m in r.metrics for r in results)]
    rows = [
        (
            r.name,
            _MARKS[r.status],
            *(MEASURES[m].shown(r.metrics[m]) if m in r.metrics else "-" for m in measures),
        )
        for r in results
    ]
    text = [f"{MARKDOWN_MARK}{markdown_text(name)}: {totals(results)}", ""]
    text += _table(("log", "result", *measures), rows)
    for r in results:
        text += _details(r)
    return "\n".join(text) + "\n"


def _details(r: CaseResult) -> list[str]:
    if r.status == "equal":
        return []
    text = ["", f"**{markdown_text(r.name)}**", ""]
    if r.error:
        text += [markdown_text(r.error), ""]
    if r.differences:
        rows = [(d.where, d.what, d.was, d.now) for d in r.differences]
        text += [*_table(("where", "what", "was", "is"), rows), ""]
        detail = "\n".join([*lines(r), *r.notes])
        fence = "`" * (1 + max(map(len, re.findall("`+", f"``{detail}"))))  # longer than any in it
        text += ["<details><summary>details</summary>", "", fence, detail, fence, "", "</details>"]
    return text


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    ruled = ["| " + " | ".join(header) + " |", "|---" * len(header) + "|"]
    return ruled + ["| " + " | ".join(map(markdown_text, row)) + " |" for row in rows]
