"""Instants at which a result should hold a frame and holds none: they miss everybody.

A result has its own rhythm, which need not be that of the truth: motion capture at 100 Hz beside a
result of 30 Hz is not silence. So the truth is sampled at the frames of the result, and silence is
filled with instants at the result's rhythm: between frames, before the first, and after the last.
"""

from __future__ import annotations

import numpy as np

from hiros_mcap.evaluate.truth import Truth
from hiros_mcap.skeletons import Stamps

SHORTEST_NS = 50_000_000
"""A step between frames that is not longer is never silence."""
_IRREGULAR_NS = 100_000_000
"""Cameras that take turns make steps of many lengths, up to this one; longer steps are gaps."""
_SLACK = 1.5
"""Silence is longer than this many usual steps, so that one lost frame counts."""
_ENDS_NS = 100_000_000
"""Cameras and truth do not start and stop together: shorter silence at the ends does not count."""


def silent_instants(stamps: Stamps, truth: Truth) -> Stamps:
    """(S,) Times, ns, of the truth's span at which a result is silent; increasing.

    ``stamps`` are the times of all frames of the result, ns, in any order, also of frames without
    people. The rhythm is the mean step outside silence; a result of less than two different times
    has the rhythm of the truth.
    """
    stamps = np.unique(stamps)
    steps = np.diff(stamps if stamps.size > 1 else truth.stamps)
    if not steps.size:
        return np.zeros(0, np.int64)
    longest = max(_SLACK * _usual(steps), SHORTEST_NS)
    step = float(np.mean(steps[steps <= longest]))
    first, last = truth.stamps[[0, -1]]
    inside = stamps[(stamps >= first) & (stamps <= last)]
    # The span of the truth is closed: with a frame one step before and one after it, its first and
    # last instants are filled as those between two frames.
    ends = np.concatenate([[first - step], inside, [last + step]])
    gaps = [
        np.arange(ends[k] + step, ends[k + 1] - step / 2, step)
        for k, length in enumerate(np.diff(ends))
        if length > (longest if 0 < k < len(ends) - 2 else max(longest, _ENDS_NS + step))
    ]
    instants = np.concatenate([np.zeros(0), *gaps]).astype(np.int64)
    return np.asarray(instants[truth.covers(instants)])


def _usual(steps: Stamps) -> float:
    """Longest step that belongs to the rhythm, ns: 90 % are not longer, or the median of them."""
    most = float(np.percentile(steps, 90))
    return most if most <= _IRREGULAR_NS else float(np.median(steps))
