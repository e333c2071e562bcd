"""Results for animation: BVH."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hiros_mcap.body.rotations import Y_UP, nearest_rotation
from hiros_mcap.errors import ConfigError
from hiros_mcap.io.export.biomechanics import only
from hiros_mcap.io.export.choices import Choices, pauses
from hiros_mcap.io.export.rajagopal import bridged
from hiros_mcap.io.export.tables import write_lines
from hiros_mcap.outputs import BVH_START
from hiros_mcap.skeletons import Floats, SkeletonModel

if TYPE_CHECKING:
    from hiros_mcap.io.result import Result

Tree = dict[int, list[int]]
"""Marker slot -> slots of its children."""


def write_bvh(result: Result, target: Path, choices: Choices) -> None:
    """Write one person as a hierarchy of joints with constant offsets, cm, y up.

    A joint's rotation brings the offsets of its children to where the markers are: exactly where
    there is one child, by least squares where there are several. Gaps are bridged and named,
    since BVH has none.
    """
    if choices.keep_gaps:
        raise ConfigError("BVH has no gaps; choose another format, or let them be bridged")
    motion = only(result)
    root, tree = tree_of(result.model)
    needed = [root, *_descendants(tree, root)]
    absent = np.asarray(np.isnan(motion.positions[:, needed]).any(axis=(1, 2)))
    if absent.any():
        choices.warn(f"{result.path}: bridged markers: {pauses(motion.times, absent)}")
    points = _without_gaps(100 * motion.positions @ Y_UP.T, needed)
    rest = _rest_offsets(points, tree)
    lines = [BVH_START]
    order: list[int] = []
    _declare(lines, order, result.model, tree, rest, root)
    rotations = _rotations(points, tree, rest, root)
    lines += ["MOTION", f"Frames: {len(points)}", f"Frame Time: {1 / motion.rate:.8f}"]
    inner = [slot for slot in order if tree.get(slot)]
    numbers = np.concatenate(
        [points[:, root], *(_zxy_degrees(rotations[slot]) for slot in inner)], axis=1
    )
    lines += [" ".join(f"{value:.5f}" for value in row) for row in numbers.tolist()]
    write_lines(target, lines)


def tree_of(model: SkeletonModel) -> tuple[int, Tree]:
    """Return the root and the children of every marker, by the links.

    Raises ConfigError if the links form no tree with one root.
    """
    tree: Tree = {}
    for parent, child in zip(model.link_parents, model.link_children, strict=True):
        if parent >= 0 and child >= 0:
            tree.setdefault(parent, []).append(child)
    children = [child for some in tree.values() for child in some]
    roots = [slot for slot in tree if slot not in children]
    if len(roots) != 1 or len(set(children)) != len(children):
        raise ConfigError("BVH needs a skeleton whose links form a tree with one root")
    return roots[0], tree


def _descendants(tree: Tree, slot: int) -> list[int]:
    return [x for child in tree.get(slot, []) for x in (child, *_descendants(tree, child))]


def _without_gaps(points: Floats, needed: list[int]) -> Floats:
    """Fill gaps of (T, M, 3) linearly, and at both ends with the nearest value.

    Raises ConfigError if a marker is never there.
    """
    filled = points.copy()
    for slot in needed:
        if np.isnan(points[:, slot, 0]).all():
            raise ConfigError("BVH needs every marker of the skeleton at least once")
        for axis in range(3):
            filled[:, slot, axis] = bridged(points[:, slot, axis])
    return filled


def _rest_offsets(points: Floats, tree: Tree) -> dict[int, Floats]:
    """(3,) offset of each child from its parent: its median length, its first direction."""
    offsets = {}
    for parent, children in tree.items():
        for child in children:
            bones = points[:, child] - points[:, parent]
            length = float(np.median(np.linalg.norm(bones, axis=-1)))
            first = float(np.linalg.norm(bones[0]))
            offsets[child] = bones[0] * (length / first if first > 0 else 1.0)
    return offsets


def _rotations(points: Floats, tree: Tree, rest: dict[int, Floats], root: int) -> dict[int, Floats]:
    """(T, 3, 3) rotation of each joint in its parent's frame."""
    rests: dict[int, Floats] = {}
    rotations = {root: np.broadcast_to(np.eye(3), (len(points), 3, 3))}
    for slot in [root, *_descendants(tree, root)]:
        children = tree.get(slot, [])
        if not children:
            continue
        above = rotations[slot]
        reference = np.stack([rest[child] for child in children])
        world = np.stack([points[:, child] - points[:, slot] for child in children], axis=1)
        local = np.einsum("tij,tki->tkj", above, world)
        rests[slot] = _aligned(reference, local)
        for child in children:
            rotations[child] = above @ rests[slot]
    return rests


def _aligned(reference: Floats, local: Floats) -> Floats:
    """(T, 3, 3) rotations that bring reference vectors (K, 3) nearest to (T, K, 3).

    For one vector, the shortest rotation; for several, Kabsch's (Acta Cryst. A32, 1976).
    """
    from scipy.spatial.transform import Rotation

    if len(reference) == 1:
        a = reference[0] / np.linalg.norm(reference[0])
        b = local[:, 0] / np.linalg.norm(local[:, 0], axis=-1, keepdims=True)
        axis = np.cross(a, b)
        sine = np.linalg.norm(axis, axis=-1, keepdims=True)
        angle = np.arctan2(sine, (b @ a)[:, None])
        return Rotation.from_rotvec(axis * angle / np.maximum(sine, 1e-12)).as_matrix()
    return nearest_rotation(np.einsum("ki,tkj->tij", reference, local))


def _zxy_degrees(matrices: Floats) -> Floats:
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(matrices).as_euler("ZXY", degrees=True))


def _declare(
    lines: list[str],
    order: list[int],
    model: SkeletonModel,
    tree: Tree,
    rest: dict[int, Floats],
    slot: int,
    depth: int = 0,
) -> None:
    """Append the declaration of a joint and of all below it."""
    pad = "  " * depth
    kind = "JOINT" if depth else "ROOT"
    children = tree.get(slot, [])
    place = "Xposition Yposition Zposition " if not depth else ""
    x, y, z = rest.get(slot, np.zeros(3)).tolist()
    offset = f"OFFSET {x:.5f} {y:.5f} {z:.5f}"
    order.append(slot)
    if not children:
        lines += [f"{pad}End Site", f"{pad}{{", f"{pad}  {offset}", f"{pad}}}"]
        return
    name = re.sub(r"[\s{}]", "_", model.marker_names[slot])
    lines += [f"{pad}{kind} {name}", f"{pad}{{", f"{pad}  {offset}"]
    n = 3 + 3 * (not depth)
    lines.append(f"{pad}  CHANNELS {n} {place}Zrotation Xrotation Yrotation")
    for child in children:
        _declare(lines, order, model, tree, rest, child, depth + 1)
    lines.append(f"{pad}}}")
