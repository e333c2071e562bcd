"""Options of an export, and the warnings about its gaps."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from hiros_mcap.skeletons import Flags, Floats


def warn_in_python(text: str) -> None:
    """Show a warning as Python shows its own, also without logging."""
    warnings.warn(text, stacklevel=2)


class Choices(NamedTuple):
    """Options of a writer, besides the result and the file."""

    parts: tuple[str, ...]  # "joints", "angles"
    warn: Callable[[str], object] = warn_in_python  # is called with what the file lacks


_MOST_PAUSES = 3


def pauses(times: Floats, absent: Flags) -> str:
    """Name the gaps of (T,) instants, s: all if they are few, else the longest.

    >>> pauses(np.arange(6.0), np.array([0, 1, 1, 0, 0, 1], bool))
    '2 gaps, 3.0 s in all: 0.0 to 3.0 s, 4.0 to 5.0 s'
    """
    edges = np.flatnonzero(np.diff(np.concatenate([[False], absent, [False]]).astype(np.int8)))
    last = len(times) - 1
    gaps = [(times[max(a - 1, 0)], times[min(b, last)]) for a, b in edges.reshape(-1, 2)]
    if not gaps:
        return ""
    longest = sorted(gaps, key=lambda gap: gap[0] - gap[1])[:_MOST_PAUSES]
    spans = ", ".join(f"{start:.1f} to {end:.1f} s" for start, end in sorted(longest))
    if len(gaps) == 1:
        return f"{spans}"
    whole = sum(end - start for start, end in gaps)
    which = "the longest: " if len(gaps) > _MOST_PAUSES else ""
    return f"{len(gaps)} gaps, {whole:.1f} s in all: {which}{spans}"
