"""A model of OpenSim, scaled to a person by OpenSim itself: bodies, muscles, masses and all.

Joints are found by the coordinates of Rajagopal2016, which its kin share. A body belongs to the
segment of the last such joint on its way from the ground.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np

from hiros_mcap.body.segments import SIDES
from hiros_mcap.errors import ConfigError
from hiros_mcap.outputs import EXPORT_MARK
from hiros_mcap.skeletons import Floats

PELVIS = "pelvis_tilt"
COORDINATES = {
    "hip": "hip_flexion", "knee": "knee_angle", "ankle": "ankle_angle",
    "shoulder": "arm_flex", "elbow": "elbow_flex", "wrist": "wrist_flex",
}  # fmt: skip
"""Joint -> the coordinate by which it is found, without its side. A model may lack the wrists."""
SEGMENTS = {
    "hip": ("thigh", "knee"), "knee": ("shank", "ankle"),
    "shoulder": ("upper arm", "elbow"), "elbow": ("forearm", "wrist"),
}  # fmt: skip
"""Joint -> the segment that begins there, and the joint at its other end."""


Key = tuple[str, str]
"""Name and side of a joint."""


class _ModelJoint(NamedTuple):
    """A joint of the user's model."""

    parent: str  # name of the body that it hangs on
    place: Floats  # (3,) in the ground, m, while all coordinates have their defaults
    key: Key | None  # none if no coordinate tells which joint it is


def scaled(
    path: Path,
    lengths: Mapping[str, float],
    markers: Mapping[tuple[str, str], str],
    spine: Floats,
    mass: float | None,
) -> str:
    """Return a model's XML with the lengths of a person.

    Limbs are scaled by the same factor along all axes, the pelvis by its width, and the trunk above
    it by its height and the width of the shoulders. The height of the pelvis stays, so that the
    places of MOT files hold.

    Parameters
    ----------
    lengths : m, by name. markers : (joint, side) -> name of the marker that is put there.
    spine : (3,) of the marker ("spine", "") in the pelvis, m, from the middle of the hips.
    mass : of the person, kg; None keeps that of the model.

    Raises
    ------
    ConfigError
        OpenSim is not installed, cannot read the model, or the model lacks a coordinate.
    """
    opensim = _opensim()
    try:
        model = opensim.Model(str(path))
        state = model.initSystem()
    except (OSError, RuntimeError) as error:
        reason = str(error).strip().partition("\n")[0].strip()
        raise ConfigError(f"{path}: OpenSim cannot read it: {reason}") from None
    joints = _joints(opensim, path, model, state)
    factors = _factors(lengths, {joint.key: joint.place for joint in joints.values() if joint.key})
    scales = opensim.ScaleSet()
    for body in joints:
        scale = opensim.Scale()
        scale.setSegmentName(body)
        scale.setScaleFactors(opensim.Vec3(*factors[_segment_of(body, joints)]))
        scale.setApply(True)
        scales.cloneAndAppend(scale)
    model.scale(state, scales, mass is None, -1.0 if mass is None else mass)
    _mark(opensim, model, joints, markers)
    _mark_spine(opensim, model, joints, markers, spine)
    with TemporaryDirectory() as folder:
        written = Path(folder) / "scaled.osim"
        model.printToXML(str(written))
        head, _, text = written.read_text(encoding="utf-8").partition("\n")
    return f"{head}\n<!-- {EXPORT_MARK} -->\n{text}"


def _opensim() -> Any:
    """Import OpenSim, without its log on the screen and in the folder."""
    try:
        import opensim
    except ImportError:
        raise ConfigError(
            "OpenSim scales models, and is not installed: pip install opensim"
        ) from None
    opensim.Logger.setLevelString("Off")
    opensim.Logger.removeFileSink()
    return opensim


def _joints(opensim: Any, path: Path, model: Any, state: Any) -> dict[str, _ModelJoint]:
    """Return the joint that carries each body."""
    names = {f"{c}_{side[0]}": (name, side) for name, c in COORDINATES.items() for side in SIDES}
    names[PELVIS] = ("pelvis", "")
    joints, absent = {}, {*names}
    for joint in _each(model.getJointSet()):
        frames = joint.getParentFrame(), joint.getChildFrame()
        parent, child = (frame.findBaseFrame().getName() for frame in frames)
        coordinates = {joint.get_coordinates(k).getName() for k in range(joint.numCoordinates())}
        key = next((names[name] for name in coordinates if name in names), None)
        place = frames[0].getPositionInGround(state).to_numpy()
        joints[child] = _ModelJoint(parent, place, key)
        absent -= coordinates | {"wrist_flex_l", "wrist_flex_r"}
    if absent:
        raise ConfigError(
            f"{path}: has no coordinates {', '.join(sorted(absent))}; name a model with those of "
            "Rajagopal2016"
        )
    return _with_spine(joints)


def _with_spine(joints: Mapping[str, _ModelJoint]) -> dict[str, _ModelJoint]:
    """Name the joint of pelvis and spine "torso": the shoulders hang on it."""
    pelvis = next(body for body, joint in joints.items() if joint.key == ("pelvis", ""))
    body = next(joint.parent for joint in joints.values() if joint.key == ("shoulder", "left"))
    while joints[body].parent != pelvis:
        body = joints[body].parent
    return {**joints, body: joints[body]._replace(key=("torso", ""))}


def _segment_of(body: str, joints: Mapping[str, _ModelJoint]) -> Key:
    """Return the last named joint on the way from the ground to a body."""
    joint = joints[body]
    while joint.key is None:
        joint = joints[joint.parent]
    return joint.key


def _mark(
    opensim: Any, model: Any, joints: Mapping[str, _ModelJoint], markers: Mapping[Key, str]
) -> None:
    """Put a marker at each joint, in the body that the joint carries."""
    for joint in _each(model.getJointSet()):
        frame = joint.getChildFrame()
        body = frame.findBaseFrame().getName()
        name = markers.get(joints[body].key or ("", ""))
        if name is not None:
            _add(opensim, model, name, body, frame.findTransformInBaseFrame().p())


def _mark_spine(
    opensim: Any,
    model: Any,
    joints: Mapping[str, _ModelJoint],
    markers: Mapping[Key, str],
    spine: Floats,
) -> None:
    """Put the marker of the lower spine where it is from the middle of the hips."""
    if ("spine", "") not in markers or np.isnan(spine).any():
        return
    hips = [
        joint.getParentFrame().findTransformInBaseFrame().p().to_numpy()
        for joint in _each(model.getJointSet())
        if (joints[joint.getChildFrame().findBaseFrame().getName()].key or ("",))[0] == "hip"
    ]
    pelvis = next(body for body, joint in joints.items() if joint.key == ("pelvis", ""))
    place = opensim.Vec3(*np.mean(hips, axis=0) + spine)
    _add(opensim, model, markers["spine", ""], pelvis, place)


def _add(opensim: Any, model: Any, name: str, body: str, place: Any) -> None:
    """Add a marker, unless the model has one of that name."""
    if model.getMarkerSet().getIndex(name) < 0:
        model.addMarker(opensim.Marker(name, model.getBodySet().get(body), place))
        model.finalizeConnections()


def _each(things: Any) -> list[Any]:
    return [things.get(k) for k in range(things.getSize())]


def _factors(lengths: Mapping[str, float], places: Mapping[Key, Floats]) -> dict[Key, list[float]]:
    """Factors along x, y, z of the bodies that each joint carries."""

    def across(joint: str) -> float:
        return float(np.linalg.norm(places[joint, "left"] - places[joint, "right"]))

    height = _trunk_factor(lengths["trunk"], places)
    factors = {
        ("pelvis", ""): [1.0, 1.0, lengths["hips"] / across("hip")],
        ("torso", ""): [height, height, lengths["shoulders"] / across("shoulder")],
    }
    for side in SIDES:
        for joint, (segment, end) in SEGMENTS.items():
            if (end, side) not in places:
                factors[joint, side] = factors["shoulder", side]
                continue
            bone = np.linalg.norm(places[joint, side] - places[end, side])
            factors[joint, side] = [float(lengths[f"{side} {segment}"] / bone)] * 3
        factors["ankle", side] = factors["knee", side]
        factors["wrist", side] = factors["elbow", side]
    return factors


def _trunk_factor(length: float, places: Mapping[Key, Floats]) -> float:
    """Factor of the trunk above the pelvis that brings shoulders and hips to a distance, m."""
    hips, shoulders = (
        (places[name, "left"] + places[name, "right"]) / 2 for name in ("hip", "shoulder")
    )
    below, above = places["torso", ""] - hips, shoulders - places["torso", ""]
    a, b, c = above @ above, 2 * above @ below, below @ below - length**2
    return float((np.sqrt(b * b - 4 * a * c) - b) / (2 * a))
