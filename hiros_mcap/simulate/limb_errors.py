"""The errors of a detector that fits a whole body to every picture, as a Kinect v2 does.

Such a detector errs by limbs, not by joints, and is as sure of what it guesses as of the rest. It
hardly has white noise: it decides where a limb is, keeps to that for a while, and then changes its
mind at once. So, per camera and person,

    v'_k = exp(s_g) R(r_g) v_k,     x'_child = x'_parent + v'_k,     x'_root = x_root + w,

where link k belongs to segment g. The rotation r_g, the log s_g of the scale and the shift w of the
whole body are sums of errors that hold for a time (:func:`~hiros_mcap.simulate.chance.held`):

1. small ones of each segment, of whose variance a part lasts. Both sides share a part of the scale;
   knees slide along the leg.
2. slips of a limb, of the widths, or of the whole body: more often in views from the side and from
   behind.
3. guesses while others cover a share C of the body: of segments whose ends are covered, and of the
   whole body by C^2. A guess has one size: a body that is shifted far is also distorted.

A person is lost at a share of cover that is drawn for each time of cover. Who turns the back is
taken to face the camera for a part of the time. ``benchmarks/detector.py`` holds all this beside
real recordings.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hiros_mcap.body.rotations import from_vector, multiply, rotate
from hiros_mcap.simulate.body_model import MARKERS, MODEL, SIDES, SLOT
from hiros_mcap.simulate.chance import coloured, held, runs
from hiros_mcap.simulate.occlusion import Mask
from hiros_mcap.simulate.settings import LimbErrorParams
from hiros_mcap.skeletons import Floats, Stamps

_COVERED = 0.05  # share of a body that others cover, where a time of cover begins and ends
_SHARED = 0.55  # of the error of a length, what both sides have in common: r = 0.3
_FROM_DEG = (45.0, 90.0, 135.0)  # facing of views from the front, the side, behind
_SIZES = 0.8  # SD of the log of the size of a mistake
_TAKES_PART = 0.7  # probability that a segment takes part in a slip of its group


class Segment(NamedTuple):
    """Links that turn and grow together."""

    name: str
    ends: tuple[str, ...]
    """Markers at the far ends of the links."""
    turns: float = 1.0
    """Errors of the direction beside those of an upper arm (measured)."""
    mistakes: float = 1.0
    """The same of slips and guesses."""
    lengths: float = 1.0
    """Errors of the length beside those of a limb."""


_MIDDLE = (
    Segment("trunk", ("SPINE_NAVAL", "SPINE_CHEST", "NECK"), 0.35, 0.25, 0.8),
    Segment("hips", ("HIP_LEFT", "HIP_RIGHT"), 0.6, 0.4, 2.0),
    Segment(
        "shoulders",
        ("CLAVICLE_LEFT", "CLAVICLE_RIGHT", "SHOULDER_LEFT", "SHOULDER_RIGHT"),
        *(0.5, 0.4, 2.0),
    ),
    Segment("head", ("HEAD", "NOSE", "EYE_LEFT", "EYE_RIGHT", "EAR_LEFT", "EAR_RIGHT"), 0.8, 1.0),
)
_ARM = (
    Segment("upper arm", ("ELBOW",), 1.0, 1.0, 1.5),
    Segment("forearm", ("WRIST",), 0.6, 1.0, 1.5),
    Segment("hand", ("HAND", "HANDTIP", "THUMB"), 0.6, 1.0),
)
_LEG = (
    Segment("thigh", ("KNEE",), 0.8, 0.5),
    Segment("shank", ("ANKLE",), 0.6, 0.5),
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
_WIDTHS, _HEAD = (1, 2), (3,)
_BODY = range(len(SEGMENTS))
_GROUPS = (_LEFT_ARM, _RIGHT_ARM, _LEFT_LEG, _RIGHT_LEG, _WIDTHS, _HEAD, _BODY)
"""Segments that slip together."""


@dataclass(frozen=True, slots=True)
class TrueView:
    """A camera's true view of a person in n frames."""

    positions: Floats
    """(n, M, 3) in the camera's coordinates, m."""
    covered: Mask
    """(n, M) joints that others hide, or that are out of the picture."""
    rate: float
    """Frames per second."""

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
    """What is wrong with a view."""

    turn: Floats
    """(n, G, 3) rotation vector of each segment, rad."""
    scale: Floats
    """(n, G) log of its length beside the true one."""
    shift: Floats
    """(n, 3) of the whole body, m."""

    def add(
        self, weights: Floats, whole: Floats, sizes: tuple[float, float, float], draws: Floats
    ) -> None:
        """Add mistakes, drawn as :func:`_mistakes` does.

        Parameters
        ----------
        weights, whole : (n, G) of the segments, (n, 1) of the shift.
        sizes : SD of angles, deg, of the log of lengths, and of the shift, m.
        """
        angle, length, shift = sizes
        self.turn += np.radians(angle) * (weights * _MISTAKES)[..., None] * draws[:, :-1, :3]
        self.scale += length * weights * _LENGTHS * draws[:, :-1, 3]
        self.shift += shift * whole * draws[:, -1, :3]

    def bend(self, positions: Floats, orientations: Floats) -> None:
        """Put a body, markers (n, M, 3), m, and links (n, L, 4), where the detector sees it."""
        rotation = from_vector(self.turn)
        vectors = positions[:, 1:] - positions[:, MODEL.link_parents]
        vectors = np.exp(self.scale[:, _OF_LINK, None]) * rotate(rotation[:, _OF_LINK], vectors)
        positions[:, 0] += self.shift
        for link, parent in enumerate(MODEL.link_parents):  # parents come first
            positions[:, link + 1] = positions[:, parent] + vectors[:, link]
        orientations[:] = multiply(rotation[:, _OF_LINK], orientations)


def lost(rng: np.random.Generator, view: TrueView, params: LimbErrorParams) -> Mask:
    """(n,) whether the detector has lost somebody because of others in front."""
    share = view.covered.mean(axis=-1)
    gone = np.zeros(len(share), bool)
    for start, stop in runs(share >= _COVERED):
        beyond = np.flatnonzero(share[start:stop] > rng.uniform(*params.loses_at))
        later = round(view.rate * rng.exponential(params.finds_after))
        if len(beyond):
            gone[start + beyond[0] : stop + later] = True
    return gone


def exchanged(rng: np.random.Generator, view: TrueView, share: float, seconds: float) -> Mask:
    """(n,) whether the sides of a person are exchanged, in a ``share`` of the views from behind."""
    decision = held(rng, len(view.positions), view.rate, seconds)
    odds = share * np.interp(view.facing, (45.0, 100.0, 140.0), (0.0, 0.04, 1.0))
    wrong: Mask = rng.random(decision[-1] + 1)[decision] < odds
    return wrong


def errors_of(
    rng: np.random.Generator,
    view: TrueView,
    params: LimbErrorParams,
    *,
    noise: float,
    guesses: float,
) -> LimbErrors:
    """Draw the errors of a view; ``noise`` and ``guesses`` scale them."""
    errors = _small_errors(rng, view, params, noise)
    _slip(rng, errors, view, params, noise)
    _guess(rng, errors, view, params, guesses)
    return errors


def _small_errors(
    rng: np.random.Generator, view: TrueView, params: LimbErrorParams, noise: float
) -> LimbErrors:
    """Return what every segment is off by all the time."""
    sideways = np.interp(view.facing, _FROM_DEG[:2], (0.0, 1.0))
    more = noise * (1 + params.aside * sideways[:, None])
    turn = np.radians(params.direction) * _TURNS[:, None] * _drawn(rng, view, params, 3)
    own, common = _drawn(rng, view, params, 2).transpose(2, 0, 1)
    common[:, [*_RIGHT_ARM, *_RIGHT_LEG]] = common[:, [*_LEFT_ARM, *_LEFT_LEG]]
    scale = params.length * _LENGTHS * (np.sqrt(1 - _SHARED**2) * own + _SHARED * common)
    scale[:, list(_WIDTHS)] *= 1 + params.aside * sideways[:, None]
    slides = params.slide * _drawn(rng, view, params, 1)[..., 0]
    for thigh, shank, _ in (_LEFT_LEG, _RIGHT_LEG):
        scale[:, thigh] += slides[:, thigh]
        scale[:, shank] -= slides[:, thigh]
    shift = noise * params.shift * _drawn(rng, view, params, 3)[:, 0]
    return LimbErrors(more[..., None] * turn, more * scale, shift)


def _drawn(rng: np.random.Generator, view: TrueView, params: LimbErrorParams, k: int) -> Floats:
    """(n, G, k) numbers of SD 1 that hold for a time; a part of the variance lasts."""
    n, memory = len(view.positions), float(np.exp(-1 / (view.rate * params.lasting_seconds)))
    quick = np.empty((n, len(SEGMENTS), k))
    for segment in range(len(SEGMENTS)):
        decision = held(rng, n, view.rate, params.seconds)
        size = np.exp(_SIZES * rng.standard_normal((decision[-1] + 1, 1)) - _SIZES**2)
        quick[:, segment] = (size * rng.standard_normal((len(size), k)))[decision]
    slow = coloured(rng, quick.shape, memory)
    mixed: Floats = np.sqrt(1 - params.lasting) * quick + np.sqrt(params.lasting) * slow
    return mixed


def _slip(
    rng: np.random.Generator,
    errors: LimbErrors,
    view: TrueView,
    params: LimbErrorParams,
    noise: float,
) -> None:
    """Let limbs, the widths, and the whole body be somewhere else for a while."""
    n = len(view.positions)
    per_minute = np.interp(view.facing, _FROM_DEG, params.slips_per_minute)
    odds = per_minute * params.slip_seconds / 60
    sizes = params.slip_angle, params.slip_length, params.slip_shift
    for group in _GROUPS:
        decision = held(rng, n, view.rate, params.slip_seconds)
        slips, draws = _mistakes(rng, decision)
        takes_part = np.zeros((len(draws), len(SEGMENTS)))
        takes_part[:, group] = rng.random((len(draws), len(group))) < _TAKES_PART
        slipped: Floats = np.where(slips < odds, noise, 0.0)[:, None]
        whole = slipped if group is _BODY else np.zeros_like(slipped)
        errors.add(slipped * takes_part[decision], whole, sizes, draws[decision])


def _guess(
    rng: np.random.Generator,
    errors: LimbErrors,
    view: TrueView,
    params: LimbErrorParams,
    scale: float,
) -> None:
    """Guess what others cover."""
    decision = held(rng, len(view.positions), view.rate, params.guess_seconds)
    chance, draws = _mistakes(rng, decision)
    hidden = np.zeros((len(draws), view.covered.shape[1]))
    np.add.at(hidden, decision, view.covered)
    covered: Floats = np.asarray(hidden / np.bincount(decision)[:, None])[decision]
    whole: Floats = np.asarray(covered.mean(axis=-1, keepdims=True))
    ends = np.stack([covered[:, markers].mean(axis=-1) for markers in _ENDS], axis=-1)
    wrong: Floats = np.where(chance[:, None] < params.guess_odds * whole, scale, 0.0)
    sizes = params.guess_angle, params.guess_length, params.guess_shift
    errors.add(wrong * np.maximum(ends, whole), wrong * whole, sizes, draws[decision])


def _mistakes(rng: np.random.Generator, decision: Stamps) -> tuple[Floats, Floats]:
    """(n,) numbers from 0 to 1 of the decisions, and (D, G + 1, 4) draws, each of one size."""
    count = decision[-1] + 1
    size = np.exp(_SIZES * rng.standard_normal((count, 1, 1)))
    draws = size * rng.standard_normal((count, len(SEGMENTS) + 1, 4))
    return rng.random(count)[decision], draws
