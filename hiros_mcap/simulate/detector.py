"""What one camera's body tracker makes of the people it sees, with all its faults.

Order of the faults, as in a real tracker: sides are confused on what is there, errors of seen and
guessed joints come on top, bodies are lost and found again in a wrong pose, phantoms are added.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hiros_mcap.body.rotations import conjugate, multiply
from hiros_mcap.simulate.body import LINK_SEGMENTS, MARKERS, MODEL, SLOT, SYMMETRY, Body
from hiros_mcap.simulate.cameras import Camera, seconds_since
from hiros_mcap.simulate.clip import Performer
from hiros_mcap.simulate.motion import Person, standing
from hiros_mcap.simulate.occlusion import Mask, look
from hiros_mcap.simulate.randomness import coloured, episodes, stream
from hiros_mcap.simulate.settings import SimulateParams
from hiros_mcap.simulate.spatial import from_vector, quaternions, second_axis
from hiros_mcap.simulate.splines import Spot
from hiros_mcap.skeletons import Floats

_SHARE_INSIDE = 0.5  # a body of which less than this is in the picture is not detected
_REFERENCE_RANGE = 3.5  # m, where the errors have their nominal size
_SPAWN_TURN = np.radians(25.0)  # SD per axis of the link orientations of a wrong first pose
_FRONT_FLIP_SHARE = 0.2  # flips are this much rarer when the camera sees the face
_HALF_TURN = np.array([0.0, 1.0, 0.0, 0.0])  # about a segment's own long axis
_STATIC_PRESENCE = 0.9  # share of frames in which a static phantom is reported
_TURNING = [SLOT[name] for name in ("NOSE", "EYE_LEFT", "EYE_RIGHT", "FOOT_LEFT", "FOOT_RIGHT")]
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
class Bodies:
    """What is reported of P bodies in n frames, in the camera's coordinates."""

    positions: Floats
    """(n, P, M, 3) m."""
    orientations: Floats
    """(n, P, L, 4) unit quaternions x y z w."""
    confidences: Floats
    """(n, P, M)."""
    guessed: Mask
    """(n, P, M) whether the joint is not seen but guessed."""
    present: Mask
    """(n, P) whether the body is reported at all; the rest is meaningless where not."""

    @classmethod
    def of(cls, n: int, people: int, confidence: float) -> Bodies:
        """Bodies that are all present and seen; where they are is to be filled in."""
        return cls(
            np.empty((n, people, MODEL.n_markers, 3)),
            np.empty((n, people, MODEL.n_links, 4)),
            np.full((n, people, MODEL.n_markers), confidence),
            np.zeros((n, people, MODEL.n_markers), bool),
            np.ones((n, people), bool),
        )

    def beside(self, others: list[Bodies]) -> Bodies:
        """All sets of bodies as one."""
        sets = [self, *others]
        return Bodies(
            np.concatenate([bodies.positions for bodies in sets], axis=1),
            np.concatenate([bodies.orientations for bodies in sets], axis=1),
            np.concatenate([bodies.confidences for bodies in sets], axis=1),
            np.concatenate([bodies.guessed for bodies in sets], axis=1),
            np.concatenate([bodies.present for bodies in sets], axis=1),
        )


def detect(people: Sequence[Person | Performer], camera: Camera, params: SimulateParams) -> Bodies:
    """Everything that a camera reports, in its nominal frames."""
    bodies = observe(people, camera, params)
    _hide(bodies, params)
    _flip(bodies, camera, params)
    _disturb(bodies, camera, params)
    _lose(bodies, camera, params)
    _respawn(bodies, camera, params)
    return bodies.beside(phantoms(bodies, camera, params))


def observe(people: Sequence[Person | Performer], camera: Camera, params: SimulateParams) -> Bodies:
    """Return the truth in the camera's coordinates at the times of its nominal frames."""
    t = seconds_since(params.start, camera.ticks.captured)
    bodies = Bodies.of(len(t), len(people), params.detector.confidence_seen)
    to_camera = conjugate(camera.pose.xyzw)
    for slot, person in enumerate(people):
        markers, rotations = person.pose(t)
        bodies.positions[:, slot] = camera.points(markers)
        turned = multiply(to_camera, quaternions(rotations))
        bodies.orientations[:, slot] = turned[:, LINK_SEGMENTS]
    return bodies


def _hide(bodies: Bodies, params: SimulateParams) -> None:
    """Decide which bodies are detected and which of their joints are guessed."""
    detector, solid = params.detector, params.occlusion > 0
    sight = look(bodies.positions, params.rig, solid=solid)
    inside = sight.framed.mean(-1)
    clear = (sight.framed & ~sight.covered).mean(-1)
    bodies.present &= (inside >= _SHARE_INSIDE) & (clear >= (1 - detector.hidden) * inside)
    if solid:
        bodies.guessed[:] = sight.hidden | ~sight.framed
        bodies.confidences[sight.hidden] = detector.confidence_guessed
        bodies.confidences[~sight.framed] = detector.confidence_outside


def _flip(bodies: Bodies, camera: Camera, params: SimulateParams) -> None:
    """Confuse left and right for a while, mostly of people seen from behind."""
    detector, rate = params.detector, params.rig.rate
    often = params.flips * detector.flips_per_minute / (60 * rate)
    frames = (detector.flip_seconds[0] * rate, detector.flip_seconds[1] * rate)
    n, people = bodies.present.shape
    across = np.diff(bodies.positions[..., [SLOT["HIP_LEFT"], SLOT["HIP_RIGHT"]], 0], axis=-1)
    for person in range(people):
        rng = stream(params.seed, "flips", camera.index, person)
        free = 0
        for start, stop in episodes(rng, n, often, frames):
            turned, reluctant = rng.random() < detector.turn_share, rng.random()
            from_behind = across[start, person, 0] > 0
            if start < free or not (from_behind or reluctant < _FRONT_FLIP_SHARE):
                continue
            swap_sides(bodies, slice(start, stop), person)
            if turned:
                turn_round(bodies, slice(start, stop), person)
            free = stop


def swap_sides(bodies: Bodies, frames: slice, person: int) -> None:
    """Give every left joint and link the place of the right one and vice versa."""
    for series in (bodies.positions, bodies.confidences, bodies.guessed):
        series[frames, person] = series[frames, person][:, SYMMETRY.mirror]
    links = bodies.orientations
    links[frames, person] = links[frames, person][:, SYMMETRY.link_mirror]


def turn_round(bodies: Bodies, frames: slice, person: int) -> None:
    """Let a body whose sides are swapped face the other way: links, face and feet."""
    positions = bodies.positions[frames, person]
    orientations = bodies.orientations[frames, person]
    for marker in _TURNING:
        parent, link = _PARENTS[marker - 1], marker - 1
        arm, axis = positions[:, marker] - positions[:, parent], second_axis(orientations[:, link])
        along = (arm * axis).sum(-1, keepdims=True) * axis
        positions[:, marker] = positions[:, parent] + 2 * along - arm
    orientations[:] = multiply(orientations, _HALF_TURN)


@dataclass(frozen=True, slots=True)
class _Deviations:
    """SD per axis of an error's parts, m or rad, broadcastable to (n, P, K, 1)."""

    slow: Floats
    white: Floats
    bias: Floats
    guess: Floats


def _disturb(bodies: Bodies, camera: Camera, params: SimulateParams) -> None:
    """Add noise and bias to everything, and more to what is guessed."""
    detector, noise = params.detector, params.noise
    distance = np.linalg.norm(bodies.positions[:, :, 0], axis=-1)[..., None, None]
    growth = (distance / _REFERENCE_RANGE) ** detector.range_growth
    outwards = EXTREMITY[:, None]
    wide = noise * (1 + (detector.extremities - 1) * outwards)
    far = params.occlusion * (1 + (detector.guess_extremities - 1) * outwards)
    rng = stream(params.seed, "joint errors", camera.index)
    bodies.positions += _errors(
        rng,
        _Deviations(
            slow=detector.coloured * wide * growth,
            white=detector.white * wide * growth,
            bias=detector.bias * wide,
            guess=detector.guess * far,
        ),
        bodies.guessed,
        params,
    )
    rng = stream(params.seed, "link errors", camera.index)
    turn = _errors(
        rng,
        _Deviations(
            slow=np.radians(detector.turn_coloured) * wide[1:] * growth,
            white=np.radians(detector.turn_white) * wide[1:] * growth,
            bias=np.radians(detector.turn_bias) * wide[1:],
            guess=np.radians(detector.guess_turn) * far[1:],
        ),
        guessed_links(bodies.guessed),
        params,
    )
    bodies.orientations[:] = multiply(from_vector(turn), bodies.orientations)


def _errors(
    rng: np.random.Generator, sd: _Deviations, guessed: Mask, params: SimulateParams
) -> Floats:
    """Errors (n, P, K, 3) of K joints or links, correlated over the n frames."""
    rate, detector, shape = params.rig.rate, params.detector, (*guessed.shape, 3)
    errors = sd.slow * coloured(rng, shape, detector.correlation ** (30 / rate))
    errors += sd.white * rng.standard_normal(shape)
    errors += sd.bias * coloured(rng, shape, float(np.exp(-1 / (rate * detector.bias_seconds))))
    guess = coloured(rng, shape, float(np.exp(-1 / (rate * detector.guess_seconds))))
    errors += np.where(guessed[..., None], sd.guess * guess, 0.0)
    return errors


def guessed_links(guessed: Mask) -> Mask:
    """(..., L) a link is guessed when one of its two joints is, given those (..., M)."""
    either: Mask = guessed[..., 1:] | guessed[..., _PARENTS]
    return either


def _lose(bodies: Bodies, camera: Camera, params: SimulateParams) -> None:
    """Lose people who are in full view."""
    detector, rate = params.detector, params.rig.rate
    often = params.dropouts * detector.losses_per_minute / (60 * rate)
    frames = (detector.loss_seconds[0] * rate, detector.loss_seconds[1] * rate)
    n, people = bodies.present.shape
    for person in range(people):
        rng = stream(params.seed, "losses", camera.index, person)
        for start, stop in episodes(rng, n, often, frames):
            bodies.present[start:stop, person] = False


def _respawn(bodies: Bodies, camera: Camera, params: SimulateParams) -> None:
    """Start every body that re-appears in a wrong pose that settles within some frames."""
    low, high = params.detector.spawn_frames
    strength = min(1.0, params.dropouts)
    for person in range(bodies.present.shape[1]):
        rng = stream(params.seed, "spawns", camera.index, person)
        here = bodies.present[:, person]
        for start in np.flatnonzero(here[1:] & ~here[:-1]) + 1:
            frames = slice(start, start + int(rng.integers(low, high + 1)))
            whole = rng.standard_normal((1, 3))
            joints = rng.standard_normal((MODEL.n_markers, 3))
            links = rng.standard_normal((MODEL.n_links, 3))
            length = len(bodies.positions[frames])
            fade = strength * np.linspace(1, 0, length, endpoint=False)[:, None, None]
            error = params.detector.spawn_error * (whole + joints) / np.sqrt(2)
            bodies.positions[frames, person] += fade * error
            turn = from_vector(fade * _SPAWN_TURN * links)
            bodies.orientations[frames, person] = multiply(
                turn, bodies.orientations[frames, person]
            )


def phantoms(bodies: Bodies, camera: Camera, params: SimulateParams) -> list[Bodies]:
    """Bodies that are not there: a static one, and fleeting ones, some beside a real person."""
    detector, rate, n = params.detector, params.rig.rate, len(bodies.present)
    found = []
    if camera.index < detector.static_phantoms and params.phantoms > 0:
        rng = stream(params.seed, "static phantom", camera.index)
        thing = _stranger(n, camera, params, rng)
        thing.present[:, 0] = rng.random(n) < _STATIC_PRESENCE
        found.append(thing)
    rng = stream(params.seed, "phantoms", camera.index)
    often = params.phantoms * detector.phantoms_per_minute / (60 * rate)
    for start, stop in episodes(rng, n, often, detector.phantom_frames):
        ghost = _stranger(n, camera, params, rng)
        double = rng.random() < detector.double_share
        owners = np.flatnonzero(bodies.present[start])
        if double and len(owners):
            owner = int(rng.choice(owners))
            shift = detector.spawn_error * rng.standard_normal(3)
            ghost.positions[:, 0] += bodies.positions[:, owner] + shift - ghost.positions[start, 0]
            ghost.orientations[:, 0] = bodies.orientations[:, owner]
        ghost.present[:start] = ghost.present[stop:] = False
        found.append(ghost)
    return found


def _stranger(n: int, camera: Camera, params: SimulateParams, rng: np.random.Generator) -> Bodies:
    """Return a body that stands still before the camera, beyond the middle of the room."""
    body, radius = Body.of(rng.uniform(*params.heights)), params.rig.radius
    x, y, _ = camera.pose.translation
    bearing = np.arctan2(-y, -x) + rng.uniform(-0.9, 0.9)
    away = radius * rng.uniform(0.1, 0.5)
    spot = Spot(away * np.cos(bearing), away * np.sin(bearing), rng.uniform(-np.pi, np.pi))
    still = Person(body, lambda t: standing(body, spot, t))
    markers, rotations = still.pose(np.zeros(1))
    stranger = Bodies.of(n, 1, params.detector.confidence_seen)
    half = rng.random(MODEL.n_markers) < 0.5
    stranger.confidences[:, 0, half] = params.detector.confidence_guessed
    jitter = params.noise * params.detector.coloured * rng.standard_normal(stranger.positions.shape)
    stranger.positions[:] = camera.points(markers)[:, None] + jitter
    turned = multiply(conjugate(camera.pose.xyzw), quaternions(rotations))
    stranger.orientations[:] = turned[:, None, LINK_SEGMENTS]
    return stranger
