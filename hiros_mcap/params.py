"""The base of every stage's parameters, and what is wrong with them in one line."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator
from pydantic.fields import FieldInfo

_UNKNOWN = "extra_forbidden"
_PLAIN = {_UNKNOWN: "there is no such key", "missing": "is missing"}


Seconds = Annotated[float, Field(ge=0, le=86_400)]
"""A time that a stage waits or remembers, s. A day stands for "for ever": no recording is as long,
and it fits into the nanoseconds of stamps."""
Metres = Annotated[float, Field(ge=0, le=10)]
"""A standard deviation of positions, m. With 10 m a measurement says nothing within a room."""
Accelerations = Annotated[float, Field(ge=1e-6, le=1e5)]
"""How strongly people accelerate, in m/s2 or m2/s3. A throwing hand has 1000 m/s2."""
_LARGEST = 1e9  # no number of any parameter is larger, unless it is infinite
_LARGEST_INTEGER = 1 << 53


class Params(BaseModel):
    """Immutable, validated parameters of one stage; each field carries its documentation.

    A subclass gives every field a default that works on an unknown log, its unit and the source
    of the number (a paper's section, or what was measured) in ``Field(description=...)``, and marks
    what only an expert changes with :func:`advanced` in place of ``Field``, what only systems and
    presets change with :func:`fixed`. A number that nobody changes is a ClassVar.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=True)

    @field_validator("*")
    @classmethod
    def _is_in_range(cls, value: object) -> object:
        if isinstance(value, float | int) and value != math.inf:
            largest = _LARGEST if isinstance(value, float) else _LARGEST_INTEGER
            if not -largest <= value <= largest:
                raise ValueError(f"should be a number of at most {largest:g}")
        return value


def advanced(default: Any, **options: Any) -> Any:
    """Return a Field that ``hiros config`` shows only with ``--all``."""
    return Field(default, json_schema_extra={"advanced": True}, **options)


def fixed(default: Any, description: str) -> Any:
    """Return a Field that only systems, presets and Python set, not the users of a run."""
    return Field(default, description=description, json_schema_extra={"fixed": True})


def is_fixed(field: FieldInfo) -> bool:
    """Whether a field was made by :func:`fixed`."""
    return isinstance(field.json_schema_extra, dict) and "fixed" in field.json_schema_extra


def is_advanced(field: FieldInfo) -> bool:
    """Whether a field was made by :func:`advanced`."""
    return isinstance(field.json_schema_extra, dict) and "advanced" in field.json_schema_extra


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
