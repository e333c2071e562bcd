"""How well the joints of a result are known: ellipsoids that hold the true joint with 68 %."""

from __future__ import annotations

from pathlib import Path
from typing import Self

import numpy as np

from hiros_mcap.errors import ConfigError
from hiros_mcap.io.marker_uncertainty import UNCERTAIN_TOPIC, Deviations, read_uncertainty
from hiros_mcap.skeletons import Floats, SkeletonModel, Stamps

UNCERTAIN_STAGE = UNCERTAIN_TOPIC.rsplit("/", 1)[-1]
"""The stage whose joints are told of."""
HALF_SIZE = 3.5059**0.5
"""Half axis in standard deviations: 68 % quantile of chi square with three degrees of freedom."""


class Uncertainties:
    """Standard deviations of everybody's markers over time.

    Parameters
    ----------
    deviations : what a result says. model : of its skeletons.
    """

    def __init__(self, deviations: Deviations, model: SkeletonModel) -> None:
        stamps: dict[int, list[int]] = {}
        for stamp, person in sorted(deviations):
            stamps.setdefault(person, []).append(stamp)
        self._stamps = {person: np.array(times, np.int64) for person, times in stamps.items()}
        self._deviations = {
            person: np.array(
                [[deviations[t, person].get(i, np.nan) for i in model.marker_ids] for t in times]
            )
            for person, times in stamps.items()
        }

    @classmethod
    def of_result(cls, path: Path, model: SkeletonModel) -> Self:
        """Read what a result says; raises ConfigError if it says nothing, LogError if damaged."""
        if not (deviations := read_uncertainty(path)):
            raise ConfigError(
                f"{path}: does not say how well its markers are known; results of `hiros process "
                "--system fuse` do"
            )
        return cls(deviations, model)

    def at(self, person: int, stamps: Stamps) -> Floats:
        """(T, M) standard deviations along each axis, m, at some times; NaN = unknown."""
        if person not in self._stamps:
            return np.full((len(stamps), 1), np.nan)
        times, deviations = self._stamps[person], self._deviations[person]
        rows = np.minimum(np.searchsorted(times, stamps), len(times) - 1)
        return np.where((times[rows] == stamps)[:, None], deviations[rows], np.nan)
