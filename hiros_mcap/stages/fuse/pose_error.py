"""How wrong the cameras' poses are: a part of the error that all markers of a person share.

A pose is assumed to be as wrong as poses usually are. The cameras then show how wrong: if poses
are wrong, cameras see a person at different places. The variance that is assumed, times

    (3 + n a) / (3 + n),   n = 3 (cameras - 1),

is the estimate, where a is the variance that is observed over that assumed: the median over people
and time, as a detector that finds somebody again, or a confused identity, is off for a moment. So
the assumption counts as much as the three coordinates of one more camera (scaled inverse chi
square, Gelman et al. 2013, section 2.6). Views of displaced cameras (displaced_views.py) have no
weight in the result, so they are not compared.

Cameras whose poses were refined agree, as far as the standard errors of these poses say. They share
the placement of the rig (:func:`hiros_mcap.calibrate.gauge.placement_error`), which nobody sees.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np

from hiros_mcap.calibrate.gauge import PlacementError, placement_error
from hiros_mcap.frames import places_of
from hiros_mcap.skeletons import Floats, Stamps
from hiros_mcap.stages.fuse.fusing import REFERENCE, Sightings
from hiros_mcap.stages.known_cameras import KnownCameras

_AXES = 3
_RENEWED = 500_000_000  # ns; poses stay as they are, so each instant need not be looked at
_MOST = 25.0
"""Observed over assumed variance of a person in a window. A larger one is a confused identity."""
_REMEMBERED = 1000  # persons in windows
_PIECE = 1 << 17  # markers that are looked at together: all at once would take much memory


class PoseError:
    """The variance that the cameras' poses add to a result."""

    def __init__(self, angle: float, shift: float, known: KnownCameras) -> None:
        """Take what is assumed.

        Parameters
        ----------
        angle, shift : standard deviation of orientations, rad, and of positions along each axis, m.
        known : of the cameras; those with a ``to_given`` have refined poses.
        """
        self._angle, self._shift, self._known = angle, shift, known
        self._right = angle <= 0 and shift <= 0
        self._placement: PlacementError | None = None
        if angle > 0 and shift > 0 and known.to_given:
            self._placement = placement_error(known.places, known.to_given, angle, shift)
        self._observed = deque[float](maxlen=_REMEMBERED)  # observed over assumed variances
        self._most = 0
        self.ratio = 1.0  # estimated over assumed variance
        self._learned: int | None = None

    def is_due(self, now: int) -> bool:
        """Whether it is time, ns, to look at the cameras again."""
        if self._right:
            return False
        return self._learned is None or now - self._learned >= _RENEWED

    def learn(self, views: Sightings, offsets: Floats) -> None:
        """Compare the places at which cameras see a person.

        Parameters
        ----------
        offsets : (N, 3) of the views against the results, m; NaN = none.
        """
        if not len(views.stamps):
            return
        self._learned = int(views.stamps.max())
        compared = ~np.isnan(offsets[:, 0])
        # One number per person and camera: sorting pairs takes longer than all that follows.
        n = int(views.cameras.max()) + 1
        keys = views.people[compared] * n + views.cameras[compared]
        keys, groups = np.unique(keys, return_inverse=True)
        people, sizes = keys // n, np.bincount(groups)
        away, *means = (
            np.bincount(groups, values) / sizes
            for values in (views.distances[compared], *offsets[compared].T)
        )
        scaled = np.stack(means, axis=1) / np.sqrt(self._assumed(1, away**2))[:, None]
        for person in np.unique(people).tolist():
            self._count(scaled[people == person])
        if self._observed:
            middle = float(np.median(self._observed))
            self.ratio = (_AXES + self._most * middle) / (_AXES + self._most)

    def _count(self, scaled: Floats) -> None:
        """Add how far the cameras' places (C, 3), in standard deviations, are from each other."""
        free = _AXES * (len(scaled) - 1)
        if free > 0:
            square = float(((scaled - scaled.mean(axis=0)) ** 2).sum())
            # Over the median of a chi-square distribution (Wilson and Hilferty 1931).
            self._observed.append(min(square / (free * (1 - 2 / (9 * free)) ** 3), _MOST))
            self._most = max(self._most, free)

    def _assumed(self, cameras: Floats | float, squares: Floats) -> Floats:
        """(...) Assumed variances along each axis, m2, in all.

        Of so many ``cameras`` (...), ``squares`` (...) are the sums of their squared distances, m2.
        """
        # A rotation moves what it sees across two of three axes.
        return np.asarray(cameras * self._shift**2 + 2 / 3 * self._angle**2 * squares)

    def variances(
        self, positions: Floats, seen: Stamps, names: Sequence[str], ratios: Floats
    ) -> Floats:
        """(K, M) Variance along each axis, m2, of results (K, M, 3), m, from the cameras ``seen``.

        ``seen`` (K, M) has a bit for each camera, ``ratios`` (K,) are as :attr:`ratio` was at each
        result. The mean of n cameras has the variance

            (r sum a + sum e^2 / 3 + k^2 s) / n^2,

        where a is assumed of each pose that is as given, r is the ratio, e the standard error
        of each refined pose, and s the variance of the placement of the k cameras with such poses.
        """
        places = places_of(names, self._known.places)
        is_placed = ~np.isnan(places[:, 0])
        squares = np.where(is_placed, (places**2).sum(axis=1), REFERENCE**2)
        errors = np.array([self._known.errors.get(name, 0.0) for name in names])
        is_refined = np.array(
            [self._placement is not None and name in self._known.to_given for name in names]
        )
        given = np.where(is_refined, 0.0, self._assumed(1, squares))
        near = ~is_refined & is_placed
        # What is summed over the cameras that see a marker. |x - p|^2 = |x|^2 - 2 x p + |p|^2.
        of_camera = np.column_stack(
            [
                np.ones(len(names)), is_refined, np.where(is_refined, errors**2 / _AXES, 0.0),
                given, near, np.where(near, places.T, 0.0).T,
            ]
        )  # fmt: skip
        markers, bits = positions.reshape(-1, _AXES), seen.ravel()
        ratios = np.repeat(ratios, seen.shape[1])
        out = np.empty(len(bits))
        for first in range(0, len(out), _PIECE):
            rows = slice(first, first + _PIECE)
            sees = (bits[rows, None] >> np.arange(len(names))) & 1
            n, refined, total, given, n_near, *towards = (sees @ of_camera).T
            x = np.where(np.isnan(markers[rows]), 0.0, markers[rows]).T
            nearer = n_near * (x**2).sum(axis=0) - 2 * (x * towards).sum(axis=0)
            total = total + ratios[rows] * (given + self._assumed(0, nearer))
            if self._placement is not None:
                total += refined**2 * self._placement.variances(markers[rows])
            out[rows] = total / np.maximum(n, 1) ** 2
        return out.reshape(seen.shape)
