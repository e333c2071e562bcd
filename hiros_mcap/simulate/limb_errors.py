"""The errors of a detector that fits a whole body to every picture, as a Kinect v2 does.

Such a detector errs by limbs, not by joints, and is as sure of what it guesses as of the rest. It
hardly has white noise: it decides where a limb is, keeps to that, and then changes its mind at
once, above all while somebody moves. Per camera and person,

    v'_k = exp(s_g) R(r_g) v_k,     x'_child = x'_parent + v'_k,     x'_root = x_root + w,

where link k belongs to segment g. The rotation r_g, the log s_g of the scale and the shift w of the
whole body are sums of errors that hold until the next decision
(:func:`~hiros_mcap.simulate.chance.held`):

1. small ones of each segment. A part of their variance lasts. Both sides share a part of the scale;
   knees slide along the leg.
2. slips of a limb, of the widths, or of the whole body. Only decisions that movement brings are
   slips, more often in views from the side and from behind.
3. guesses while others cover a share C of the body: of segments whose ends are covered, and of the
   whole body by C. A guess has one size: a body that is shifted far is also distorted.

Slips and guesses are mistakes. They make hips and shoulders narrower: the far side of a body is put
too close to the near one. Each time that others cover a person, the share at which the detector
loses the person is drawn. Who turns the back seems to face the camera for a part of the time.
``benchmarks/detector.py`` compares all this with real recordings.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hiros_mcap.body.rotations import from_vector, multiply, rotate
from hiros_mcap.simulate.body_model import MARKERS, MODEL, SIDES, SLOT
from hiros_mcap.simulate.chance import held, runs
from hiros_mcap.simulate.occlusion import Mask
from hiros_mcap.skeletons import Floats, Stamps

# Measured on 32 minutes of views in 19 recordings by two Kinect v2 each: lengths against the
# person's own, positions between the cameras and against the fused result. SDs are per axis.
_SHIFT = 0.008  # SD of the shift of the body, m (between two cameras 23 to 28 mm, poses included)
_DIRECTION = np.radians(2.3)  # SD of the direction of an upper arm or a thigh
_LENGTH_SD = 0.02  # relative SD of a limb's length (robust SD of all errors: .03 to .07)
_SHARED = 0.55  # share of a length's SD that both sides have in common: their r is its square, .3
_SLIDE = 0.025  # relative SD by which a knee slides along the leg (thigh, shank: r = -.35 to -.64)
_ASIDE = 1.0  # how much more directions and lengths err from the side and from behind (.3 to 2)
_FROM_DEG = (45.0, 90.0, 135.0)  # facing of views from the front, the side, behind
_STANDING_SECONDS = 1.2
"""s; mean time for which a decision holds while somebody stands (95 % of second differences of a
hand: 24 mm)."""
_MOVING_SECONDS = 0.15  # the same of somebody who moves fast (faster than .3 m/s: 129 mm)
_MOVES = 0.3  # m/s, mean of the joints, at which movement brings half of its most decisions
_LASTING = 0.1  # share of their variance that lasts (autocorrelation .2 to .5 after 1 s)
_LASTING_SECONDS = 20.0  # s, for which the lasting part holds (recordings: 15 to 100 s)
_SLIPS = (0.08, 0.12, 0.15)
"""Probability that a decision which movement brings is a slip: from the front, from the side, from
behind. Of the wrists of people faster than .3 m/s, 6, 10 and 12 % are off by more than .2 m."""
_SLIP_SHIFT = 0.035  # m, of the body in a slip (99 % of second differences of a trunk: 36 to 82 mm)
_TAKES_PART = 0.7  # probability that a segment takes part in a slip of its group
_SIZES = 0.3  # SD of the log of the size of a mistake; the SDs below are those of the median size
_ANGLE = np.radians(30.0)  # SD of a segment's direction in a mistake (peaks of .34 m)
_LOG_LENGTH = 0.2  # SD of the log of its length (99 % of lengths are off by 17 to 34 %)
_NARROW = 0.5
"""SD of the share of the width of hips and shoulders that a mistake loses: 5 % of those from the
side are short by 25 to 42 %, hardly any is too long."""
_NARROWEST = 0.6  # share of a width that is lost at most
_GUESS_ODDS = 2.0  # probability of a wrong guess to the covered share of the body
_GUESS_SHIFT = 0.3
"""m; SD of the shift of a body to its covered share (at .25 to .45: median 50 to 59, 90 % 138 to
180 mm)."""
_COVERED = 0.2  # share of a body that others cover, where a time of cover begins and ends
_LOST_AT = (0.3, 0.8)
"""Share of a body that others cover when it is lost: least, most. Reported are 80 % of those who
are covered by .1 to .25, 25 % by .45 to .7."""
_FOUND_AFTER = 0.5  # s; mean time after which who is uncovered is found again (.3 to 1.8)
_EXCHANGED_SECONDS = 0.5  # s; mean time between two decisions on the sides (exchanges: median .7)


class Segment(NamedTuple):
    """Links that turn and grow together."""

    name: str
    ends: tuple[str, ...]  # markers at the far ends of the links
    turns: float = 1.0  # small errors of the direction, times those of an upper arm (measured)
    mistakes: float = 1.0  # the same of slips and guesses
    lengths: float = 1.0  # errors of the length, times those of a leg


_MIDDLE = (
    Segment("trunk", ("SPINE_NAVAL", "SPINE_CHEST", "NECK"), 0.35, 0.4, 0.3),
    Segment("hips", ("HIP_LEFT", "HIP_RIGHT"), 0.6, 0.4, 0.5),
    Segment(
        "shoulders",
        ("CLAVICLE_LEFT", "CLAVICLE_RIGHT", "SHOULDER_LEFT", "SHOULDER_RIGHT"),
        *(0.5, 0.4, 0.4),
    ),
    Segment("head", ("HEAD", "NOSE", "EYE_LEFT", "EYE_RIGHT", "EAR_LEFT", "EAR_RIGHT"), 0.8, 1.0),
)
_ARM = (
    Segment("upper arm", ("ELBOW",)),
    Segment("forearm", ("WRIST",), 0.6),
    Segment("hand", ("HAND", "HANDTIP", "THUMB"), 0.6),
)
_LEG = (
    Segment("thigh", ("KNEE",), 0.8, 0.8),
    Segment("shank", ("ANKLE",), 0.6, 0.8),
    Segment("foot", ("FOOT",), 0.8, 0.8),
)
SEGMENTS = _MIDDLE + tuple(
    segment._replace(ends=tuple(f"{end}_{side}" for end in segment.ends))
    for limb in (_ARM, _LEG)
    for side in SIDES
    for segment in limb
)
"""G segments: the middle, left and right arm, left and right leg."""
_TURNS, _MISTAKES, _LENGTHS = np.array([segment[2:] for segment in SEGMENTS]).T
_ENDS = np.array([[marker in segment.ends for marker in MARKERS] for segment in SEGMENTS])
_OF_LINK = _ENDS[:, 1:].argmax(axis=0)
_LEFT_ARM, _RIGHT_ARM, _LEFT_LEG, _RIGHT_LEG = (range(k, k + 3) for k in (4, 7, 10, 13))
_WIDTHS, _HEAD = [1, 2], (3,)
_BODY = range(len(SEGMENTS))
_GROUPS = (_LEFT_ARM, _RIGHT_ARM, _LEFT_LEG, _RIGHT_LEG, _WIDTHS, _HEAD, _BODY)
"""Segments that slip together."""


@dataclass(frozen=True, slots=True)
class TrueView:
    """A camera's true view of a person in n frames."""

    positions: Floats  # (n, M, 3) in the camera's coordinates, m
    covered: Mask  # (n, M) joints that others hide, or that are out of the picture
    rate: float  # frames per second

    @property
    def speed(self) -> Floats:
        """(n,) mean speed of the joints, m/s."""
        steps = np.linalg.norm(np.diff(self.positions, axis=0), axis=-1).mean(axis=-1)
        speeds: Floats = self.rate * np.r_[steps[:1], steps] if len(steps) else np.zeros(1)
        return speeds

    @property
    def facing(self) -> Floats:
        """(n,) angle between where the body faces and the camera, deg; 0 = it faces the camera."""
        across = self.positions[:, SLOT["HIP_RIGHT"]] - self.positions[:, SLOT["HIP_LEFT"]]
        ray = self.positions[:, 0]
        # x is right in the picture, z away: who faces the camera has the right hip on its left.
        lateral = across[:, 2] * ray[:, 0] - across[:, 0] * ray[:, 2]
        lengths = np.hypot(*across[:, [0, 2]].T) * np.hypot(*ray[:, [0, 2]].T)
        cosines = np.clip(lateral / np.maximum(lengths, 1e-9), -1, 1)
        angles: Floats = np.degrees(np.arccos(cosines))
        return angles


@dataclass(slots=True)
class LimbErrors:
    """The errors of a view."""

    turn: Floats  # (n, G, 3) rotation vector of each segment, rad
    scale: Floats  # (n, G) log of its length beside the true one
    shift: Floats  # (n, 3) of the whole body, m
    joints: Floats  # (n, M, 3) of each joint by itself, m

    def scaled(self, noise: float) -> LimbErrors:
        """Return all errors, ``noise`` times as large."""
        return LimbErrors(
            *(noise * part for part in (self.turn, self.scale, self.shift, self.joints))
        )

    def add(self, sizes: Floats, draws: Floats) -> None:
        """Add mistakes to segments.

        Parameters
        ----------
        sizes : (n, G) of usual mistakes; 0 = none.
        draws : (n, G + 1, 4) as :func:`_mistakes` makes them.
        """
        angles = _ANGLE * sizes * _MISTAKES
        self.turn += angles[..., None] * draws[:, :-1, :3]
        lengths = sizes * draws[:, :-1, 3]
        scale = _LOG_LENGTH * lengths
        narrower = _NARROW * np.abs(lengths[:, _WIDTHS])
        scale[:, _WIDTHS] = np.log1p(-np.minimum(narrower, _NARROWEST))
        self.scale += scale

    def bend(self, positions: Floats, orientations: Floats) -> None:
        """Put a body, markers (n, M, 3), m, and links (n, L, 4), where the detector sees it."""
        rotation = from_vector(self.turn)
        vectors = positions[:, 1:] - positions[:, MODEL.link_parents]
        vectors = np.exp(self.scale[:, _OF_LINK, None]) * rotate(rotation[:, _OF_LINK], vectors)
        positions[:, 0] += self.shift
        for link, parent in enumerate(MODEL.link_parents):  # parents come first
            positions[:, link + 1] = positions[:, parent] + vectors[:, link]
        positions += self.joints
        orientations[:] = multiply(rotation[:, _OF_LINK], orientations)


def lost(rng: np.random.Generator, view: TrueView) -> Mask:
    """(n,) whether the detector has lost somebody because of others in front."""
    share = view.covered.mean(axis=-1)
    gone = np.zeros(len(share), bool)
    for start, stop in runs(share >= _COVERED):
        beyond = np.flatnonzero(share[start:stop] > rng.uniform(*_LOST_AT))
        later = round(view.rate * rng.exponential(_FOUND_AFTER))
        if len(beyond):
            gone[start + beyond[0] : stop + later] = True
    return gone


def exchanged(rng: np.random.Generator, view: TrueView, share: float) -> Mask:
    """(n,) whether the sides of a person are exchanged, in a ``share`` of the views from behind."""
    per_frame = 1 / (view.rate * _EXCHANGED_SECONDS)
    decision = held(rng, np.full(len(view.positions), per_frame))
    odds = share * np.interp(view.facing, (45.0, 100.0, 140.0), (0.0, 0.04, 1.0))
    wrong: Mask = rng.random(decision[-1] + 1)[decision] < odds
    return wrong


class Pace(NamedTuple):
    """How often a detector decides anew about a person."""

    per_frame: Floats  # (n,) decisions in a frame, on average
    moving: Floats  # (n,) share of them that movement brings

    @classmethod
    def of(cls, view: TrueView) -> Pace:
        """Return the pace of a view."""
        moves = 1 / (1 + (_MOVES / np.maximum(view.speed, 1e-9)) ** 2)
        moving = moves / _MOVING_SECONDS
        both = 1 / _STANDING_SECONDS + moving
        return cls(both / view.rate, moving / both)


def draw_errors(
    rng: np.random.Generator, view: TrueView, joint: float, *, noise: float, guesses: float
) -> LimbErrors:
    """Draw the errors of a view; ``noise`` and ``guesses`` scale them.

    ``joint`` : SD of each joint by itself, per axis, m.
    """
    pace = Pace.of(view)
    errors = _small_errors(rng, view, pace, joint).scaled(noise)
    _slip(rng, errors, view, pace, noise)
    _guess(rng, errors, view, pace, guesses)
    return errors


def _small_errors(rng: np.random.Generator, view: TrueView, pace: Pace, joint: float) -> LimbErrors:
    """Return what every segment is off by all the time."""
    sideways = np.interp(view.facing, _FROM_DEG[:2], (0.0, 1.0))
    more = 1 + _ASIDE * sideways[:, None]
    turn = _DIRECTION * _TURNS[:, None] * _drawn(rng, pace, 3)
    own, common = _drawn(rng, pace, 2).transpose(2, 0, 1)
    common[:, [*_RIGHT_ARM, *_RIGHT_LEG]] = common[:, [*_LEFT_ARM, *_LEFT_LEG]]
    scale = _LENGTH_SD * _LENGTHS * (np.sqrt(1 - _SHARED**2) * own + _SHARED * common)
    slides = _SLIDE * _drawn(rng, pace, 1)[..., 0]
    for thigh, shank, _ in (_LEFT_LEG, _RIGHT_LEG):
        scale[:, thigh] += slides[:, thigh]
        scale[:, shank] -= slides[:, thigh]
    shift = _SHIFT * _drawn(rng, pace, 3)[:, 0]
    joints = joint * _lasting(rng, pace, (len(MARKERS), 3))
    return LimbErrors(more[..., None] * turn, more * scale, shift, joints)


def _drawn(rng: np.random.Generator, pace: Pace, k: int) -> Floats:
    """(n, G, k) numbers of SD 1 that hold for a time; a part of the variance lasts."""
    quick = np.empty((len(pace.per_frame), len(SEGMENTS), k))
    for segment in range(len(SEGMENTS)):
        decision = held(rng, pace.per_frame)
        # Minus the variance: the mean square of a size is 1.
        size = np.exp(_SIZES * rng.standard_normal((decision[-1] + 1, 1)) - _SIZES**2)
        quick[:, segment] = (size * rng.standard_normal((len(size), k)))[decision]
    slow = _lasting(rng, pace, (len(SEGMENTS), k))
    mixed: Floats = np.sqrt(1 - _LASTING) * quick + np.sqrt(_LASTING) * slow
    return mixed


def _lasting(rng: np.random.Generator, pace: Pace, shape: tuple[int, int]) -> Floats:
    """(n, K, k) numbers of SD 1 that hold for long."""
    per_frame = pace.per_frame * _STANDING_SECONDS / _LASTING_SECONDS
    numbers = np.empty((len(per_frame), *shape))
    for row in range(shape[0]):
        decision = held(rng, per_frame)
        numbers[:, row] = rng.standard_normal((decision[-1] + 1, shape[1]))[decision]
    return numbers


def _slip(
    rng: np.random.Generator, errors: LimbErrors, view: TrueView, pace: Pace, noise: float
) -> None:
    """Let limbs, the widths, and the whole body be somewhere else for a while."""
    odds = np.interp(view.facing, _FROM_DEG, _SLIPS) * pace.moving
    for group in _GROUPS:
        decision = held(rng, pace.per_frame)
        chance, draws = _mistakes(rng, decision)
        takes_part = np.zeros((len(draws), len(SEGMENTS)))
        takes_part[:, group] = rng.random((len(draws), len(group))) < _TAKES_PART
        slipped: Floats = np.where(chance < odds, noise, 0.0)[:, None]
        errors.add(slipped * takes_part[decision], draws[decision])
        if group is _BODY:
            errors.shift += slipped * _SLIP_SHIFT * draws[decision, -1, :3]


def _guess(
    rng: np.random.Generator, errors: LimbErrors, view: TrueView, pace: Pace, scale: float
) -> None:
    """Guess what others cover."""
    decision = held(rng, pace.per_frame)
    chance, draws = _mistakes(rng, decision)
    hidden = np.zeros((len(draws), view.covered.shape[1]))
    np.add.at(hidden, decision, view.covered)
    covered: Floats = np.asarray(hidden / np.bincount(decision)[:, None])[decision]
    whole: Floats = np.asarray(covered.mean(axis=-1, keepdims=True))
    ends = np.stack([covered[:, markers].mean(axis=-1) for markers in _ENDS], axis=-1)
    wrong: Floats = np.where(chance[:, None] < _GUESS_ODDS * whole, scale, 0.0)
    errors.add(wrong * np.maximum(ends, whole), draws[decision])
    errors.shift += wrong * whole * _GUESS_SHIFT * draws[decision, -1, :3]


def _mistakes(rng: np.random.Generator, decision: Stamps) -> tuple[Floats, Floats]:
    """(n,) chance, from 0 to 1, of each frame's decision, and (D, G + 1, 4) draws of all decisions.

    Three draws are for a direction or a shift, one is for a length; the last row is the body's.
    """
    count = decision[-1] + 1
    size = np.exp(_SIZES * rng.standard_normal((count, 1, 1)))
    draws = size * rng.standard_normal((count, len(SEGMENTS) + 1, 4))
    return rng.random(count)[decision], draws
