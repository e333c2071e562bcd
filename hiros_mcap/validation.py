"""pydantic's complaints in one line."""

from __future__ import annotations

from collections.abc import Mapping

from pydantic import BaseModel, ValidationError


def explain(error: ValidationError) -> tuple[list[str], str]:
    """Return where the first fault is (names from the outside in) and what is wrong there."""
    fault = error.errors(include_url=False)[0]
    where = [str(part) for part in fault["loc"]]
    message = fault["msg"].replace("Input should", "should").replace("Value error, ", "")
    given = fault["input"]
    return where, message if isinstance(given, Mapping | BaseModel) else f"{message}, is {given!r}"
