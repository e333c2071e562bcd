"""Gestures: changes of a posture over time.

The gestures of the Hi-ROS evaluation (Guidolin et al. 2023, Table 5), those of Lee et al. (2022,
section 2.3) that are not among them, and what is hard: people on the floor, and fast ones.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hiros_mcap.simulate.body_model import ADULT_HEIGHT
from hiros_mcap.simulate.motion import (
    CRAWL,
    TOE_AHEAD,
    Posture,
    angles,
    arm,
    beside,
    facing,
    reach,
    rotation_zxy,
)
from hiros_mcap.simulate.paths import TURN, bump, hold, smoothstep
from hiros_mcap.skeletons import Floats

CRAWL_SPEED = 0.35  # m/s
SPIN_SECONDS = 1.107
"""Of a whole turn: its rate peaks at 1.875 turns in this time, 610 degrees/s."""


@dataclass(frozen=True, slots=True)
class Style:
    """How one person performs: nobody repeats another's movement exactly."""

    side: str  # the preferred hand, "left" or "right"
    tempo: float  # speed relative to the average
    phase: float  # where in the action's cycle the person starts, turns
    extent: float  # amplitude relative to the average

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


def _arms(posture: Posture, *swing: Floats | float, elbow: Floats | None = None) -> None:
    """Move both arms alike; see :func:`arm`."""
    for side in ("left", "right"):
        posture.add(f"upper_arm_{side}", arm(side, *swing))
        if elbow is not None:
            posture.add(f"forearm_{side}", angles(elbow))


def idle(posture: Posture, t: Floats, style: Style) -> None:
    """Sway slowly by a few millimetres, breathe, let the arms hang."""
    slow, breath = TURN * (0.21 * t + style.phase), TURN * (0.27 * t + 2 * style.phase)
    posture.pelvis += np.stack(
        [0.006 * np.sin(slow), 0.005 * np.sin(1.7 * slow), np.zeros_like(t)], axis=-1
    )
    posture.add("thorax", angles(0.01 * np.sin(breath), 0.01 * np.sin(slow), 0.02 * np.cos(slow)))
    posture.add("head", angles(0.03 * np.sin(1.3 * slow), 0.0, 0.10 * np.sin(0.7 * slow)))
    _arms(posture, 0.02 * np.sin(breath), 0.10, 0.1, elbow=0.18 + 0.02 * np.sin(slow))


def squat(posture: Posture, t: Floats, style: Style) -> None:
    """Down with the arms stretched forward for balance, and up, every 3 s."""
    depth = style.extent * bump(style.cycle(t, 3.0), 0.05, 0.95)
    _shift_pelvis(posture, -0.20 * depth, -0.36 * depth)
    _lean(posture, 0.75 * depth)
    _arms(posture, 1.7 * depth)


def bend(posture: Posture, t: Floats, style: Style) -> None:
    """Reach towards the floor with nearly straight legs, every 4 s."""
    depth = style.extent * hold(style.cycle(t, 4.0), 0.05, 0.4, 0.55, 0.9)
    _shift_pelvis(posture, -0.16 * depth, -0.05 * depth)
    _lean(posture, 1.35 * depth)
    posture.add("neck", angles(0.3 * depth))
    _arms(posture, 1.25 * depth)


def sit(posture: Posture, t: Floats, style: Style) -> None:
    """Sit down on a chair, stay, stand up, every 6 s."""
    x = style.cycle(t, 6.0)
    depth = hold(x, 0.1, 0.35, 0.65, 0.9)
    _shift_pelvis(posture, -0.36 * depth, -0.40 * depth)
    _lean(posture, 0.65 * (bump(x, 0.08, 0.40) + bump(x, 0.60, 0.92)))
    _arms(posture, 0.45 * depth, elbow=0.9 * depth)


def jump(posture: Posture, t: Floats, style: Style) -> None:
    """Crouch, jump with both feet, land, every 2 s; the arms help."""
    x = style.cycle(t, 2.0)
    crouch = bump(x, 0.05, 0.40) + 0.8 * bump(x, 0.56, 0.95)
    flight = style.extent * bump(x, 0.32, 0.66)
    _shift_pelvis(posture, -0.08 * crouch, 0.24 * flight - 0.20 * crouch)
    _lean(posture, 0.5 * crouch)
    posture.toes[:, :, 2] += (0.20 * flight)[:, None]
    posture.foot_pitch += (0.5 * flight)[:, None]
    _arms(posture, 1.6 * flight - 0.5 * crouch, 0.2 * flight)


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
        _arms(posture, 0.15 * down, 0.25 * down, elbow=0.5 * down)


def hands_up_down(posture: Posture, t: Floats, style: Style) -> None:
    """Raise both stretched arms in front over the head and lower them, every 3 s."""
    up = hold(style.cycle(t, 3.0), 0.05, 0.42, 0.54, 0.92)
    _arms(posture, 2.8 * up, 0.12 * up, elbow=-0.08 * up)
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


def crawl(posture: Posture, t: Floats, style: Style) -> None:
    """On hands and knees, each hand with the knee of the other side; made for CRAWL's gait."""
    body = posture.body
    size = body.height / ADULT_HEIGHT
    thigh, shank = -body.offset("KNEE_LEFT")[1], -body.offset("ANKLE_LEFT")[1]
    posture.pelvis[:, 2] += 0.06 * size + 0.97 * thigh - body.standing
    posture.foot_pitch += 2.0  # on the toes
    posture.add("neck", angles(-0.7))
    for side in range(2):
        toes, heading = posture.toes[:, side], posture.foot_heading[:, side]
        _put_hand(posture, 1 - side, toes, heading)
        posture.toes[:, side] = beside(toes, heading, -(shank + 0.27 * size), 0.0)


def _put_hand(posture: Posture, side: int, toes: Floats, heading: Floats) -> None:
    """Put a hand on the floor beneath its shoulder where a gait has the other side's ``toes``."""
    body, name, sign = posture.body, ("left", "right")[side], (1.0, -1.0)[side]
    across = body.offset("SHOULDER_RIGHT") + body.offset("CLAVICLE_RIGHT")
    trunk = body.offset("SPINE_NAVAL")[1] + body.offset("SPINE_CHEST")[1] + across[1]
    aside = across[2] + 0.6 * body.offset("HIP_RIGHT")[2]
    wrist = beside(toes, heading, trunk - TOE_AHEAD, sign * aside)
    lift = toes[:, 2] - body.toe_height
    wrist[:, 2] = 0.06 * body.height / ADULT_HEIGHT + 2 * lift
    flexion, elbow = reach(posture, name, wrist)
    level = flexion + elbow - CRAWL.lean - np.pi / 2
    posture.add(f"forearm_{name}", angles(0.0, 0.0, -sign * np.pi / 2))
    posture.add(f"hand_{name}", angles(0.0, -sign * level))


def get_up(posture: Posture, t: Floats, style: Style) -> None:
    """Lie on the back, sit up, crouch, stand, and lie down again the same way, every 12 s."""
    x = style.cycle(t, 12.0)
    sat = hold(x, 0.10, 0.26, 0.82, 0.97)
    crouched, stood = hold(x, 0.27, 0.41, 0.66, 0.80), hold(x, 0.38, 0.52, 0.58, 0.70)
    size = posture.body.height / ADULT_HEIGHT
    lying, sitting, crouching, standing = 1 - sat, sat - crouched, crouched - stood, stood
    ahead = -size * (0.82 * lying + 0.50 * sitting + 0.14 * crouching)
    high = 0.13 * lying + 0.17 * sitting + 0.45 * crouching
    up = size * high - posture.body.standing * (1 - standing)
    _shift_pelvis(posture, ahead, up)
    _lean(posture, -0.3 * sitting + 1.1 * crouching)
    posture.add("pelvis", angles(lying * np.pi / 2))
    posture.add("abdomen", angles(-0.3 * bump(x, 0.08, 0.28) - 0.3 * bump(x, 0.80, 0.99)))
    _raise_toes(posture, 0.9 * lying)
    for side in ("left", "right"):
        reach = 0.7 * sitting + 0.9 * crouching
        posture.add(f"upper_arm_{side}", arm(side, reach, 0.15 * (1 - standing)))
        posture.add(f"forearm_{side}", angles(0.4 * sitting))


def roll(posture: Posture, t: Floats, style: Style) -> None:
    """Lie stretched out, arms over the head, and roll about oneself and back, every 8 s."""
    x = style.cycle(t, 8.0)
    rolled = TURN * hold(x, 0.05, 0.45, 0.55, 0.95)
    size = posture.body.height / ADULT_HEIGHT
    _arms(posture, 2.95, -0.45)
    _raise_toes(posture, np.full_like(t, -0.9))
    # On the side the body lies on a shoulder; the hips' way over the floor is that of a barrel.
    height = size * (0.12 + 0.08 * np.sin(rolled) ** 2) - posture.body.standing
    shift = np.stack([np.full_like(t, -0.85 * size), size * 0.15 * (rolled - np.pi)], axis=-1)
    c, s = np.cos(posture.heading), np.sin(posture.heading)
    moved = np.stack(
        [c * shift[:, 0] - s * shift[:, 1], s * shift[:, 0] + c * shift[:, 1], height], axis=-1
    )
    posture.pelvis += moved
    posture.toes += moved[:, None]
    _rotate(posture, np.full_like(t, np.pi / 2), rolled if style.side == "left" else -rolled)


def kick(posture: Posture, t: Floats, style: Style) -> None:
    """Kick forward in half a second, every 2.5 s; the other foot next time.

    Hip, knee and ankle of the kicking leg reach accelerations of 40 to 80 m/s2.
    """
    cycle = style.cycle(t, 5.0)
    c, s = np.cos(posture.heading), np.sin(posture.heading)
    size = posture.body.height / ADULT_HEIGHT
    for foot, sign, first in ((0, -1.0, 0.0), (1, 1.0, 0.5)):
        x = 5.0 / style.tempo * (cycle - first)  # s since the start of this kick
        ready, out = hold(x, 0.2, 0.7, 1.4, 2.0), bump(x, 0.85, 1.40)
        thrust = bump(x, 0.97, 1.29)
        _shift_pelvis(posture, 0.02 * ready + 0.13 * thrust, 0.05 * thrust - 0.04 * ready)
        posture.add("pelvis", angles(0.25 * out, 0.0, sign * 0.3 * thrust))
        posture.add("abdomen", angles(-0.2 * out))
        ahead, up = size * (0.62 * out - 0.12 * ready), size * (0.66 * out + 0.10 * ready)
        posture.toes[:, foot] += np.stack([ahead * c, ahead * s, up], axis=-1)
        posture.foot_pitch[:, foot] += 0.5 * ready - 1.5 * out
        for side, swing in (("left", -sign), ("right", sign)):
            posture.add(
                f"upper_arm_{side}", arm(side, 0.6 * ready - 0.5 * swing * out, 0.4 * ready)
            )
            posture.add(f"forearm_{side}", angles(1.3 * ready))


def spin(posture: Posture, t: Floats, style: Style) -> None:
    """Dance, and every 4 s turn once about oneself at up to 610 degrees/s, left and right."""
    gestures(posture, 1.6 * t, style)
    beat = TURN * style.tempo * t
    _shift_pelvis(posture, 0.04 * np.sin(0.5 * beat), -0.05 + 0.03 * np.cos(2 * beat))
    posture.add("pelvis", angles(0.08 * np.sin(0.7 * beat), 0.10 * np.sin(beat)))
    cycle = style.cycle(t, 8.0)
    for first, sign in ((0.0, 1.0), (0.5, -1.0)):
        x = 8.0 * (cycle - first)
        turning = smoothstep((x - 1.0) / SPIN_SECONDS)
        tucked = hold(x, 0.6, 1.1, 1.9, 2.5)
        _arms(posture, 0.5 * tucked, 0.3 * tucked, 0.5 * tucked)
        posture.toes[:, 0 if sign > 0 else 1, 2] += 0.12 * tucked
        _rotate(posture, np.zeros_like(t), sign * TURN * turning)


def _raise_toes(posture: Posture, angle: Floats) -> None:
    """Pitch both feet about their ankles by ``angle``, rad, toes up."""
    ahead, up = posture.body.offset("FOOT_LEFT")[:2]
    forward = np.cos(angle) * ahead - np.sin(angle) * up - ahead
    rise = np.sin(angle) * ahead + np.cos(angle) * up - up
    c, s = np.cos(posture.foot_heading), np.sin(posture.foot_heading)
    forward, rise = forward[:, None], np.broadcast_to(rise[:, None], c.shape)
    posture.toes += np.stack([forward * c, forward * s, rise], axis=-1)
    posture.foot_pitch -= angle[:, None]


def _rotate(posture: Posture, back: Floats, turn: Floats) -> None:
    """Rotate somebody upright about the pelvis: ``back``, then ``turn`` about the spine, rad."""
    upright = facing(posture.heading)
    rotation = upright @ rotation_zxy(angles(back, 0.0, turn)) @ upright.swapaxes(-1, -2)
    relative = posture.toes - posture.pelvis[:, None]
    posture.toes = posture.pelvis[:, None] + np.einsum("nij,nkj->nki", rotation, relative)
    posture.foot_pitch -= back[:, None]
    posture.foot_turn += turn[:, None]
    posture.add("pelvis", angles(back, 0.0, turn))
