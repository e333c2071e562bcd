"""The published systems, each a table of stages."""

from __future__ import annotations

from collections.abc import Callable

from hiros_mcap.systems.hiros import hiros
from hiros_mcap.systems.run import Run, Stages

SYSTEMS: dict[str, Callable[[Run], Stages]] = {"hiros": hiros}

__all__ = ["SYSTEMS", "Run", "Stages", "hiros"]
