"""Frames of the body's segments, from markers and, where there are some, from link orientations.

Every segment has the axes of the ISB recommendations (Wu et al. 2002 and 2005): x forward, y up,
z to the right, all parallel in a person who stands with hanging arms.

Markers give pelvis, thorax and head completely, but of a limb only its long axis y. They give the
other two axes while the next joint is bent: then the plane of the two bones shows where the hinge
points. Elsewhere x and z are NaN, since they cannot be known.

Link orientations turn with the segments, but every detector has link axes of its own. Their
constant relation to the segment's axes is measured: it is the mean rotation between the link and
the segment over all instants at which markers show the whole segment. A link that does not turn
with its segment shows itself by a large deviation from that mean, and is not used.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from hiros_mcap.body.rotations import nearest_rotation, to_matrix
from hiros_mcap.body.symmetry import split_side
from hiros_mcap.skeletons import Flags, Floats, SkeletonModel

HINGE_DEG = 20.0
"""A knee or elbow that is bent less does not show where its hinge points."""
FEWEST = 15
"""Instants, about half a second, that the relation of a link to its segment is measured in."""
LARGEST_DEG = 20.0
"""Median deviation from that relation above which a link does not turn with its segment."""
LARGEST_FOREARM_DEG = 45.0
"""The same for a forearm, whose marker at the thumb is noisy but right in the mean."""

SIDES = ("left", "right")
PELVIS = ("pelvis", "spinebase", "midhip", "hips", "spine_base")
NECK = ("neck", "spineshoulder", "spine_shoulder", "spine_chest")
LOWER_SPINE = ("spine_naval", "spinemid", "spine_mid", "spine", "naval")
HEAD = ("head", "nose")
_FACE = ("ear", "eye")
TOE = ("foot", "toe", "bigtoe", "big_toe", "toebase", "foot_index", "footindex")

# Segment -> names of the markers at both ends of the link that turns with it.
_LINKS: Mapping[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "pelvis": (PELVIS, (*LOWER_SPINE, *NECK)),
    "thorax": ((), NECK),
    "head": (NECK, HEAD),
    "thigh": (("hip",), ("knee",)),
    "shank": (("knee",), ("ankle",)),
    "upper arm": (("shoulder",), ("elbow",)),
    "forearm": (("elbow",), ("wrist",)),
}
_TRUNK = ("pelvis", "thorax", "head")

Segments = Mapping[str, Floats]
""""pelvis", "thorax", "head", "left thigh", ...: (T, 3, 3) frames, whose columns are the axes."""
LinkAxes = Mapping[str, Floats]
"""Segment -> (3, 3) its axes in the coordinates of its link; no entry if they are unknown."""
Finder = Callable[..., Floats]
"""``at("knee", side="left")``: (T, 3) the first marker of these names, NaN where there is none."""


def finder(model: SkeletonModel, positions: Floats) -> Finder:
    """Look up markers (T, M, 3) by the names that detectors use.

    Without a marker at the neck or the pelvis, it is the middle of the shoulders or hips.
    """
    slots = {split_side(name): slot for slot, name in enumerate(model.marker_names)}
    absent = np.full((len(positions), 3), np.nan)

    def at(*names: str, side: str = "") -> Floats:
        slot = next((slots[name, side] for name in names if (name, side) in slots), None)
        if slot is not None:
            return np.asarray(positions[:, slot])
        for part, ours in (("shoulder", NECK), ("hip", PELVIS)):
            if set(names) & {*ours}:
                return (at(part, side="left") + at(part, side="right")) / 2
        return absent

    return at


def toes(at: Finder, side: str) -> Floats:
    """(T, 3) direction from the ankle to the toes."""
    return unit(at(*TOE, side=side) - at("ankle", side=side))


def long_axis_of_head(at: Finder) -> Floats:
    """(T, 3) direction from the neck to the head."""
    return unit(at(*HEAD) - at(*NECK))


def marker_segments(model: SkeletonModel, positions: Floats) -> dict[str, Floats]:
    """Frames of all segments from markers (T, M, 3), m."""
    at = finder(model, positions)
    left, right = at("hip", side="left"), at("hip", side="right")
    middle = (left + right) / 2
    shoulders = at("shoulder", side="right") - at("shoulder", side="left")
    face = at(*_FACE, side="right") - at(*_FACE, side="left")
    segments = {
        "pelvis": frame(z=right - left, y=at(*LOWER_SPINE, *NECK) - middle),
        "thorax": frame(y=at(*NECK) - at(*PELVIS), z=shoulders, keep="y"),
        "head": frame(y=long_axis_of_head(at), z=face, keep="y"),
    }
    for side in SIDES:
        segments |= _leg(at, side) | _arm(at, side)
    return segments


def _leg(at: Finder, side: str) -> dict[str, Floats]:
    hip, knee, ankle = (at(name, side=side) for name in ("hip", "knee", "ankle"))
    thigh, shank = unit(hip - knee), unit(knee - ankle)
    # The shank bends backwards: the axis of the hinge is shank x thigh, to the right.
    hinge = _shown(np.cross(shank, thigh), thigh, shank)
    return {f"{side} thigh": limb(thigh, hinge), f"{side} shank": limb(shank, hinge)}


def _arm(at: Finder, side: str) -> dict[str, Floats]:
    shoulder, elbow, wrist = (at(name, side=side) for name in ("shoulder", "elbow", "wrist"))
    upper, fore = unit(shoulder - elbow), unit(elbow - wrist)
    # The forearm bends forwards: the axis of the hinge is upper arm x forearm, to the right.
    hinge = _shown(np.cross(upper, fore), upper, fore)
    # With the palm towards the thigh, the thumb points forwards.
    thumb = at("thumb", side=side) - wrist
    return {
        f"{side} upper arm": limb(upper, hinge),
        f"{side} forearm": limb(fore, np.cross(thumb, fore)),
    }


def _shown(hinge: Floats, proximal: Floats, distal: Floats) -> Floats:
    bent = between(proximal, distal) >= np.radians(HINGE_DEG)
    return np.where(bent[:, None], hinge, np.nan)


def link_axes(model: SkeletonModel, positions: Floats, orientations: Floats) -> LinkAxes:
    """Measure how each segment lies in its link, over one person's whole motion.

    Parameters
    ----------
    positions : (T, M, 3) m. orientations : (T, L, 4) x y z w of the links; NaN where absent.

    Returns
    -------
    No entry for a segment that markers show at fewer than FEWEST instants, or whose link deviates
    from it by more than LARGEST_DEG in half of them.
    """
    shown = marker_segments(model, positions)
    axes = {}
    for segment, slot in _link_slots(model).items():
        links, frames = to_matrix(orientations[:, slot]), shown[segment]
        complete = _complete(links) & _complete(frames)
        if complete.sum() < FEWEST:
            continue
        relations = np.swapaxes(links[complete], -1, -2) @ frames[complete]
        mean = nearest_rotation(relations.sum(axis=0).T)  # projected mean (Moakher 2002)
        cosines = np.einsum("tij,ij->t", relations, mean)  # 1 + 2 cos of the angle between them
        largest = LARGEST_FOREARM_DEG if segment.endswith("forearm") else LARGEST_DEG
        if np.median(cosines) >= 1 + 2 * np.cos(np.radians(largest)):
            axes[segment] = mean
    return axes


def segments_of(
    model: SkeletonModel,
    positions: Floats,
    orientations: Floats | None = None,
    axes: LinkAxes | None = None,
) -> Segments:
    """Frames of all segments; from link orientations where these are known, else from markers.

    A limb's long axis always comes from its two joints. Its rotation about it comes from the link
    if the link is of use at all, and is NaN at the instants that lack the link's orientation.

    Parameters are those of :func:`link_axes`; ``axes`` is its result.
    """
    segments = marker_segments(model, positions)
    slots = _link_slots(model)
    for segment, relation in (axes or {}).items():
        if orientations is None or segment not in slots:
            continue
        turned = to_matrix(orientations[:, slots[segment]]) @ relation
        if segment in _TRUNK:
            complete = _complete(turned)
            segments[segment] = np.where(complete[:, None, None], turned, segments[segment])
        else:
            segments[segment] = limb(segments[segment][:, :, 1], turned[:, :, 2])
    return segments


def _link_slots(model: SkeletonModel) -> dict[str, int]:
    """Segment -> slot of the link that turns with it, as far as there are such links."""
    names = [*map(split_side, model.marker_names), ("", "")]  # slot -1 is no marker
    slots: dict[str, int] = {}
    for k, (start, end) in enumerate(zip(model.link_parents, model.link_children, strict=True)):
        parent, (child, side) = names[start][0], names[end]
        for segment, (parents, children) in _LINKS.items():
            fits = child in children and (not parents or parent in parents)
            if fits and side in (("",) if segment in _TRUNK else SIDES):
                slots.setdefault(f"{side} {segment}".strip(), k)
    return slots


def _complete(frames: Floats) -> Flags:
    return np.asarray(np.isfinite(frames).all(axis=(-1, -2)))


# -- frames and vectors ----------------------------------------------------------------------------


def frame(*, y: Floats, z: Floats, keep: str = "z") -> Floats:
    """Right-handed frames (T, 3, 3) of two directions (T, 3), of which ``keep`` is kept exactly."""
    x = unit(np.cross(y, z))
    if keep == "z":
        z = unit(z)
        y = np.cross(z, x)
    else:
        y = unit(y)
        z = np.cross(x, y)
    return np.stack([x, y, z], axis=-1)


def limb(y: Floats, z: Floats) -> Floats:
    """Frames of a limb with the long axis y; x and z are NaN where ``z`` is."""
    axes = frame(y=y, z=z, keep="y")
    axes[:, :, 1] = unit(y)
    return axes


def unit(vectors: Floats) -> Floats:
    """Vectors of length 1; NaN for those of length 0."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / np.where(length > 1e-9, length, np.nan))


def between(u: Floats, v: Floats) -> Floats:
    """Angle between vectors, rad; by its tangent, which is exact for small angles, too."""
    cross = np.linalg.norm(np.cross(u, v), axis=-1)
    return np.asarray(np.arctan2(cross, np.sum(u * v, axis=-1)))


def zxy(proximal: Floats, distal: Floats) -> tuple[Floats, Floats, Floats]:
    """Angles z, x, y, rad, of a segment (..., 3, 3) in another one: R = Rz Rx Ry."""
    r = np.swapaxes(proximal, -1, -2) @ distal
    return (
        np.arctan2(-r[..., 0, 1], r[..., 1, 1]),
        np.arcsin(np.clip(r[..., 2, 1], -1, 1)),
        np.arctan2(-r[..., 2, 0], r[..., 2, 2]),
    )
