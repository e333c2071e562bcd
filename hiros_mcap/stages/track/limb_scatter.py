"""How much the measured limb lengths of one person vary from second to second.

A detector misplaces a marker for as long as somebody faces the same way. So the mean length over a
second differs from that over another one by more than the noise of single detections explains. And
limbs vary together: Kinect's trunk is one piece; a knee that lies too high shortens the thigh and
lengthens the shank. The scatter of everybody's seconds about their own mean is pooled, together
with some seconds of a usual detector.
"""

from __future__ import annotations

from collections.abc import Container
from dataclasses import dataclass

import numpy as np

from hiros_mcap.skeletons import Floats, Ints

SECOND = 1_000_000_000  # ns from one look at a person to the next
_FEWEST = 8.0  # detections that make the mean of a second
_USUAL = 0.02  # SD of a limb's length over seconds, m: simulated 10 to 18 mm, Kinect v2's 5 to 25
_USUAL_SECONDS = 20.0  # for which the usual detector counts
_SHORTEST = 0.02  # m: shorter limbs are of no use, but have logarithms


@dataclass(slots=True, eq=False)
class _Seconds:
    """What the limbs of a person were, second by second."""

    lengths: Floats  # (L,) mean length up to the last look, m
    counts: Floats  # (L,) detections that it is of
    means: Floats  # (L,) mean of the logarithms over the seconds
    seconds: Floats  # (L,) that had enough detections


class LimbScatter:
    """Learns the scatter of the limb lengths of all who are tracked.

    Parameters
    ----------
    mirror : (L,) the limb on the other side of each whose length is learned.
    """

    def __init__(self, mirror: Ints) -> None:
        n_limbs = len(mirror)
        self.alike = np.eye(n_limbs)
        """(L, L) 1 for a limb with itself and with the one on the other side, else 0."""
        self.alike[np.arange(n_limbs), mirror] = 1.0
        self._people: dict[int, _Seconds] = {}
        self._squares = np.zeros((n_limbs, n_limbs))
        self._freedom = np.zeros(n_limbs)

    def learn(self, person: int, lengths: Floats, counts: Floats) -> None:
        """Take the mean lengths (L,), m, of a person so far, of (L,) detections, once a second."""
        lengths = np.maximum(lengths, _SHORTEST)
        if person not in self._people:
            nothing = np.zeros((2, len(lengths)))
            self._people[person] = _Seconds(lengths, counts.copy(), *nothing)
            return
        past = self._people[person]
        new = counts - past.counts
        enough = new >= _FEWEST
        length = (counts * lengths - past.counts * past.lengths) / np.maximum(new, 1.0)
        off = np.where(enough, np.log(np.maximum(length, _SHORTEST)) - past.means, 0.0)
        past.lengths, past.counts = lengths, counts.copy()
        past.seconds += enough
        n = np.maximum(past.seconds, 1.0)
        past.means += off / n
        off *= np.sqrt(1.0 - 1.0 / n)  # Welford (1962)
        self._squares += np.outer(off, off)
        self._freedom += enough & (n > 1)

    def keep(self, people: Container[int]) -> None:
        """Forget the seconds of everybody else."""
        self._people = {number: past for number, past in self._people.items() if number in people}

    def covariance(self, lengths: Floats) -> Floats:
        """(L, L) covariance of the logarithms, for limbs of these lengths, m."""
        usual = np.diag((_USUAL / np.maximum(lengths, _SHORTEST)) ** 2)
        root = np.sqrt(_USUAL_SECONDS + self._freedom)
        return np.asarray((_USUAL_SECONDS * usual + self._squares) / np.outer(root, root))
