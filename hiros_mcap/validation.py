"""pydantic's complaints in one line."""

from __future__ import annotations

from collections.abc import Mapping

from pydantic import BaseModel, ValidationError

_UNKNOWN = "extra_forbidden"
_PLAIN = {_UNKNOWN: "there is no such key", "missing": "is missing"}


def explain(error: ValidationError) -> tuple[list[str], str]:
    """Return where the first fault is (names from the outside in) and what is wrong there."""
    faults = error.errors(include_url=False)
    # A name that does not exist comes first: another one may be missing only because of it.
    fault = next((f for f in faults if f["type"] == _UNKNOWN), faults[0])
    where = [str(part) for part in fault["loc"]]
    if fault["type"] in _PLAIN:
        return where, _PLAIN[fault["type"]]
    message = fault["msg"].replace("Input should", "should").replace("Value error, ", "")
    given = fault["input"]
    return where, message if isinstance(given, Mapping | BaseModel) else f"{message}, is {given!r}"
