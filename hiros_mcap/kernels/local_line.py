"""Positions and velocities of a tracked skeleton at any instant, from a line through its frames."""

from __future__ import annotations

from typing import NamedTuple

from hiros_mcap.kernels.array_types import F1, F2, F3
from hiros_mcap.kernels.compile import entry, kernel

_LEAST_SPREAD = 1e-4  # (SD of the frames' times / half width)^2 below which they give no velocity


class Lines(NamedTuple):
    """Joints at K instants."""

    positions: F3  # (K, M, 3) m
    velocities: F3  # (K, M, 3) m/s
    weights: F2
    """(K, M) information of the position, in frames of weight 1; 0 where it is not known."""


class Tracklet(NamedTuple):
    """The frames of one person in one camera."""

    seconds: F1  # (T,) times, s, increasing
    positions: F3  # (T, M, 3) m; any number where the weight is 0, but not NaN
    weights: F2  # (T, M) 0 = absent


@kernel
def _fit(
    track: Tracklet, first: int, last: int, m: int, instant: float, half_width: float, lines: Lines
) -> None:
    """Write one joint at ``instant`` into row 0 of ``lines``."""
    s0 = s1 = s2 = 0.0
    x0 = y0 = z0 = x1 = y1 = z1 = 0.0
    for i in range(first, last):
        dt = track.seconds[i] - instant
        w = track.weights[i, m] * (1.0 - (dt / half_width) ** 2)
        s0 += w
        s1 += w * dt
        s2 += w * dt * dt
        x, y, z = track.positions[i, m, 0], track.positions[i, m, 1], track.positions[i, m, 2]
        x0, y0, z0 = x0 + w * x, y0 + w * y, z0 + w * z
        x1, y1, z1 = x1 + w * dt * x, y1 + w * dt * y, z1 + w * dt * z
    determinant = s0 * s2 - s1 * s1
    positions, velocities = lines.positions[0, m], lines.velocities[0, m]
    if determinant <= _LEAST_SPREAD * half_width * half_width * s0 * s0:
        lines.weights[0, m] = 0.0
        positions[:] = 0.0
        velocities[:] = 0.0
        return
    lines.weights[0, m] = determinant / s2
    share = 1.0 / determinant
    positions[0] = (s2 * x0 - s1 * x1) * share
    positions[1] = (s2 * y0 - s1 * y1) * share
    positions[2] = (s2 * z0 - s1 * z1) * share
    velocities[0] = (s0 * x1 - s1 * x0) * share
    velocities[1] = (s0 * y1 - s1 * y0) * share
    velocities[2] = (s0 * z1 - s1 * z0) * share


@entry
def fit_lines(track: Tracklet, instants: F1, half_width: float, lines: Lines) -> None:
    """Fit a line in time to every joint about every instant, by weighted least squares.

    A frame counts with its weight times ``1 - (dt / half_width)^2``. The weight of the result is
    the information of the line at the instant: an extrapolated position counts little.

    Parameters
    ----------
    instants : (K,) s, increasing. half_width : s.
    """
    first = 0
    for k in range(len(instants)):
        while first < len(track.seconds) and track.seconds[first] <= instants[k] - half_width:
            first += 1
        last = first
        while last < len(track.seconds) and track.seconds[last] < instants[k] + half_width:
            last += 1
        row = Lines(
            lines.positions[k : k + 1], lines.velocities[k : k + 1], lines.weights[k : k + 1]
        )
        for m in range(track.weights.shape[1]):
            _fit(track, first, last, m, instants[k], half_width, row)
