"""A camera's detector: its report of the people whom it sees, with all its faults.

The faults come in the order of a real detector: it confuses the sides of a person, adds errors to
seen and guessed joints, loses people and finds them again in a wrong pose, and adds phantoms.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields

import numpy as np

from hiros_mcap.body.rotations import conjugate, from_matrix, from_vector, multiply, rotate
from hiros_mcap.simulate.body_model import LINK_SEGMENTS, MARKERS, MODEL, SLOT, SYMMETRY, BodyModel
from hiros_mcap.simulate.cameras import SimulatedCamera, seconds_since, stream
from hiros_mcap.simulate.chance import coloured, episodes, runs
from hiros_mcap.simulate.limb_errors import TrueView, draw_errors, exchanged, lost
from hiros_mcap.simulate.motion import Person, standing
from hiros_mcap.simulate.occlusion import Mask, Sight, sight_of
from hiros_mcap.simulate.paths import Spot
from hiros_mcap.simulate.settings import PHANTOMS_PER_MINUTE, CameraKind, SimulateParams
from hiros_mcap.skeletons import Floats

_SHARE_INSIDE = 0.5  # a body of which less than this is in the picture is not detected
REFERENCE_RANGE = 3.5
"""m, where the errors have their nominal size."""
_SPAWN_ROTATION = np.radians(25.0)  # SD per axis of the link orientations of a wrong first pose
_FRONT_FLIP_SHARE = 0.2  # flips are this much rarer when the camera sees the face
_HALF_ROTATION = np.array([0.0, 1.0, 0.0, 0.0])  # about a segment's own long axis
_BEHIND = 2.0  # m, of the ring of cameras, where others do not look
_EXCHANGED: Mapping[CameraKind, float] = {"depth": 0.45, "rgb": 0.1}
"""Share of the views from behind with exchanged sides (kinect). Measured: .45 of a Kinect v2;
MediaPipe did so in 6 of 400 images of one person, all of one camera."""
_SEEN, _GUESSED = 0.66, 0.33
"""Confidence of a joint that is seen, and of one that is hidden; out of the picture it is 0."""
GUESS_EXTREMITIES = 2.2
"""How much larger the error of guessed hands and feet is than that of a guessed trunk."""
_GUESSED_ROTATION = 8.0  # deg; SD of a hidden link's additional orientation error, per axis
_MOST_HIDDEN = 0.7  # a person is not detected if others hide more than this share
_PHANTOM_FRAMES = (2, 8)  # how many a phantom lasts
_DOUBLES = 0.5  # share of phantoms that are a second skeleton on a real person
_STATIC_PRESENCE = 0.9  # share of frames in which a static phantom is reported
_REVERSED = [SLOT[name] for name in ("NOSE", "EYE_LEFT", "EYE_RIGHT", "FOOT_LEFT", "FOOT_RIGHT")]
_PARENTS = np.array(MODEL.link_parents)


def _extremity(marker: str) -> float:
    """How far out on a limb a joint is: 0 on the trunk and the head, 1 on hands and feet."""
    part = marker.split("_")[0]
    outwards = {"SHOULDER": 0.2, "ELBOW": 0.5, "KNEE": 0.5, "WRIST": 0.8, "ANKLE": 0.8}
    ends = dict.fromkeys(("HAND", "HANDTIP", "THUMB", "FOOT"), 1.0)
    return {**outwards, **ends}.get(part, 0.0)


EXTREMITY = np.array([_extremity(marker) for marker in MARKERS])
"""(M,) 0 on the trunk, 1 on hands and feet."""


@dataclass(slots=True)
class SimulatedDetections:
    """The report of P detections in n frames, in the camera's coordinates."""

    positions: Floats  # (n, P, M, 3) m
    orientations: Floats  # (n, P, L, 4) unit quaternions x y z w
    confidences: Floats  # (n, P, M)
    guessed: Mask  # (n, P, M) whether the joint is not seen but guessed
    present: Mask  # (n, P) whether the body is reported at all; the rest is meaningless where not

    @classmethod
    def of(cls, n: int, people: int) -> SimulatedDetections:
        """Return detections that are all present and seen, with positions to be filled in."""
        return cls(
            np.empty((n, people, MODEL.n_markers, 3)),
            np.empty((n, people, MODEL.n_links, 4)),
            np.full((n, people, MODEL.n_markers), _SEEN),
            np.zeros((n, people, MODEL.n_markers), bool),
            np.ones((n, people), bool),
        )

    def beside(self, others: list[SimulatedDetections]) -> SimulatedDetections:
        """All sets of detections as one."""
        sets = [self, *others]
        columns = ([getattr(each, field.name) for each in sets] for field in fields(self))
        return SimulatedDetections(*(np.concatenate(column, axis=1) for column in columns))


def detect(
    people: Sequence[Person], camera: SimulatedCamera, params: SimulateParams
) -> SimulatedDetections:
    """Return everything that a camera reports, in its nominal frames."""
    detections = observe(people, camera, params)
    if params.detector.kind == "kinect":
        _fit(detections, camera, params)
        return detections.beside(phantoms(detections, camera, params))
    _hide(detections, params)
    _flip(detections, camera, params)
    _disturb(detections, camera, params)
    _lose(detections, camera, params)
    _respawn(detections, camera, params)
    return detections.beside(phantoms(detections, camera, params))


def observe(
    people: Sequence[Person], camera: SimulatedCamera, params: SimulateParams
) -> SimulatedDetections:
    """Return the truth in the camera's coordinates at the times of its nominal frames."""
    t = seconds_since(params.start, camera.captured)
    detections = SimulatedDetections.of(len(t), len(people))
    to_camera = conjugate(camera.pose.xyzw)
    for slot, person in enumerate(people):
        markers, rotations = person.pose(t)
        detections.positions[:, slot] = camera.points(markers)
        turned = multiply(to_camera, from_matrix(rotations))
        detections.orientations[:, slot] = turned[:, LINK_SEGMENTS]
    return detections


def _hide(detections: SimulatedDetections, params: SimulateParams) -> None:
    """Decide which bodies are detected and which of their joints are guessed."""
    solid = params.occlusion > 0
    sight = sight_of(detections.positions, params.rig, solid=solid)
    detections.present &= is_detected(sight)
    if solid:
        detections.guessed[:] = sight.hidden | ~sight.framed
        detections.confidences[sight.hidden] = _GUESSED
        detections.confidences[~sight.framed] = 0.0


def _fit(detections: SimulatedDetections, camera: SimulatedCamera, params: SimulateParams) -> None:
    """Report bodies as a detector does that fits them whole; see :mod:`limb_errors`."""
    joint, rate = params.detector.joint, params.rig.rate
    sight = sight_of(detections.positions, params.rig, solid=params.occlusion > 0)
    detections.present &= sight.framed.mean(-1) >= _SHARE_INSIDE
    detections.confidences[:] = 1.0
    for person in range(detections.present.shape[1]):
        rng = stream(params.seed, "limbs", camera.index, person)
        positions = detections.positions[:, person]
        hidden = sight.covered[:, person] | (~sight.framed[:, person] & (params.occlusion > 0))
        view = TrueView(positions.copy(), hidden, rate)
        detections.guessed[:, person] = hidden
        errors = draw_errors(rng, view, joint, noise=params.noise, guesses=params.occlusion)
        errors.bend(positions, detections.orientations[:, person])
        share = min(params.flips * _EXCHANGED[camera.kind], 1.0)
        for start, stop in runs(exchanged(rng, view, share)):
            swap_sides(detections, slice(start, stop), person)
            reverse_facing(detections, slice(start, stop), person)
        if params.dropouts > 0:
            detections.present[:, person] &= ~lost(rng, view)
    _lose(detections, camera, params)


def is_detected(sight: Sight) -> Mask:
    """(n, P) whether enough of a body is in the picture, and not behind others."""
    inside = sight.framed.mean(-1)
    clear = (sight.framed & ~sight.covered).mean(-1)
    detected: Mask = (inside >= _SHARE_INSIDE) & (clear >= (1 - _MOST_HIDDEN) * inside)
    return detected


def _flip(detections: SimulatedDetections, camera: SimulatedCamera, params: SimulateParams) -> None:
    """Confuse left and right for a while, mostly of people seen from behind."""
    detector, rate = params.detector, params.rig.rate
    often = params.flips * detector.flips_per_minute / (60 * rate)
    frames = (detector.flip_seconds[0] * rate, detector.flip_seconds[1] * rate)
    n, people = detections.present.shape
    across = np.diff(detections.positions[..., [SLOT["HIP_LEFT"], SLOT["HIP_RIGHT"]], 0], axis=-1)
    for person in range(people):
        rng = stream(params.seed, "flips", camera.index, person)
        free = 0
        for start, stop in episodes(rng, n, often, frames):
            reversed_, reluctant = rng.random() < detector.reversal_share, rng.random()
            from_behind = across[start, person, 0] > 0
            if start < free or not (from_behind or reluctant < _FRONT_FLIP_SHARE):
                continue
            swap_sides(detections, slice(start, stop), person)
            if reversed_:
                reverse_facing(detections, slice(start, stop), person)
            free = stop


def swap_sides(detections: SimulatedDetections, frames: slice, person: int) -> None:
    """Give every left joint and link the place of the right one and vice versa."""
    for series in (detections.positions, detections.confidences, detections.guessed):
        series[frames, person] = series[frames, person][:, SYMMETRY.mirror]
    links = detections.orientations
    links[frames, person] = links[frames, person][:, SYMMETRY.link_mirror]


def reverse_facing(detections: SimulatedDetections, frames: slice, person: int) -> None:
    """Let a body whose sides are swapped face the other way: links, face and feet."""
    positions = detections.positions[frames, person]
    orientations = detections.orientations[frames, person]
    for marker in _REVERSED:
        parent, link = _PARENTS[marker - 1], marker - 1
        offset = positions[:, marker] - positions[:, parent]
        axis = rotate(orientations[:, link], np.array([0.0, 1.0, 0.0]))
        along = (offset * axis).sum(-1, keepdims=True) * axis
        positions[:, marker] = positions[:, parent] + 2 * along - offset
    orientations[:] = multiply(orientations, _HALF_ROTATION)


def _disturb(
    detections: SimulatedDetections, camera: SimulatedCamera, params: SimulateParams
) -> None:
    """Add noise and bias to everything, and more to what is guessed."""
    d = params.detector
    distance = np.linalg.norm(detections.positions[:, :, 0], axis=-1)[..., None, None]
    growth = (distance / REFERENCE_RANGE) ** d.range_growth
    wide = params.noise * (1 + (d.extremities - 1) * EXTREMITY[:, None])
    far = params.occlusion * (1 + (GUESS_EXTREMITIES - 1) * EXTREMITY[:, None])
    joints = d.coloured * wide * growth, d.white * wide * growth, d.bias * wide, d.guess * far
    rng = stream(params.seed, "joint errors", camera.index)
    detections.positions += _errors(rng, joints, detections.guessed, params)
    wide, far = np.radians(wide[1:]), np.radians(far[1:])
    links = (
        d.orientation_coloured * wide * growth,
        d.orientation_white * wide * growth,
        d.orientation_bias * wide,
        _GUESSED_ROTATION * far,
    )
    rng = stream(params.seed, "link errors", camera.index)
    rotation = _errors(rng, links, guessed_links(detections.guessed), params)
    detections.orientations[:] = multiply(from_vector(rotation), detections.orientations)


def _errors(
    rng: np.random.Generator, sds: Sequence[Floats], guessed: Mask, params: SimulateParams
) -> Floats:
    """Errors (n, P, K, 3) of K joints or links, correlated over the n frames.

    ``sds`` are those per axis of the slow part, the white part, the bias and the guesses, m or rad,
    broadcastable to (n, P, K, 1).
    """
    slow, white, bias, guesses = sds
    rate, detector, shape = params.rig.rate, params.detector, (*guessed.shape, 3)
    errors = slow * coloured(rng, shape, detector.correlation ** (30 / rate))
    errors += white * rng.standard_normal(shape)
    errors += bias * coloured(rng, shape, float(np.exp(-1 / (rate * detector.bias_seconds))))
    guess = coloured(rng, shape, float(np.exp(-1 / (rate * detector.guess_seconds))))
    errors += np.where(guessed[..., None], guesses * guess, 0.0)
    return errors


def guessed_links(guessed: Mask) -> Mask:
    """(..., L) a link is guessed when one of its two joints is, given those (..., M)."""
    either: Mask = guessed[..., 1:] | guessed[..., _PARENTS]
    return either


def _lose(detections: SimulatedDetections, camera: SimulatedCamera, params: SimulateParams) -> None:
    """Lose people who are in full view."""
    detector, rate = params.detector, params.rig.rate
    often = params.dropouts * detector.losses_per_minute / (60 * rate)
    frames = (detector.loss_seconds[0] * rate, detector.loss_seconds[1] * rate)
    n, people = detections.present.shape
    for person in range(people):
        rng = stream(params.seed, "losses", camera.index, person)
        for start, stop in episodes(rng, n, often, frames):
            detections.present[start:stop, person] = False


def _respawn(
    detections: SimulatedDetections, camera: SimulatedCamera, params: SimulateParams
) -> None:
    """Start every body that re-appears in a wrong pose that settles within some frames."""
    low, high = params.detector.spawn_frames
    strength = min(1.0, params.dropouts)
    for person in range(detections.present.shape[1]):
        rng = stream(params.seed, "spawns", camera.index, person)
        here = detections.present[:, person]
        for start in np.flatnonzero(here[1:] & ~here[:-1]) + 1:
            frames = slice(start, start + int(rng.integers(low, high + 1)))
            whole = rng.standard_normal((1, 3))
            joints = rng.standard_normal((MODEL.n_markers, 3))
            links = rng.standard_normal((MODEL.n_links, 3))
            length = len(detections.positions[frames])
            fade = strength * np.linspace(1, 0, length, endpoint=False)[:, None, None]
            error = params.detector.spawn_error * (whole + joints) / np.sqrt(2)
            detections.positions[frames, person] += fade * error
            rotation = from_vector(fade * _SPAWN_ROTATION * links)
            detections.orientations[frames, person] = multiply(
                rotation, detections.orientations[frames, person]
            )


def phantoms(
    detections: SimulatedDetections, camera: SimulatedCamera, params: SimulateParams
) -> list[SimulatedDetections]:
    """Report people who are not there: a static one, and brief ones, some beside a real person."""
    detector, rate, radius = params.detector, params.rig.rate, params.rig.radius
    n, people = len(detections.present), []
    if camera.index < detector.static_phantoms and params.phantoms > 0:
        rng = stream(params.seed, "static phantom", camera.index)
        behind = radius + _BEHIND if camera.kind == "rgb" else 0.0
        static = _standing_phantom(n, camera, params, rng, behind)
        static.present[:, 0] = rng.random(n) < _STATIC_PRESENCE
        people.append(static)
    rng = stream(params.seed, "phantoms", camera.index)
    often = params.phantoms * PHANTOMS_PER_MINUTE / (60 * rate)
    for start, stop in episodes(rng, n, often, _PHANTOM_FRAMES):
        phantom = _standing_phantom(n, camera, params, rng)
        double = rng.random() < _DOUBLES
        owners = np.flatnonzero(detections.present[start])
        if double and len(owners):
            owner = int(rng.choice(owners))
            shift = detector.spawn_error * rng.standard_normal(3)
            phantom.positions[:, 0] += (
                detections.positions[:, owner] + shift - phantom.positions[start, 0]
            )
            phantom.orientations[:, 0] = detections.orientations[:, owner]
        phantom.present[:start] = phantom.present[stop:] = False
        people.append(phantom)
    return people


def _standing_phantom(
    n: int,
    camera: SimulatedCamera,
    params: SimulateParams,
    rng: np.random.Generator,
    behind: float = 0.0,
) -> SimulatedDetections:
    """Report somebody who stands still in front of the camera, beyond the middle of the room."""
    body, radius = BodyModel.of(rng.uniform(*params.heights)), params.rig.radius
    x, y, _ = camera.pose.translation
    bearing = np.arctan2(-y, -x) + rng.uniform(-0.9, 0.9)
    away = behind + radius * rng.uniform(0.1, 0.5)
    spot = Spot(away * np.cos(bearing), away * np.sin(bearing), rng.uniform(-np.pi, np.pi))
    still = Person(body, lambda t: standing(body, spot, t))
    markers, rotations = still.pose(np.zeros(1))
    phantom = SimulatedDetections.of(n, 1)
    half = rng.random(MODEL.n_markers) < 0.5
    phantom.confidences[:, 0, half] = _GUESSED
    jitter = params.noise * params.detector.coloured * rng.standard_normal(phantom.positions.shape)
    phantom.positions[:] = camera.points(markers)[:, None] + jitter
    turned = multiply(conjugate(camera.pose.xyzw), from_matrix(rotations))
    phantom.orientations[:] = turned[:, None, LINK_SEGMENTS]
    return phantom
