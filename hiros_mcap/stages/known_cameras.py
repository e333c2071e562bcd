"""The cameras of a run, as far as they are known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from hiros_mcap.body.rotations import Rigid
from hiros_mcap.skeletons import Floats, Stamps

_WITHIN_ONE_SD = 0.8413  # probability below the mean and one standard deviation


@dataclass(slots=True)
class KnownCameras:
    """Where the cameras stand and how their clocks go, by name; and how well that is known.

    The stages of a run hold it, and read it when they need it. A causal run goes on finding: then
    it replaces ``errors``, and ``clocks`` grow.
    """

    places: Mapping[str, Floats] = field(default_factory=dict)
    """(3,) position in the fixed frame, m."""
    to_given: Mapping[str, Rigid] = field(default_factory=dict)
    """The motion of its people back to the pose that was given, where it was refined."""
    errors: Mapping[str, float] = field(default_factory=dict)
    """Standard error, m, of a pose that the people gave."""
    misplaced: frozenset[str] = frozenset()
    """Whose people are not where the others see them. Whom they alone show is nobody."""
    clocks: Sequence[tuple[int, str, float]] = ()
    """From which stamp on, ns, which camera's clock was ahead of the middle one by how many s. The
    middle one counts as right."""

    def time_variances(self, names: Sequence[str], stamps: Stamps) -> Floats:
        """(N,) Variance, s2, of the common time of the cameras ``names`` at ``stamps`` (N,), ns.

        No stamp tells the right time of clocks that differ. The middle one is as wrong as the
        median of a normal sample, whose variance is pi / 2 of that of the mean. How much clocks
        differ is known from a few of them, so Student's t takes the place of the normal law.
        """
        variances, n = np.zeros(len(stamps)), len(names)
        if not self.clocks or n < 2:
            return variances
        from scipy.special import stdtrit

        quantile = stdtrit(n - 1, _WITHIN_ONE_SD)
        edges = np.searchsorted(stamps, [since for since, *_ in self.clocks]).tolist()
        ahead = dict.fromkeys(names, 0.0)
        for (_, name, seconds), first, end in zip(
            self.clocks, edges, [*edges[1:], len(stamps)], strict=True
        ):
            ahead[name] = seconds
            if first < end:
                spread = np.var([ahead[name] for name in names], ddof=1)
                variances[first:] = quantile**2 * np.pi / 2 * spread / n
        return variances
