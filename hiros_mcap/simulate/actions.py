"""Actions: gestures, and the ways through the room on which people make them.

The sixteen actions of the Hi-ROS evaluation (Guidolin et al. 2023, Table 5), the gestures of Lee et
al. (2022, section 2.3) that are not among them, and bodies that are not upright or fast.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from hiros_mcap.simulate import gestures
from hiros_mcap.simulate.body_model import BodyModel
from hiros_mcap.simulate.gestures import CRAWL_SPEED, Gesture, Style
from hiros_mcap.simulate.motion import (
    CRAWL,
    JOG,
    MARCH,
    STROLL,
    WALK,
    Gait,
    Person,
    Posture,
    Walker,
    between,
    standing,
)
from hiros_mcap.simulate.paths import TURN, Eight, Ellipse, Passing, Path, Rounds, Spot
from hiros_mcap.simulate.settings import ROOM, WALL, Area
from hiros_mcap.skeletons import Floats

SPEED = {
    WALK: 1.2,
    STROLL: 0.25,
    JOG: 2.5,
    MARCH: 0.0,
    CRAWL: CRAWL_SPEED,
}  # m/s, mean along the path

_SMALLEST = 0.3  # m; half of a way through a room, however small that is
_TURNED = np.radians(25.0)  # how far from the others somebody faces
_PASSES_AT, _PAIRS_APART = 0.8, 2.2  # m; of two of a pair, and from one pair to the next
_USUAL_ROUND = 0.7  # size of a round, as far as time goes, to the largest one

Layout = Callable[[int, float, np.random.Generator], Sequence[Path]]
"""Paths of n people who move at a mean speed, m/s, without running into each other."""


def spots(n: int, speed: float, rng: np.random.Generator) -> list[Path]:
    """Everybody on a place of his own, about a metre from the next, facing anywhere."""
    radius = 0.2 if n == 1 else max(0.75, 0.5 / np.sin(np.pi / n))
    turn = rng.uniform(0, TURN)
    place = turn + TURN * np.arange(n) / n
    return [Spot(radius * np.cos(a), radius * np.sin(a), rng.uniform(-np.pi, np.pi)) for a in place]


def rays(n: int, speed: float, rng: np.random.Generator) -> list[Path]:
    """Everybody in the direction of a ray, feet towards the middle: nobody lies on another."""
    radius = 0.0 if n == 1 else max(0.9, 0.6 / np.sin(np.pi / n))
    turn = rng.uniform(0, TURN)
    bearing = turn + TURN * np.arange(n) / n
    return [Spot(radius * np.cos(a), radius * np.sin(a), a + np.pi) for a in bearing]


def loop(n: int, speed: float, rng: np.random.Generator) -> list[Path]:
    """Behind each other around an oval that leaves each at least a metre."""
    scale = max(1.0, n * 1.1 / 8.8)
    semi = (1.5 * scale, 1.3 * scale)
    period = TURN * float(np.hypot(*semi)) / np.sqrt(2) / speed
    start, tilt = rng.random(), rng.uniform(0, np.pi)
    return [Ellipse(period, start + k / n, semi, tilt=tilt) for k in range(n)]


def ring(n: int, speed: float, rng: np.random.Generator) -> list[Path]:
    """Around a common centre, close to each other."""
    radius = max(0.9, n * 0.8 / TURN)
    start = rng.random()
    return [Ellipse(TURN * radius / speed, start + k / n, (radius, radius)) for k in range(n)]


def crossing(n: int, speed: float, rng: np.random.Generator) -> list[Path]:
    """Pairs that walk towards and past each other, half a metre apart, and come back.

    Two of a pair are opposite each other on a slim oval; pairs share the middle one after another.
    """
    pairs = (n + 1) // 2
    long, half_gap = 1.7, 0.26
    period = TURN * long / (1.2 * speed)  # fastest in the middle, slow at the turns
    tilt = rng.uniform(0, np.pi)
    return [
        Ellipse(
            period,
            0.1 + 0.5 * (k % 2) + 0.5 * (k // 2) / pairs,
            (long, half_gap),
            tilt=tilt + np.pi * (k // 2) / pairs,
        )
        for k in range(n)
    ]


def in_and_out(n: int, speed: float, rng: np.random.Generator) -> list[Path]:
    """Everybody walks out of all cameras' sight and comes back, radially."""
    inner, outer = max(0.5, 0.45 / np.sin(np.pi / max(n, 2))), 6.5
    semi = ((outer - inner) / 2, 0.25)
    middle, turn = (outer + inner) / 2, rng.uniform(0, TURN)
    paths: list[Path] = []
    for k in range(n):
        a = turn + TURN * k / n
        centre = (middle * np.cos(a), middle * np.sin(a))
        phase = 0.35 + rng.uniform(0, 0.3)
        paths.append(Ellipse(TURN * semi[0] / (1.2 * speed), phase, semi, centre=centre, tilt=a))
    return paths


def cells(n: int, speed: float, rng: np.random.Generator) -> list[Path]:
    """Everybody walks about in a place of his own, at his own pace."""
    radius = 0.0 if n == 1 else max(0.9, 0.65 / np.sin(np.pi / n))
    turn = rng.uniform(0, TURN)
    paths: list[Path] = []
    for k in range(n):
        a = turn + TURN * k / n
        semi = (rng.uniform(0.35, 0.45), rng.uniform(0.25, 0.35))
        centre = (radius * np.cos(a), radius * np.sin(a))
        period = rng.uniform(1.0, 1.4) * TURN * 0.45 / (0.55 * speed)
        paths.append(Ellipse(period, rng.random(), semi, centre=centre, tilt=a))
    return paths


def eight(n: int, speed: float, rng: np.random.Generator) -> list[Path]:
    """Behind each other on a figure of eight; nobody meets anybody where it crosses itself."""
    semi = (1.6, 0.7)
    share = n if n % 2 else n + 1  # an odd number: nobody is half a round behind anybody
    start = rng.random()
    return [Eight(10.0 / speed, start + k / share, semi) for k in range(n)]


def passing(n: int, speed: float, rng: np.random.Generator) -> list[Path]:
    """Pairs stand in a row and face one way; of each, one now and then walks round the other.

    As in recordings of two people by two Kinect v2, who stand .75 m apart at the median, 3 cm/s
    fast, and hide each other for 1.4 to 1.8 s when they pass.
    """
    paths: list[Path] = []
    pairs = (n + 1) // 2
    for k in range(n):
        across = _PAIRS_APART * (k // 2 - (pairs - 1) / 2)
        seconds = np.pi * _PASSES_AT / speed
        start = rng.uniform(0.0, 0.5) * seconds
        radius = _PASSES_AT if k % 2 else 0.0
        turned = _TURNED * rng.standard_normal()
        paths.append(Passing((0.0, across), turned, radius, 2 * seconds, seconds, start))
    return paths


def roam(n: int, speed: float, rng: np.random.Generator, area: Area = ROOM) -> Sequence[Path]:
    """Everybody through the whole room on rounds that grow and shrink, away from the walls."""
    x, y = (np.add(area[:2], area[2:]) / 2).tolist()
    semi = np.maximum(np.subtract(area[2:], area[:2]) / 2 - WALL, _SMALLEST)
    period = TURN * _USUAL_ROUND * float(np.hypot(*semi)) / np.sqrt(2) / speed
    start = rng.random()
    return [
        Rounds(period, start + k / n, (semi[0], semi[1]), (x, y), rng.uniform(0, TURN))
        for k in range(n)
    ]


@dataclass(frozen=True, slots=True)
class Action:
    """Where people are, how they get about, what they do meanwhile."""

    layout: Layout
    gait: Gait | None = None
    gesture: Gesture | None = None

    def inside(self, area: Area) -> Action:
        """Return the action in another room, if people roam in it: least x, y, greatest x, y."""
        return replace(self, layout=partial(roam, area=area)) if self.layout is roam else self

    def perform(
        self,
        bodies: Sequence[BodyModel],
        rng: np.random.Generator,
        facing_deg: float | None = None,
    ) -> list[Person]:
        """Let each body perform the action in its own style; all on a spot may face one way."""
        speed = SPEED[self.gait] if self.gait else 0.0
        paths = self.layout(len(bodies), speed, rng)
        if facing_deg is not None:
            facing = np.radians(facing_deg)
            paths = [_facing(path, facing) for path in paths]
        return [
            Person(body, _performance(self, body, path, Style.of(rng)))
            for body, path in zip(bodies, paths, strict=True)
        ]


def _facing(path: Path, facing: float) -> Path:
    """Return a path on which somebody faces one way, rad, in that direction, or about so."""
    if isinstance(path, Passing):
        c, s = np.cos(facing), np.sin(facing)
        ahead, left = path.centre
        facing += path.facing
        return replace(path, facing=facing, centre=(c * ahead - s * left, s * ahead + c * left))
    return replace(path, facing=facing) if isinstance(path, Spot) else path


def _performance(
    action: Action, body: BodyModel, path: Path, style: Style
) -> Callable[[Floats], Posture]:
    walker = Walker(body, path, action.gait, style.phase) if action.gait else None

    def still(t: Floats) -> Posture:
        result = standing(body, path, t)
        gestures.idle(result, t, style)
        return result

    def posture(t: Floats) -> Posture:
        result = walker.posture(t) if walker else still(t)
        if isinstance(path, Passing):
            result = between(still(t), result, path.walking(t))
        if action.gesture:
            action.gesture(result, t, style)
        return result

    return posture


ACTIONS: dict[str, Action] = {
    "walk": Action(loop, WALK),
    "squat": Action(spots, gesture=gestures.squat),
    "bend": Action(spots, gesture=gestures.bend),
    "sit": Action(spots, gesture=gestures.sit),
    "jog": Action(loop, JOG),
    "jump": Action(spots, gesture=gestures.jump),
    "cross_arms": Action(spots, gesture=gestures.cross_arms),
    "point": Action(spots, gesture=gestures.point),
    "wave": Action(spots, gesture=gestures.wave),
    "throw": Action(spots, gesture=gestures.throw),
    "free_static": Action(spots, gesture=gestures.gestures),
    "free_dynamic": Action(cells, WALK, gestures.gestures),
    "circle": Action(ring, WALK),
    "cross": Action(crossing, WALK),
    "in_out": Action(in_and_out, WALK),
    "pass": Action(passing, STROLL),
    "eight": Action(eight, WALK),
    "roam": Action(roam, WALK),
    "lunge": Action(spots, gesture=gestures.lunge),
    "hands_up_down": Action(spots, gesture=gestures.hands_up_down),
    "walk_in_place": Action(spots, MARCH),
    "crawl": Action(loop, CRAWL, gestures.crawl),
    "get_up": Action(rays, gesture=gestures.get_up),
    "roll": Action(rays, gesture=gestures.roll),
    "kick": Action(spots, gesture=gestures.kick),
    "spin": Action(spots, gesture=gestures.spin),
}
"""Table 5 of the Hi-ROS paper without its three calibration poses, then Lee's gestures (somebody
who is filmed from the front cannot walk away: he walks on the spot), then the floor and fast."""
