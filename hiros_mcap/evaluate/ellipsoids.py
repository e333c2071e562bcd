"""Whether a result's uncertainty is right: how many true joints its ellipsoids hold."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hiros_mcap.evaluate.match import Matches
from hiros_mcap.io.marker_uncertainty import Deviations
from hiros_mcap.skeletons import SkeletonModel

# Quantiles of chi square with three degrees of freedom.
_SQUARE_68, _SQUARE_95 = 3.5059, 7.8147


@dataclass(frozen=True, slots=True)
class EllipsoidCoverage:
    """Shares of the true joints; right are 0.68 and 0.95."""

    joints: int
    """Joints whose uncertainty and truth are known."""
    within_68: float
    """Share inside the ellipsoid that holds 68 % of a normal distribution."""
    within_95: float
    ratio: float
    """Root mean square of error / stated standard deviation, per axis: 1 is right."""

    def __str__(self) -> str:
        return (
            f"68 % ellipsoids hold {100 * self.within_68:.0f} % of the true joints, 95 % "
            f"ellipsoids {100 * self.within_95:.0f} %"
        )


def coverage_of(
    matches: Matches, given: Deviations, model: SkeletonModel
) -> EllipsoidCoverage | None:
    """Compare errors with stated deviations; None if no joint has both."""
    keys = zip(matches.stamps.tolist(), matches.ids.tolist(), strict=True)
    stated = (given.get(key, {}) for key in keys)
    rows = [[one.get(marker, np.nan) for marker in model.marker_ids] for one in stated]
    deviations = np.array(rows).reshape(-1, model.n_markers)
    squares = ((matches.poses - matches.true_poses) ** 2).sum(axis=2) / deviations**2
    squares = squares[np.isfinite(squares)]
    if not len(squares):
        return None
    return EllipsoidCoverage(
        len(squares),
        float((squares < _SQUARE_68).mean()),
        float((squares < _SQUARE_95).mean()),
        float(np.sqrt(squares.mean() / 3)),
    )
