"""How good a result is: against the truth, or with nothing but the log itself."""

from __future__ import annotations

from hiros_mcap.evaluate.match import MATCH_DISTANCE
from hiros_mcap.evaluate.scores import PCK_MM, Scores, evaluate
from hiros_mcap.evaluate.statistics import AngleStats, ErrorStats
from hiros_mcap.evaluate.truth import Truth
from hiros_mcap.evaluate.truth_files import load_truth

__all__ = [
    "MATCH_DISTANCE", "PCK_MM", "AngleStats", "ErrorStats", "Scores", "Truth", "evaluate",
    "load_truth",
]  # fmt: skip
