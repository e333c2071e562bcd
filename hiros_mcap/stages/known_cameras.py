"""The cameras of a run, as far as they are known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from hiros_mcap.body.rotations import Rigid
from hiros_mcap.skeletons import Floats

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

    def time_variance(self, names: Sequence[str], stamp: int) -> float:
        """Return the variance, s2, of the common time of the cameras ``names`` at ``stamp``, ns.

        No stamp tells the right time of clocks that differ. The middle one is as wrong as the
        median of a normal sample, whose variance is pi / 2 of that of the mean. How much clocks
        differ is known from a few of them, so Student's t takes the place of the normal law.
        """
        if not self.clocks or len(names) < 2:
            return 0.0
        from scipy.special import stdtrit

        found = {name: seconds for since, name, seconds in self.clocks if since <= stamp}
        ahead, n = [found.get(name, 0.0) for name in names], len(names)
        quantile = stdtrit(n - 1, _WITHIN_ONE_SD)
        return float(quantile**2 * np.pi / 2 * np.var(ahead, ddof=1) / n)
