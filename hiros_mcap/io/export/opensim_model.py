"""A person as a model of OpenSim, and the setup of its inverse kinematics.

The model has the coordinates and the axes of Rajagopal2016 (rajagopal.py), so that MOT files fit
it, and the person's lengths between joints. Its knee is the hinge that the MOT files follow. It
needs no other file: its bodies are drawn as ellipsoids, and it has no muscles.

Masses and centres of mass are those of de Leva (J Biomech 29, 1996, 1223-1230), the mean of women
and men; the centre of forearm and hand is Winter's (Biomechanics and Motor Control of Human
Movement, 4th ed., 2009, table 4.1). Moments of inertia are those of the ellipsoids.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple
from xml.sax.saxutils import quoteattr

import numpy as np

from hiros_mcap.body.segments import LOWER_SPINE, SIDES, TOE, Finder, finder, unit
from hiros_mcap.body.symmetry import split_side
from hiros_mcap.errors import ConfigError
from hiros_mcap.io.export import rajagopal
from hiros_mcap.io.export.choices import Choices
from hiros_mcap.io.export.rajagopal import ANKLE, ELBOW, HIPS, KNEE, LUMBAR, PELVIS
from hiros_mcap.io.export.tables import write_lines
from hiros_mcap.io.result import Motion, Result
from hiros_mcap.outputs import EXPORT_MARK
from hiros_mcap.skeletons import Flags, Floats, SkeletonModel

if TYPE_CHECKING:
    from hiros_mcap.io.export.rajagopal import Hinge

BONES = {
    "thigh": ("hip", "knee"),
    "shank": ("knee", "ankle"),
    "upper arm": ("shoulder", "elbow"),
    "forearm": ("elbow", "wrist"),
}
"""Segment -> the joints at its ends."""
OF_RAJAGOPAL = {
    "hips": 2 * 0.07726,
    "trunk": float(np.linalg.norm(rajagopal.BACK + rajagopal.SHOULDERS)),
    "shoulders": 2 * 0.17,
    "thigh": float(np.linalg.norm(KNEE.bone)),
    "shank": float(np.linalg.norm(ANKLE.bone)),
    "foot": float(np.linalg.norm(ANKLE.next)),
    "upper arm": float(np.linalg.norm(ELBOW.bone)),
    "forearm": float(np.linalg.norm(ELBOW.next)),
}
"""Lengths of Rajagopal2016, m; "trunk" is from the middle of the hips to that of the shoulders."""
SHARES = {
    "pelvis": (0.1182, 0.5),
    "torso": (0.3801, 0.5),
    "femur": (0.1447, 0.385),
    "tibia": (0.0457, 0.437),
    "talus": (0.0133, 0.5),
    "humerus": (0.0263, 0.576),
    "ulna": (0.0208, 0.682),
}
"""Body -> its share of the mass, and where its centre lies between its ends. The torso has the
head, and the ulna the hand."""
SOLE_M = (0.02, 0.15)
"""Of the ankle's height above the floor. Who is never seen to stand has the second value's half."""
MARKERS = ("hip", "knee", "ankle", "shoulder", "elbow", "wrist")
SPINE = ("spine", "")
"""The marker in the lower spine, by which the pelvis of MOT files is tilted."""


def lengths_of(model: SkeletonModel, motion: Motion) -> dict[str, float]:
    """Return a person's lengths, m, by name: "hips", "trunk", "left thigh", ...

    They are medians over the motion; NaN where a joint is never seen. "sole" is the height of the
    ankles above the floor, z = 0, while the person stands.
    """
    at = finder(model, motion.positions)

    def middle(part: str) -> Floats:
        return np.asarray((at(part, side="left") + at(part, side="right")) / 2)

    lengths = {
        "hips": _distance(at("hip", side="left"), at("hip", side="right")),
        "trunk": _distance(middle("hip"), middle("shoulder")),
        "shoulders": _distance(at("shoulder", side="left"), at("shoulder", side="right")),
        "sole": _sole(at),
    }
    for side in SIDES:
        for name, (upper, lower) in BONES.items():
            lengths[f"{side} {name}"] = _distance(at(upper, side=side), at(lower, side=side))
        lengths[f"{side} foot"] = _distance(at("ankle", side=side), at(*TOE, side=side))
    return lengths


def _distance(first: Floats, second: Floats) -> float:
    distances = np.linalg.norm(first - second, axis=-1)
    return float(np.nanmedian(distances)) if np.isfinite(distances).any() else np.nan


def _sole(at: Finder) -> float:
    heights = np.concatenate([at("ankle", side=side)[:, 2] for side in SIDES])
    height = float(np.nanpercentile(heights, 10)) if np.isfinite(heights).any() else np.nan
    return height if SOLE_M[0] <= height <= SOLE_M[1] else SOLE_M[1] / 2


def sized(result: Result, motion: Motion, choices: Choices) -> dict[str, float]:
    """Return all lengths of a person; those of unseen segments have Rajagopal's proportions.

    Raises ConfigError if the hips are never seen.
    """
    lengths = lengths_of(result.model, motion)
    if np.isnan(lengths["hips"]):
        raise ConfigError(f"{result.path}: the model needs both hips")
    ratios = {name: length / _usual(name) for name, length in lengths.items() if name != "sole"}
    unseen = [name for name, ratio in ratios.items() if np.isnan(ratio)]
    if unseen:
        usual = float(np.nanmedian([*ratios.values()]))
        lengths |= {name: usual * _usual(name) for name in unseen}
        choices.warn(
            f"{result.path}: lengths in the proportions of Rajagopal2016, since nobody saw them: "
            f"{', '.join(unseen)}"
        )
    return lengths


def _usual(name: str) -> float:
    return OF_RAJAGOPAL[name.removeprefix("left ").removeprefix("right ")]


class _OpenSimBody(NamedTuple):
    """A body, and the joint that carries it. Vectors in m: x forward, y up, z right."""

    name: str
    parent: str
    place: Floats  # (3,) of the joint in the parent; the joint is the origin of the body
    end: Floats  # (3,) of its other end in the body
    radii: Floats  # (3,) of the ellipsoid
    turns: Sequence[tuple[str, Floats]]  # coordinates and the axes that they turn about
    range_deg: tuple[float, float] = (-180.0, 180.0)
    clamped: bool = False
    moves: Sequence[str] = ()  # coordinates of the translations along x, y, z


def write_osim(result: Result, target: Path, choices: Choices) -> None:
    """Write one person's model, with the marker names of the result.

    Raises ConfigError if the hips are never seen.
    """
    (motion,) = result.motions.values()
    lengths = sized(result, motion, choices)
    names, spine = marker_names(result.model), _spine(result.model, motion)
    bodies = _bodies(lengths, _shoulders(result.model, motion, lengths))
    markers = _markers(names, {body.name: body.end for body in bodies}, HIPS + spine)
    mass = choices.mass or 0.0
    text = f"""<?xml version="1.0" encoding="UTF-8"?>
<!-- {EXPORT_MARK} -->
<OpenSimDocument Version="40000">
<Model name={quoteattr(result.path.stem)}>
<credits>Coordinates and axes: Rajagopal et al. 2016. Masses: de Leva 1996.</credits>
<gravity>0 -9.80665 0</gravity>
<BodySet><objects>
{"".join(_body(body, mass) for body in bodies)}</objects></BodySet>
<JointSet><objects>
{"".join(_joint(body, lengths) for body in bodies)}</objects></JointSet>
<MarkerSet><objects>
{markers}</objects></MarkerSet>
</Model>
</OpenSimDocument>"""
    write_lines(target, text.splitlines())


def marker_names(model: SkeletonModel) -> dict[tuple[str, str], str]:
    """Joint and side -> name of its marker, of the joints that the model has; SPINE without."""
    names: dict[tuple[str, str], str] = {}
    for name in model.marker_names:
        part, side = split_side(name)
        part = "toes" if part in TOE else part
        if side and part in (*MARKERS, "toes"):
            names.setdefault((part, side), name)
    parts = {split_side(name): name for name in model.marker_names}
    spine = next((parts[part, ""] for part in LOWER_SPINE if (part, "") in parts), None)
    return names if spine is None else {**names, SPINE: spine}


def rows_of(model: SkeletonModel, motion: Motion) -> Flags:
    """(T,) instants at which a marker of inverse kinematics is seen: OpenSim stops at the others.

    If the markers have the names of another model, any of them counts.
    """
    slots = [model.marker_names.index(name) for name in marker_names(model).values()]
    positions = motion.positions[:, slots] if slots else motion.positions
    return np.asarray(np.isfinite(positions).all(axis=-1).any(axis=-1))


def _spine(model: SkeletonModel, motion: Motion) -> Floats:
    """(3,) from the middle of the hips to SPINE in the pelvis: the median; NaN if it has none."""
    hips, pelvis, _ = rajagopal.trunk_of(model, motion)
    places = rajagopal.into(pelvis, finder(model, motion.positions)(*LOWER_SPINE) - hips)
    known = places[np.isfinite(places).all(axis=-1)]
    return np.median(known, axis=0) if len(known) else np.full(3, np.nan)


def _shoulders(
    model: SkeletonModel, motion: Motion, lengths: Mapping[str, float]
) -> dict[str, Floats]:
    """Side -> (3,) where the shoulder is in the torso: the median over the motion."""
    hips, pelvis, torso = rajagopal.trunk_of(model, motion)
    at = finder(model, motion.positions)
    factor = lengths["trunk"] / OF_RAJAGOPAL["trunk"]
    back = hips + pelvis @ (factor * rajagopal.BACK)
    places = {}
    for side in SIDES:
        seen = rajagopal.into(torso, at("shoulder", side=side) - back)
        seen = seen[np.isfinite(seen).all(axis=-1)]
        usual = _to(side, factor * rajagopal.SHOULDERS + lengths["shoulders"] / 2 * _Z)
        places[side] = np.median(seen, axis=0) if len(seen) else usual
    return places


def _bodies(lengths: Mapping[str, float], shoulders: Mapping[str, Floats]) -> list[_OpenSimBody]:
    back = lengths["trunk"] / OF_RAJAGOPAL["trunk"] * rajagopal.BACK
    hips = lengths["hips"] / 2
    neck = (shoulders["left"] + shoulders["right"]) / 2
    lumbar = _turns(LUMBAR, "right")
    bodies = [
        _OpenSimBody("pelvis", "", np.zeros(3), HIPS + back, np.array([0.1, 0.1, hips + 0.07]),
              _turns(PELVIS[:3], "right"), moves=PELVIS[3:]),
        _OpenSimBody("torso", "pelvis", HIPS + back, neck,
              np.array([0.11, 0.5 * neck[1], lengths["shoulders"] / 2]), lumbar),
    ]  # fmt: skip
    for side in SIDES:
        end = side[0]
        leg = [lengths[f"{side} {name}"] for name in ("thigh", "shank", "foot")]
        arm = [lengths[f"{side} {name}"] for name in ("upper arm", "forearm")]
        places = [HIPS + hips * _Z, leg[0] * unit(KNEE.bone), leg[1] * unit(KNEE.next)]
        ends = [*places[1:], leg[2] * unit(ANKLE.next)]
        hip = _turns([f"hip_{name}_{end}" for name in ("flexion", "adduction", "rotation")], side)
        knee, ankle = (f"{name}_angle_{end}" for name in ("knee", "ankle"))
        shoulder = _turns([f"arm_{name}_{end}" for name in ("flex", "add", "rot")], side)
        elbow = _to(side, arm[0] * unit(ELBOW.bone))
        bodies += [
            _OpenSimBody(f"femur_{end}", "pelvis", _to(side, places[0]), _to(side, ends[0]),
                  _thick(0.16, leg[0]), hip),
            _hinged(f"tibia_{end}", f"femur_{end}", _to(side, places[1]), _to(side, ends[1]),
                    _thick(0.12, leg[1]), knee, KNEE, side),
            _hinged(f"talus_{end}", f"tibia_{end}", _to(side, places[2]), _to(side, ends[2]),
                    np.array([0.6 * leg[2], 0.5 * lengths["sole"], 0.3 * leg[2]]), ankle, ANKLE,
                    side),
            _OpenSimBody(f"humerus_{end}", "torso", shoulders[side], elbow,
                  _thick(0.14, arm[0]), shoulder),
            _hinged(f"ulna_{end}", f"humerus_{end}", elbow,
                    _to(side, arm[1] * unit(ELBOW.next)), _thick(0.12, arm[1]),
                    f"elbow_flex_{end}", ELBOW, side),
        ]  # fmt: skip
    return bodies


_X, _Y, _Z = np.eye(3)


def _to(side: str, vector: Floats) -> Floats:
    return np.asarray(vector * [1.0, 1.0, 1.0 if side == "right" else -1.0])


def _axis(side: str, axis: Floats) -> Floats:
    """Return the axis about which this side turns as the right one does about ``axis``."""
    return axis if side == "right" else axis * np.array([-1.0, -1.0, 1.0])


def _turns(names: Sequence[str], side: str) -> list[tuple[str, Floats]]:
    return [(n, _axis(side, axis)) for n, axis in zip(names, (_Z, _X, _Y), strict=True)]


def _thick(share: float, length: float) -> Floats:
    return length * np.array([share, 0.5, share])


def _hinged(
    name: str,
    parent: str,
    place: Floats,
    end: Floats,
    radii: Floats,
    coordinate: str,
    hinge: Hinge,
    side: str,
) -> _OpenSimBody:
    axis = unit(_axis(side, hinge.axis))
    second = unit(np.cross(axis, _Y))
    turns = [(coordinate, axis), ("", second), ("", np.cross(axis, second))]
    return _OpenSimBody(name, parent, place, end, radii, turns, hinge.range_deg, clamped=True)


def _body(body: _OpenSimBody, mass: float) -> str:
    share, centre = SHARES[body.name.partition("_")[0]]
    a, b, c = (share * mass / 5 * body.radii**2).tolist()
    shapes = _shape(body.name, body.end / 2, body.radii)
    if body.name == "torso":
        shapes += _shape("head", body.end * [1, 1.6, 0], np.array([0.09, 0.13, 0.08]))
    if body.name.startswith("talus"):
        # The sole is on the floor while the person stands.
        down = np.array([0.0, -body.radii[1], 0.0])
        shapes = _shape(body.name, body.end * [0.35, 0, 0.35] + down, body.radii)
    return f"""<Body name="{body.name}"><mass>{share * mass:.6g}</mass>
<mass_center>{_numbers(centre * body.end)}</mass_center>
<inertia>{_numbers([b + c, a + c, a + b])} 0 0 0</inertia>
<components>{shapes}</components></Body>
"""


def _shape(name: str, centre: Floats, radii: Floats) -> str:
    return f"""<PhysicalOffsetFrame name="{name}_shape"><socket_parent>..</socket_parent>
<translation>{_numbers(centre)}</translation><attached_geometry><Ellipsoid name="ellipsoid">
<radii>{_numbers(radii)}</radii><Appearance><color>0.8 0.72 0.6</color></Appearance>
</Ellipsoid></attached_geometry></PhysicalOffsetFrame>"""


def _joint(body: _OpenSimBody, lengths: Mapping[str, float]) -> str:
    parent = body.parent or "ground"
    path = f"/bodyset/{parent}" if body.parent else "/ground"
    coordinates = [_coordinate(name, body.range_deg, clamped=body.clamped)
                   for name, _ in body.turns if name]  # fmt: skip
    coordinates += [_coordinate(name, (-1e4, 1e4), _standing(name, lengths)) for name in body.moves]
    axes = [_transform(f"rotation{k}", *turn) for k, turn in enumerate(body.turns, 1)]
    moves = body.moves or ("", "", "")
    axes += [
        _transform(f"translation{k}", name, axis)
        for k, (name, axis) in enumerate(zip(moves, np.eye(3), strict=True), 1)
    ]
    return f"""<CustomJoint name="{parent}_{body.name}">
<socket_parent_frame>{parent}_offset</socket_parent_frame>
<socket_child_frame>{body.name}_offset</socket_child_frame>
<coordinates>{"".join(coordinates)}</coordinates>
<frames><PhysicalOffsetFrame name="{parent}_offset"><socket_parent>{path}</socket_parent>
<translation>{_numbers(body.place)}</translation></PhysicalOffsetFrame>
<PhysicalOffsetFrame name="{body.name}_offset"><socket_parent>/bodyset/{body.name}</socket_parent>
</PhysicalOffsetFrame></frames>
<SpatialTransform>{"".join(axes)}</SpatialTransform></CustomJoint>
"""


def _standing(name: str, lengths: Mapping[str, float]) -> float:
    """Height of the pelvis while the person stands straight; 0 for the other translations."""
    down = lengths["right thigh"] * unit(KNEE.bone) + lengths["right shank"] * unit(KNEE.next)
    return float(lengths["sole"] - HIPS[1] - down[1]) if name == PELVIS[4] else 0.0


def _coordinate(
    name: str, span: tuple[float, float], value: float = 0.0, *, clamped: bool = False
) -> str:
    low, high = span if name in PELVIS[3:] else np.radians(span)
    return f"""<Coordinate name="{name}"><default_value>{value:.6g}</default_value>
<range>{low:.6g} {high:.6g}</range><clamped>{str(clamped).lower()}</clamped></Coordinate>"""


def _transform(transform: str, coordinate: str, axis: Floats) -> str:
    function = (
        "<LinearFunction><coefficients>1 0</coefficients></LinearFunction>"
        if coordinate
        else "<Constant><value>0</value></Constant>"
    )
    return f"""<TransformAxis name="{transform}"><coordinates>{coordinate}</coordinates>
<axis>{_numbers(axis)}</axis>{function}</TransformAxis>
"""


_CARRIERS = {
    "hip": "femur", "knee": "tibia", "ankle": "talus", "shoulder": "humerus", "elbow": "ulna",
}  # fmt: skip
"""Joint -> the body whose origin it is."""


def _markers(
    names: Mapping[tuple[str, str], str], ends: Mapping[str, Floats], spine: Floats
) -> str:
    lines = []
    for (part, side), name in names.items():
        at_end = {"toes": "talus", "wrist": "ulna"}.get(part)
        body = f"{at_end or _CARRIERS[part]}_{side[0]}" if side else "pelvis"
        place = ends[body] if at_end else np.zeros(3) if side else spine
        if np.isnan(place).any():
            continue
        lines.append(
            f"<Marker name={quoteattr(name)}><socket_parent_frame>/bodyset/{body}"
            f"</socket_parent_frame><location>{_numbers(place)}</location></Marker>\n"
        )
    return "".join(lines)


def _numbers(values: Floats | Sequence[float]) -> str:
    return " ".join(f"{value:.9g}" for value in values)


WEIGHTS = {"toes": 0.1, "spine": 0.3}
"""Of markers that the model follows worse than the others, which have 1: detectors place toes
badly, and the foot has one coordinate; the lower spine bends, and is no part of the pelvis."""
LOOSE = ("hip_rotation", "arm_rot", "ankle_angle")
"""Coordinates that joint centres of straight limbs do not show."""
LOOSE_WEIGHT = 1e-4
"""1 rad counts as much as 1 cm at one marker."""
STIFF_WEIGHT = 1e-2
"""Of the lumbar extension where no SPINE shows it: hips and shoulders alone cannot tell the tilt
of the pelvis from a bend of the trunk, as both hardly change their distance."""


def write_ik_setup(result: Result, target: Path, choices: Choices) -> None:
    """Write the setup of OpenSim's inverse kinematics on the .osim and .trc of the same name.

    It names the time range: without one, OpenSim 4.6 ends at 2.0 s and reports success.

    Raises ConfigError if no joint of the model is ever seen.
    """
    (motion,) = result.motions.values()
    times = motion.times[rows_of(result.model, motion)]
    if not len(times):
        raise ConfigError(f"{result.path}: no joint of OpenSim's model is ever seen")
    name = quoteattr(result.path.stem)[1:-1]
    text = f"""<?xml version="1.0" encoding="UTF-8"?>
<!-- {EXPORT_MARK} -->
<OpenSimDocument Version="40000">
<InverseKinematicsTool name={quoteattr(result.path.stem)}>
<model_file>{name}.osim</model_file>
<marker_file>{name}.trc</marker_file>
<output_motion_file>{name}_ik.mot</output_motion_file>
<time_range>{times[0]:.6f} {times[-1]:.6f}</time_range>
<IKTaskSet><objects>
{"".join(_tasks(result.model, motion))}</objects></IKTaskSet>
</InverseKinematicsTool>
</OpenSimDocument>"""
    write_lines(target, text.splitlines())


def _tasks(model: SkeletonModel, motion: Motion) -> list[str]:
    """Return what inverse kinematics follows: the markers and, weakly, usual coordinates."""
    names = marker_names(model)
    tasks = [
        f"<IKMarkerTask name={quoteattr(marker)}><apply>true</apply>"
        f"<weight>{WEIGHTS.get(part, 1)}</weight></IKMarkerTask>\n"
        for (part, _), marker in names.items()
    ]
    tasks += [_pull(f"{name}_{side}", LOOSE_WEIGHT, 0.0) for name in LOOSE for side in "rl"]
    columns, _ = rajagopal.coordinates(model, motion)
    extension = columns[LUMBAR[0]]
    if np.isfinite(extension).any():
        weight = LOOSE_WEIGHT if SPINE in names else STIFF_WEIGHT
        tasks.append(_pull(LUMBAR[0], weight, float(np.radians(np.nanmedian(extension)))))
    return tasks


def _pull(coordinate: str, weight: float, value: float) -> str:
    """Return the task that pulls a coordinate towards a value, rad."""
    return (
        f'<IKCoordinateTask name="{coordinate}"><apply>true</apply><weight>{weight}</weight>'
        f"<value_type>manual_value</value_type><value>{value:.6g}</value></IKCoordinateTask>\n"
    )
