"""What people do and where.

The sixteen actions of the Hi-ROS evaluation (Guidolin et al. 2023, Table 5), and the gestures of
Lee et al. (2022, section 2.3) that are not among them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hiros_mcap.simulate.body_model import BodyModel
from hiros_mcap.simulate.motion import (
    JOG,
    MARCH,
    WALK,
    Gait,
    Person,
    Posture,
    Walker,
    angles,
    arm,
    standing,
)
from hiros_mcap.simulate.paths import TURN, Eight, Ellipse, Path, Spot, bump, hold
from hiros_mcap.skeletons import Floats

SPEED = {WALK: 1.2, JOG: 2.5, MARCH: 0.0}  # m/s, mean along the path


@dataclass(frozen=True, slots=True)
class Style:
    """How one person performs: nobody repeats another's movement exactly."""

    side: str
    """The preferred hand, "left" or "right"."""
    tempo: float
    """Speed relative to the average."""
    phase: float
    """Where in the action's cycle the person starts, turns."""
    extent: float
    """Amplitude relative to the average."""

    @classmethod
    def of(cls, rng: np.random.Generator) -> Style:
        """Draw one person's style."""
        return cls(
            side="left" if rng.random() < 0.2 else "right",
            tempo=float(rng.uniform(0.9, 1.1)),
            phase=float(rng.random()),
            extent=float(rng.uniform(0.9, 1.1)),
        )

    @property
    def other(self) -> str:
        """The other hand."""
        return "right" if self.side == "left" else "left"

    def cycle(self, t: Floats, seconds: float) -> Floats:
        """Position, 0..1, in a cycle that lasts ``seconds`` at the average tempo."""
        turns = t * self.tempo / seconds + self.phase
        return turns - np.floor(turns)


Gesture = Callable[[Posture, Floats, Style], None]
"""Changes a posture, given the times, s, and the person's style."""


def _shift_pelvis(posture: Posture, ahead: Floats, up: Floats) -> None:
    c, s = np.cos(posture.heading), np.sin(posture.heading)
    posture.pelvis += np.stack([ahead * c, ahead * s, up], axis=-1)


def _lean(posture: Posture, forward: Floats) -> None:
    """Bend the trunk by ``forward`` rad in all, half of it at the hips."""
    posture.add("pelvis", angles(-0.5 * forward))
    posture.add("abdomen", angles(-0.3 * forward))
    posture.add("thorax", angles(-0.2 * forward))


def idle(posture: Posture, t: Floats, style: Style) -> None:
    """Sway slowly by a few millimetres, breathe, let the arms hang."""
    slow, breath = TURN * (0.21 * t + style.phase), TURN * (0.27 * t + 2 * style.phase)
    posture.pelvis += np.stack(
        [0.006 * np.sin(slow), 0.005 * np.sin(1.7 * slow), np.zeros_like(t)], axis=-1
    )
    posture.add("thorax", angles(0.01 * np.sin(breath), 0.01 * np.sin(slow), 0.02 * np.cos(slow)))
    posture.add("head", angles(0.03 * np.sin(1.3 * slow), 0.0, 0.10 * np.sin(0.7 * slow)))
    for side in ("left", "right"):
        posture.add(f"upper_arm_{side}", arm(side, 0.02 * np.sin(breath), 0.10, 0.1))
        posture.add(f"forearm_{side}", angles(0.18 + 0.02 * np.sin(slow)))


def squat(posture: Posture, t: Floats, style: Style) -> None:
    """Down with the arms stretched forward for balance, and up, every 3 s."""
    depth = style.extent * bump(style.cycle(t, 3.0), 0.05, 0.95)
    _shift_pelvis(posture, -0.20 * depth, -0.36 * depth)
    _lean(posture, 0.75 * depth)
    for side in ("left", "right"):
        posture.add(f"upper_arm_{side}", arm(side, 1.7 * depth))


def bend(posture: Posture, t: Floats, style: Style) -> None:
    """Reach towards the floor with nearly straight legs, every 4 s."""
    depth = style.extent * hold(style.cycle(t, 4.0), 0.05, 0.4, 0.55, 0.9)
    _shift_pelvis(posture, -0.16 * depth, -0.05 * depth)
    _lean(posture, 1.35 * depth)
    posture.add("neck", angles(0.3 * depth))
    for side in ("left", "right"):
        posture.add(f"upper_arm_{side}", arm(side, 1.25 * depth))


def sit(posture: Posture, t: Floats, style: Style) -> None:
    """Sit down on a chair, stay, stand up, every 6 s."""
    x = style.cycle(t, 6.0)
    depth = hold(x, 0.1, 0.35, 0.65, 0.9)
    _shift_pelvis(posture, -0.36 * depth, -0.40 * depth)
    _lean(posture, 0.65 * (bump(x, 0.08, 0.40) + bump(x, 0.60, 0.92)))
    for side in ("left", "right"):
        posture.add(f"upper_arm_{side}", arm(side, 0.45 * depth))
        posture.add(f"forearm_{side}", angles(0.9 * depth))


def jump(posture: Posture, t: Floats, style: Style) -> None:
    """Crouch, jump with both feet, land, every 2 s; the arms help."""
    x = style.cycle(t, 2.0)
    crouch = bump(x, 0.05, 0.40) + 0.8 * bump(x, 0.56, 0.95)
    flight = style.extent * bump(x, 0.32, 0.66)
    _shift_pelvis(posture, -0.08 * crouch, 0.24 * flight - 0.20 * crouch)
    _lean(posture, 0.5 * crouch)
    posture.toes[:, :, 2] += (0.20 * flight)[:, None]
    posture.foot_pitch += (0.5 * flight)[:, None]
    for side in ("left", "right"):
        posture.add(f"upper_arm_{side}", arm(side, 1.6 * flight - 0.5 * crouch, 0.2 * flight))


def lunge(posture: Posture, t: Floats, style: Style) -> None:
    """Step far ahead, bend both knees, step back, every 3.5 s; the other foot next time."""
    turn = style.cycle(t, 7.0)
    for foot, first in ((0, 0.0), (1, 0.5)):
        x = 2 * (turn - first)  # 0..1 while this foot steps
        step, down = hold(x, 0.05, 0.32, 0.66, 0.93), hold(x, 0.18, 0.45, 0.58, 0.84)
        lift = bump(x, 0.05, 0.32) + bump(x, 0.66, 0.93)
        ahead = hold(x, 0.08, 0.42, 0.60, 0.92)
        _shift_pelvis(posture, 0.36 * ahead, -0.27 * style.extent * down)
        c, s = np.cos(posture.heading), np.sin(posture.heading)
        posture.toes[:, foot] += np.stack([0.72 * step * c, 0.72 * step * s, 0.08 * lift], axis=-1)
        posture.foot_pitch[:, 1 - foot] += 0.95 * ahead  # the heel behind rises
        _lean(posture, 0.12 * down)
        for side in ("left", "right"):
            posture.add(f"upper_arm_{side}", arm(side, 0.15 * down, 0.25 * down))
            posture.add(f"forearm_{side}", angles(0.5 * down))


def hands_up_down(posture: Posture, t: Floats, style: Style) -> None:
    """Raise both stretched arms in front over the head and lower them, every 3 s."""
    up = hold(style.cycle(t, 3.0), 0.05, 0.42, 0.54, 0.92)
    for side in ("left", "right"):
        posture.add(f"upper_arm_{side}", arm(side, 2.8 * up, 0.12 * up))
        posture.add(f"forearm_{side}", angles(-0.08 * up))
    posture.add("thorax", angles(0.06 * up))


def cross_arms(posture: Posture, t: Floats, style: Style) -> None:
    """Cross the arms before the chest and open them, every 5 s."""
    closed = hold(style.cycle(t, 5.0), 0.05, 0.3, 0.7, 0.95)
    for side, height in ((style.side, 0.75), (style.other, 0.55)):
        posture.add(f"upper_arm_{side}", arm(side, height * closed, -0.05 * closed, 0.8 * closed))
        posture.add(f"forearm_{side}", angles(1.5 * closed))


def point(posture: Posture, t: Floats, style: Style) -> None:
    """Point forward with a stretched arm, hold, lower it, every 4 s."""
    raised = hold(style.cycle(t, 4.0), 0.05, 0.25, 0.75, 0.95)
    drift = 0.25 * np.sin(TURN * 0.31 * t)
    posture.add(f"upper_arm_{style.side}", arm(style.side, 1.5 * raised, drift * raised))
    posture.add(f"forearm_{style.side}", angles(-0.1 * raised))


def wave(posture: Posture, t: Floats, style: Style) -> None:
    """Raise one hand beside the head and wave it at 1.4 Hz."""
    raised = hold(style.cycle(t, 8.0), 0.02, 0.12, 0.88, 0.98)
    swing = np.sin(TURN * 1.4 * style.tempo * t)
    side = style.side
    posture.add(f"upper_arm_{side}", arm(side, 0.25 * raised, 1.25 * raised, -1.45 * raised))
    posture.add(f"forearm_{side}", angles(raised * (1.4 + 0.5 * style.extent * swing)))
    posture.add(f"hand_{side}", angles(0.15 * raised * swing))


def throw(posture: Posture, t: Floats, style: Style) -> None:
    """Wind up, throw overarm, follow through, every 3 s."""
    x = style.cycle(t, 3.0)
    wind, launch = hold(x, 0.05, 0.35, 0.42, 0.58), bump(x, 0.40, 0.80)
    sign = 1.0 if style.side == "right" else -1.0
    _shift_pelvis(posture, 0.10 * (launch - wind), -0.03 * (launch + wind))
    posture.add("thorax", angles(-0.2 * launch, 0.0, sign * (0.5 * launch - 0.6 * wind)))
    posture.add(
        f"upper_arm_{style.side}",
        arm(style.side, 1.5 * launch - 0.1 * wind, 1.3 * wind, -1.3 * wind),
    )
    posture.add(f"forearm_{style.side}", angles(1.5 * wind))


def gestures(posture: Posture, t: Floats, style: Style) -> None:
    """Talk with the hands: raise, point, fold the arms, at incommensurate rates."""
    for k, side in enumerate((style.side, style.other)):
        up = bump(style.cycle(t, 3.7 + 1.6 * k), 0.1, 0.8)
        out = bump(style.cycle(t, 5.3 - 1.2 * k), 0.3, 0.9)
        posture.add(f"upper_arm_{side}", arm(side, 0.9 * up, 0.7 * out, 0.4 * up))
        posture.add(f"forearm_{side}", angles(1.2 * up + 0.4 * out))
    turn = np.sin(TURN * (0.13 * t + style.phase))
    posture.add("thorax", angles(0.0, 0.0, 0.2 * turn))
    posture.add("head", angles(0.0, 0.0, 0.4 * turn))


Layout = Callable[[int, float, np.random.Generator], Sequence[Path]]
"""Paths of n people who move at a mean speed, m/s, without running into each other."""


def spots(n: int, speed: float, rng: np.random.Generator) -> list[Path]:
    """Everybody on a place of his own, about a metre from the next, facing anywhere."""
    radius = 0.2 if n == 1 else max(0.75, 0.5 / np.sin(np.pi / n))
    turn = rng.uniform(0, TURN)
    place = turn + TURN * np.arange(n) / n
    return [Spot(radius * np.cos(a), radius * np.sin(a), rng.uniform(-np.pi, np.pi)) for a in place]


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


@dataclass(frozen=True, slots=True)
class Action:
    """Where people are, how they get about, what they do meanwhile."""

    layout: Layout
    gait: Gait | None = None
    gesture: Gesture | None = None

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
            paths = [_facing(path, np.radians(facing_deg)) for path in paths]
        return [
            Person(body, _performance(self, body, path, Style.of(rng)))
            for body, path in zip(bodies, paths, strict=True)
        ]


def _facing(path: Path, facing: float) -> Path:
    return replace(path, facing=facing) if isinstance(path, Spot) else path


def _performance(
    action: Action, body: BodyModel, path: Path, style: Style
) -> Callable[[Floats], Posture]:
    walker = Walker(body, path, action.gait, style.phase) if action.gait else None

    def posture(t: Floats) -> Posture:
        if walker:
            result = walker.posture(t)
        else:
            result = standing(body, path, t)
            idle(result, t, style)
        if action.gesture:
            action.gesture(result, t, style)
        return result

    return posture


ACTIONS: dict[str, Action] = {
    "walk": Action(loop, WALK),
    "squat": Action(spots, gesture=squat),
    "bend": Action(spots, gesture=bend),
    "sit": Action(spots, gesture=sit),
    "jog": Action(loop, JOG),
    "jump": Action(spots, gesture=jump),
    "cross_arms": Action(spots, gesture=cross_arms),
    "point": Action(spots, gesture=point),
    "wave": Action(spots, gesture=wave),
    "throw": Action(spots, gesture=throw),
    "free_static": Action(spots, gesture=gestures),
    "free_dynamic": Action(cells, WALK, gestures),
    "circle": Action(ring, WALK),
    "cross": Action(crossing, WALK),
    "in_out": Action(in_and_out, WALK),
    "eight": Action(eight, WALK),
    "lunge": Action(spots, gesture=lunge),
    "hands_up_down": Action(spots, gesture=hands_up_down),
    "walk_in_place": Action(spots, MARCH),
}
"""Table 5 of the Hi-ROS paper without its three calibration poses, then Lee's gestures. Somebody
who is filmed from the front cannot walk away: he walks on the spot."""
