"""Kernels that carry axes along with a person's body, whatever its posture.

Two axes lie across the trunk, the third along it, from the hips to the shoulders. In a view without
hips it points from the lower spine to the neck, or from there to the head. They turn with the
trunk the shortest way: whoever lies down, rolls or gets up keeps front and back in them. They also
turn with the line through shoulders and hips, modulo half a turn, so that whoever spins keeps front
and back, too. Neither needs to know which way is up, nor which side is left.
"""

from __future__ import annotations

import math

import numpy as np

from hiros_mcap.body.forward_cues import FacingMarkers
from hiros_mcap.kernels.compile import inlined, kernel
from hiros_mcap.kernels.points import norm3, step_between
from hiros_mcap.skeletons import Floats, Ints

PATIENCE = 1.0  # s without sight of the trunk after which its direction is not known any more
_MEMORY = 0.05  # s: a trunk turns by 20 degrees in it when somebody falls or rolls
_LEAST_SHARE = 0.3  # of each view in the mean: about six views err by less than one
_AGREEING = 0.5  # length of the mean of unit vectors below which they contradict each other
_LINE_SHARE = 0.5  # of each view's line: 600 degrees/s stay within 45 degrees at 30 views/s
_RATE_MEMORY = 0.1  # s: two cameras whose lines differ by 40 degrees make 60 degrees/s of it
_SLOW, _FAST = math.radians(240.0), math.radians(480.0)
"""rad/s: a turn that the model of the facing follows itself (8 degrees a cell); one too fast."""
_SHORTEST = 0.05  # m, of a trunk


@inlined
def ramp(x: float, low: float, high: float) -> float:
    """0 up to ``low``, 1 from ``high`` on, a line between."""
    return min(max((x - low) / (high - low), 0.0), 1.0)


@inlined
def component(x: float, y: float, z: float, axes: Floats, k: int) -> float:
    """Component of a vector along one of the axes."""
    return axes[k, 0] * x + axes[k, 1] * y + axes[k, 2] * z


@kernel
def _sum_of_vectors(positions: Floats, pairs: Ints) -> tuple[float, float, float]:
    """Sum of the vectors from the first marker of each pair to the second, where both are seen."""
    x = y = z = 0.0
    for i in range(len(pairs)):
        dx, dy, dz = step_between(positions, pairs[i, 0], pairs[i, 1])
        if not math.isnan(dx + dy + dz):
            x, y, z = x + dx, y + dy, z + dz
    return x, y, z


@kernel
def _way_without_hips(positions: Floats, markers: FacingMarkers) -> tuple[float, float, float]:
    """Vector along the first row of ``upper`` that is seen, if the line across the trunk is, too.

    Without that line a view does not show the facing: what was known of it gets old.
    """
    x, y, z = _sum_of_vectors(positions, markers.lateral)
    if x == y == z == 0.0:
        return x, y, z
    for a, b, end in markers.upper:
        ax, ay, az = step_between(positions, a, end)
        bx, by, bz = step_between(positions, b, end)
        x, y, z = 0.5 * (ax + bx), 0.5 * (ay + by), 0.5 * (az + bz)
        if not math.isnan(x + y + z):
            return x, y, z
    return 0.0, 0.0, 0.0


@kernel
def left_to_right(positions: Floats, pairs: Ints, axes: Floats) -> tuple[float, float]:
    """Sum of the vectors from left to right shoulders and hips across the trunk, m."""
    x, y, z = _sum_of_vectors(positions, pairs)
    if x == y == z == 0.0:
        return 0.0, 0.0
    return component(x, y, z, axes, 0), component(x, y, z, axes, 1)


# The trunk.


@kernel
def follow_trunk(
    positions: Floats, markers: FacingMarkers, seconds: float, mean: Floats, axes: Floats
) -> tuple[bool, bool]:
    """Turn a person's axes to where the trunk points now.

    Parameters
    ----------
    positions : (M, 3 or more) of the markers, m.
    markers : of which ``trunk`` counts, and ``upper`` where the view shows no hip.
    seconds : since the last sight of the trunk.
    mean : (3,) of the last unit vectors along the trunk; changed.
    axes : (3, 3) changed; NaN while nothing is known of the trunk, or views contradict each other.

    Returns
    -------
    Whether the view shows the trunk, and whether the axes across it were chosen anew: front and
    back of before mean nothing in them.
    """
    if seconds > PATIENCE:
        mean[:], axes[:] = 0.0, np.nan
    x, y, z = _sum_of_vectors(positions, markers.trunk)
    if x == y == z == 0.0:
        x, y, z = _way_without_hips(positions, markers)
    length = norm3(x, y, z)
    if not length > _SHORTEST:
        return False, False
    x, y, z = x / length, y / length, z / length
    share = max(_LEAST_SHARE, 1.0 - _MEMORY / (seconds + _MEMORY))  # 1 where nothing is known
    mean[0] += share * (x - mean[0])
    mean[1] += share * (y - mean[1])
    mean[2] += share * (z - mean[2])
    length = norm3(mean[0], mean[1], mean[2])
    if length < _AGREEING:
        axes[:] = np.nan
        return True, False
    x, y, z = mean[0] / length, mean[1] / length, mean[2] / length
    cosine = component(x, y, z, axes, 2)
    is_near = cosine > 0.0  # False for NaN
    if is_near:  # turn the axes the shortest way until the third points there
        share = component(x, y, z, axes, 0) / (1.0 + cosine)
        axes[0, 0] -= share * (axes[2, 0] + x)
        axes[0, 1] -= share * (axes[2, 1] + y)
        axes[0, 2] -= share * (axes[2, 2] + z)
    else:  # take any axes across it
        axes[0, 0], axes[0, 1], axes[0, 2] = (1.0, 0.0, 0.0) if abs(x) < 0.8 else (0.0, 1.0, 0.0)
    _complete(x, y, z, axes)
    return True, not is_near


@kernel
def _complete(x: float, y: float, z: float, axes: Floats) -> None:
    """Make the first axis normal to (x, y, z), the third, and the second normal to both."""
    axes[2, 0], axes[2, 1], axes[2, 2] = x, y, z
    along = component(x, y, z, axes, 0)
    for c in range(3):
        axes[0, c] -= along * axes[2, c]
    length = norm3(axes[0, 0], axes[0, 1], axes[0, 2])
    for c in range(3):
        axes[0, c] /= length
    for c in range(3):
        a, b = (c + 1) % 3, (c + 2) % 3
        axes[1, c] = axes[2, a] * axes[0, b] - axes[2, b] * axes[0, a]


# The line through shoulders and hips.


@kernel
def follow_line(
    line: Floats, angle: float, reliable: float, seconds: float, trust: tuple[float, float],
    axes: Floats,
) -> float:  # fmt: skip
    """Turn a person's axes about the trunk with the line through shoulders and hips.

    A detector that assumes that people face it lets the line swing back where these go on turning.
    Axes that follow such a swing carry front and back along, the wrong way. So slow turns
    and fast ones are trusted apart: the facing in the axes can follow a slow turn by itself.

    Parameters
    ----------
    line : (3,) the line's angle in the axes so far, rad, its rate, rad/s, and the sum of the
        angles by which the axes were turned, rad; NaN = not known; changed.
    angle : of this view's line, rad, modulo half a turn.
    reliable : from 0 to 1, how well this view shows the line.
    seconds : since the last view.
    trust : from 0 to 1, the shares of slow turns and of fast ones that the axes follow.
    axes : (3, 3) changed.

    Returns
    -------
    The angle by which the axes were turned, rad.
    """
    if math.isnan(line[0]) or math.isnan(axes[0, 0]):
        line[0], line[1], line[2] = angle, 0.0, 0.0
        return 0.0
    change = angle - line[0]
    change -= math.pi * math.floor(change / math.pi + 0.5)
    # A line at a right angle to where it was does not tell which way it turned.
    share = _LINE_SHARE * reliable * ramp(abs(change), 0.5 * math.pi, 0.25 * math.pi)
    change *= share
    line[1] += (change - line[1] * seconds) / (seconds + _RATE_MEMORY)
    slow, fast = trust
    turn: float = change * (slow + max(fast - slow, 0.0) * ramp(abs(line[1]), _SLOW, _FAST))
    cosine, sine = math.cos(turn), math.sin(turn)
    for c in range(3):
        a, b = axes[0, c], axes[1, c]
        axes[0, c], axes[1, c] = cosine * a + sine * b, cosine * b - sine * a
    line[0] += change - turn
    line[2] += turn
    return turn
