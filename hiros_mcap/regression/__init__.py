"""Golden logs: does hiros still give what it gave, and is it still good enough."""

from __future__ import annotations

from hiros_mcap.regression.differences import (
    ChannelComparison,
    Comparison,
    Difference,
    compare_logs,
)
from hiros_mcap.regression.tolerances import Tolerances, load_tolerances

__all__ = [
    "ChannelComparison",
    "Comparison",
    "Difference",
    "Tolerances",
    "compare_logs",
    "load_tolerances",
]
