"""Which way is up in the fixed frame."""

from __future__ import annotations

import numpy as np

from hiros_mcap.skeletons import Floats, Ints, People, Stamps

_UPRIGHT = 100  # people who show which way is up
_TILTED = 0.8  # cosine of the angle between their trunks and z, below which z does not point up


class Vertical:
    """Which way is up: z, unless people stand otherwise."""

    def __init__(self, trunk: Ints) -> None:
        """Take (T, 2) slots of hips and of the shoulders above them."""
        self._trunk, self._sum, self._people = trunk, np.zeros(3), 0
        self.last = _horizontal(self._sum)
        """(2, 3) axes of the horizontal plane."""

    def axes(self, people: People, rows: Stamps) -> Floats:
        """(2, 3) axes of the horizontal plane; a positive turn leads from the first to the second.

        The first people decide on them, by the lines from their hips to their shoulders.
        """
        if self._people < _UPRIGHT and len(rows) and len(self._trunk):
            rows = rows[: _UPRIGHT - self._people]
            hips, shoulders = (people.markers[rows[:, None], ends, :3] for ends in self._trunk.T)
            trunks = (shoulders - hips).mean(axis=1)
            trunks = trunks[~np.isnan(trunks).any(axis=1)]
            self._people += len(trunks)
            self._sum += trunks.sum(axis=0)
            self.last = _horizontal(self._sum)
        return self.last


def _horizontal(up: Floats) -> Floats:
    """(2, 3) Axes of the plane to which ``up`` is normal; x and y if it is about z."""
    length = float(np.linalg.norm(up))
    if not up[2] < _TILTED * length:
        return np.eye(3)[:2]
    up = up / length
    x = np.eye(3)[np.abs(up).argmin()]
    x = x - (x @ up) * up
    x = x / np.linalg.norm(x)
    return np.stack([x, np.cross(up, x)])
