"""Smooth scalar functions of time and the paths that people follow on the ground."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hiros_mcap.skeletons import Floats

TURN = 2 * np.pi


def smoothstep(x: Floats) -> Floats:
    """From 0 (x <= 0) to 1 (x >= 1) with continuous velocity and acceleration."""
    x = np.clip(x, 0.0, 1.0)
    step: Floats = x**3 * (10 + x * (6 * x - 15))
    return step


def bump(x: Floats, start: float, end: float) -> Floats:
    """From 0 up to 1 and back to 0 within [start, end], twice continuously differentiable."""
    s = np.clip((x - start) / (end - start), 0.0, 1.0)
    hump: Floats = 64 * (s * (1 - s)) ** 3
    return hump


def hold(x: Floats, start: float, full: float, falling: float, end: float) -> Floats:
    """Rise within [start, full], stay at 1, fall within [falling, end]."""
    up = smoothstep((x - start) / (full - start))
    return up - smoothstep((x - falling) / (end - falling))


@dataclass(frozen=True, slots=True)
class Spot:
    """Standing at a place."""

    x: float
    y: float
    facing: float

    def position(self, t: Floats) -> Floats:
        """See :data:`Path`."""
        return np.broadcast_to(np.array([self.x, self.y]), (*t.shape, 2))

    def heading(self, t: Floats) -> Floats:
        """See :data:`Path`."""
        return np.full(t.shape, self.facing)


@dataclass(frozen=True, slots=True)
class Ellipse:
    """Round and round, anticlockwise, once in ``period`` seconds, starting at ``phase`` turns.

    Walked at constant angular rate: slow where the curve is tight, as people are.
    """

    period: float
    phase: float
    semi: tuple[float, float]
    centre: tuple[float, float] = (0.0, 0.0)
    tilt: float = 0.0

    def _angle(self, t: Floats) -> Floats:
        return TURN * (t / self.period + self.phase)

    def position(self, t: Floats) -> Floats:
        """See :data:`Path`."""
        u = self._angle(t)
        x, y = self.semi[0] * np.cos(u), self.semi[1] * np.sin(u)
        c, s = np.cos(self.tilt), np.sin(self.tilt)
        return np.stack([c * x - s * y + self.centre[0], s * x + c * y + self.centre[1]], axis=-1)

    def heading(self, t: Floats) -> Floats:
        """See :data:`Path`."""
        u = self._angle(t)
        tangent = np.arctan2(self.semi[1] * np.cos(u), -self.semi[0] * np.sin(u))
        return unwrapped(tangent, near=u + np.pi / 2) + self.tilt


@dataclass(frozen=True, slots=True)
class Eight:
    """A figure of eight along x, ``semi`` metres long and wide to each side."""

    period: float
    phase: float
    semi: tuple[float, float]

    def position(self, t: Floats) -> Floats:
        """See :data:`Path`."""
        u = TURN * (t / self.period + self.phase)
        return np.stack([self.semi[0] * np.sin(u), self.semi[1] * np.sin(2 * u)], axis=-1)

    def heading(self, t: Floats) -> Floats:
        """See :data:`Path`."""
        u = TURN * (t / self.period + self.phase)
        tangent = np.arctan2(2 * self.semi[1] * np.cos(2 * u), self.semi[0] * np.cos(u))
        return unwrapped(tangent, near=np.full(u.shape, -np.pi / 2))


_SMALL_ROUND = 0.3  # to the largest
_ROUNDS = 1.62  # from one large round to the next; not whole, so that all of the room is walked


@dataclass(frozen=True, slots=True)
class Rounds:
    """Round and round through a rectangle, on rounds that grow and shrink.

    Rounds have rounded corners (superellipses of degree 4). Whoever shares their number per second
    and starts at another ``phase`` stays in another direction of the centre. ``beat``, rad, is
    where the size of the rounds starts.
    """

    period: float
    phase: float
    semi: tuple[float, float]
    centre: tuple[float, float]
    beat: float

    def _polar(self, t: Floats) -> tuple[Floats, Floats, Floats]:
        """Angle, radius and its derivative by the angle, of the unit square."""
        u = TURN * (t / self.period + self.phase)
        c, s, beat = np.cos(u), np.sin(u), u / _ROUNDS + self.beat
        least = _SMALL_ROUND**2
        # The square of the size goes evenly, and so all of the floor is walked alike.
        size = np.sqrt(least + (1 - least) * (1 + np.cos(beat)) / 2)
        growth = -(1 - least) * np.sin(beat) / (4 * _ROUNDS * size)
        corner = (c**4 + s**4) ** -0.25
        bend = corner**5 * c * s * (c**2 - s**2)
        return u, size * corner, growth * corner + size * bend

    def position(self, t: Floats) -> Floats:
        """See :data:`Path`."""
        u, radius, _ = self._polar(t)
        x, y = self.semi[0] * radius * np.cos(u), self.semi[1] * radius * np.sin(u)
        return np.stack([x + self.centre[0], y + self.centre[1]], axis=-1)

    def heading(self, t: Floats) -> Floats:
        """See :data:`Path`."""
        u, radius, change = self._polar(t)
        east = self.semi[0] * (change * np.cos(u) - radius * np.sin(u))
        north = self.semi[1] * (change * np.sin(u) + radius * np.cos(u))
        return unwrapped(np.arctan2(north, east), near=u + np.pi / 2)


@dataclass(frozen=True, slots=True)
class Passing:
    """Standing beside somebody, and now and then walking round to the other side, facing one way.

    Every ``period`` seconds, half a turn of ``radius`` around ``centre`` takes ``seconds``: behind
    the other, and the next time in front. Who only stands has the radius 0.
    """

    centre: tuple[float, float]
    facing: float
    radius: float
    period: float
    seconds: float
    start: float  # time, s, of the first half turn

    def _rounds(self, t: Floats) -> tuple[Floats, Floats]:
        """Half turns that were begun before, and how much of the next one is over, 0 to 1."""
        rounds = (t - self.start) / self.period
        count = np.floor(rounds)
        return count, np.clip((rounds - count) * self.period / self.seconds, 0.0, 1.0)

    def position(self, t: Floats) -> Floats:
        """See :data:`Path`."""
        count, share = self._rounds(t)
        u = self.facing + np.pi / 2 + np.pi * (count + smoothstep(share))
        off = self.radius * np.stack([np.cos(u), np.sin(u)], axis=-1)
        place: Floats = np.array(self.centre) + off
        return place

    def heading(self, t: Floats) -> Floats:
        """See :data:`Path`."""
        return np.full(t.shape, self.facing)

    def walking(self, t: Floats) -> Floats:
        """(...) 0 while standing, 1 while walking."""
        return hold(self._rounds(t)[1], 0.0, 0.15, 0.85, 1.0) if self.radius else np.zeros(t.shape)


Path = Spot | Ellipse | Eight | Rounds | Passing
"""Where somebody is on the ground at any time, and which way he faces.

``position(t)`` gives (..., 2) places, m, at times ``t``, s; ``heading(t)`` the (...) direction of
facing, rad, continuous over time (it does not wrap).
"""


def unwrapped(angle: Floats, near: Floats) -> Floats:
    """``angle`` plus the whole turns that bring it within half a turn of ``near``."""
    turns: Floats = angle - TURN * np.round((angle - near) / TURN)
    return turns
