"""The base of every stage's parameters."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict


class Params(BaseModel):
    """Immutable, validated parameters of one stage; each field carries its documentation.

    A subclass gives every field a default that works on an unknown log, its unit and the source
    of the number (a paper's section, or what was measured) in ``Field(description=...)``.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=True)
