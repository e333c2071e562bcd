"""Results for biomechanics and animation: TRC and MOT of OpenSim, C3D, and BVH."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np

from hiros_mcap.body.rotations import Y_UP, from_vector, nearest_rotation, to_matrix
from hiros_mcap.body.segments import zxy
from hiros_mcap.body.symmetry import split_side
from hiros_mcap.errors import ConfigError, LogError
from hiros_mcap.io.export.rajagopal import NEEDS, PELVIS, bridged, coordinates
from hiros_mcap.io.export.tables import Parts, Warn, write_lines
from hiros_mcap.io.joints.c3d_file import MOST_FRAMES, open_c3d
from hiros_mcap.io.result import safe_name
from hiros_mcap.outputs import BVH_START, EXPORT_MARK
from hiros_mcap.skeletons import Flags, Floats, SkeletonModel

if TYPE_CHECKING:
    from hiros_mcap.io.result import Result

_CLOSE_DEG = 3.0  # no bone deviates by more in a pose that the model can take
_FOLLOWED = ("hip", "knee", "ankle", "shoulder", "elbow", "wrist")
"""Joints that inverse kinematics follows."""
_FEW = 0.01  # share of the frames in which a bone may deviate without a word
_MOST_PAUSES = 3


def pauses(times: Floats, absent: Flags) -> str:
    """Name the gaps of (T,) instants, s: all if they are few, else the longest.

    >>> pauses(np.arange(6.0), np.array([0, 1, 1, 0, 0, 1], bool))
    '2 gaps, 3.0 s in all: 0.0 to 3.0 s, 4.0 to 5.0 s'
    """
    edges = np.flatnonzero(np.diff(np.concatenate([[False], absent, [False]]).astype(np.int8)))
    last = len(times) - 1
    gaps = [(times[max(a - 1, 0)], times[min(b, last)]) for a, b in edges.reshape(-1, 2)]
    if not gaps:
        return ""
    longest = sorted(gaps, key=lambda gap: gap[0] - gap[1])[:_MOST_PAUSES]
    spans = ", ".join(f"{start:.1f} to {end:.1f} s" for start, end in sorted(longest))
    if len(gaps) == 1:
        return f"{spans}"
    whole = sum(end - start for start, end in gaps)
    which = "the longest: " if len(gaps) > _MOST_PAUSES else ""
    return f"{len(gaps)} gaps, {whole:.1f} s in all: {which}{spans}"


def write_trc(result: Result, target: Path, parts: Parts, warn: Warn) -> None:
    """Write one person's markers, mm, y up; an empty cell is a gap.

    OpenSim's inverse kinematics stops at a row without its markers, so these rows are left out; a
    warning names them. Raises ConfigError if none is left.
    """
    (motion,) = result.motions.values()
    names = result.model.marker_names
    followed = [k for k, name in enumerate(names) if split_side(name)[0] in _FOLLOWED]
    # If the markers have the names of another model, any of them counts.
    shown = motion.positions[:, followed] if followed else motion.positions
    seen = np.asarray(np.isfinite(shown).all(axis=-1).any(axis=-1))
    if not seen.any():
        raise ConfigError(f"{result.path}: no joint of OpenSim's model is ever seen")
    if not seen.all():
        warn(
            f"{result.path}: left out the rows in which no joint of OpenSim's model is seen: "
            f"{pauses(motion.times, ~seen)}"
        )
    rate, n = round(motion.rate, 6), int(seen.sum())
    axes = "\t".join(f"X{k}\tY{k}\tZ{k}" for k in range(1, len(names) + 1))
    head = [
        f"PathFileType\t4\t(X/Y/Z)\t{safe_name(result.path.name)}\t{EXPORT_MARK}",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame"
        "\tOrigNumFrames",
        f"{rate:g}\t{rate:g}\t{n}\t{len(names)}\tmm\t{rate:g}\t1\t{n}",
        "Frame#\tTime\t" + "\t\t\t".join(names) + "\t\t",
        f"\t\t{axes}",
        "",
    ]
    points = 1000 * (motion.positions[seen] @ Y_UP.T).reshape(n, -1)
    times = motion.times[seen].tolist()
    frames = (np.flatnonzero(seen) + 1).tolist()  # as if all rows were there
    # OpenSim counts a row's cells by the tabs behind them.
    rows = [
        "\t".join([str(k), f"{time:.6f}", *(_cell(value) for value in row), ""])
        for k, time, row in zip(frames, times, points.tolist(), strict=True)
    ]
    write_lines(target, [*head, *rows])


def _cell(value: float) -> str:
    return "" if np.isnan(value) else f"{value:.4f}"


def write_mot(result: Result, target: Path, parts: Parts, warn: Warn) -> None:
    """Write one person's pose as coordinates of OpenSim's Rajagopal model, degrees and m.

    OpenSim reads no gaps. Rows without the pelvis are left out, and so are coordinates that are
    never known; gaps of limbs are bridged. A warning names each.

    Raises ConfigError if the pose of the pelvis is never known.
    """
    (motion,) = result.motions.values()
    columns, deviations = coordinates(result.model, motion)
    absent = {name for name, column in columns.items() if np.isnan(column).all()}
    lacking = [
        f"{', '.join(group)} need {joints}"
        for group, joints in NEEDS.items()
        if any(name.removesuffix("_l").removesuffix("_r") in group for name in absent)
    ]
    if absent & {*PELVIS}:
        raise ConfigError(f"{result.path}: MOT has no pelvis: {lacking[0]}")
    if lacking:
        warn(f"{result.path}: left out {', '.join(sorted(absent))}: {'; '.join(lacking)}")
    if text := _bent_otherwise(deviations):
        warn(f"{result.path}: {text}")
    columns = {name: column for name, column in columns.items() if name not in absent}
    for text in _gaps(motion.times, columns):
        warn(f"{result.path}: {text}")
    numbers = np.stack([motion.times, *map(bridged, columns.values())], axis=-1)
    numbers = numbers[~np.isnan(columns[PELVIS[0]])]
    head = [
        safe_name(result.path.name),
        EXPORT_MARK,
        "version=1",
        f"nRows={len(numbers)}",
        f"nColumns={numbers.shape[1]}",
        "inDegrees=yes",
        "endheader",
        "\t".join(["time", *columns]),
    ]
    rows = ["\t".join(f"{value:.6f}" for value in row) for row in numbers.tolist()]
    write_lines(target, [*head, *rows])


def _bent_otherwise(deviations: Mapping[str, Floats]) -> str:
    """Name the bones that the model cannot bring where the detector has them; "" if none."""
    texts = []
    for bone, degrees in deviations.items():
        known = degrees[~np.isnan(degrees)]
        far = known[known > _CLOSE_DEG]
        if len(far) > _FEW * len(known):
            texts.append(
                f"the {bone} in {len(far)} of {len(known)} frames, by {np.median(far):.0f} degrees "
                f"in the median and at most {far.max():.0f}"
            )
    if not texts:
        return ""
    return f"knees or elbows bend as the model's cannot, so it differs: {'; '.join(texts)}"


def _gaps(times: Floats, columns: Mapping[str, Floats]) -> Iterator[str]:
    """Name the rows that are left out, and the gaps of limbs that are bridged."""
    whole = np.isnan(columns[PELVIS[0]])
    if whole.any():
        yield f"left out the rows without a pelvis: {pauses(times, whole)}"
    names: dict[bytes, list[str]] = {}
    for name, column in columns.items():
        names.setdefault((np.isnan(column) & ~whole).tobytes(), []).append(name)
    for mask, limb in names.items():
        if (gaps := np.frombuffer(mask, bool)).any():
            yield f"bridged {', '.join(limb)}: {pauses(times, gaps)}"


_MOST_TEXTS = 255
"""Of a parameter in a C3D file: a byte counts them; ANGLES2 continues ANGLES, as LABELS2 LABELS."""


def write_c3d(result: Result, target: Path, parts: Parts, warn: Warn) -> None:
    """Write everybody's markers, mm, and angles, degrees, z up; a gap has the residual -1.

    An angle is the x of a point that POINT:ANGLES names.

    Raises ConfigError for more frames than the header of a C3D file counts.
    """
    import ezc3d

    motions = result.motions
    rate = next(iter(motions.values())).rate
    first = min(m.times[0] for m in motions.values())
    last = max(m.times[-1] for m in motions.values())
    n: int = round((last - first) * rate) + 1
    if n > MOST_FRAMES:
        raise ConfigError(
            f"{result.path}: C3D counts at most {MOST_FRAMES} frames, and this would have {n}; "
            "choose a part with --start and --end, a lower --rate, or another format"
        )
    labels: list[str] = []
    angle_labels: list[str] = []
    columns: list[Floats] = []
    for person, motion in motions.items():
        places = np.round((motion.times - first) * rate).astype(int)
        before = f"{person}:" if len(motions) > 1 else ""
        if "joints" in parts:
            labels += [f"{before}{name}" for name in result.model.marker_names]
            columns += _placed(1000 * motion.positions, places, n)
        if "angles" in parts:
            angles = result.select(person).angles(0)
            names = [f"{before}{name}" for name in angles.columns]
            labels, angle_labels = [*labels, *names], [*angle_labels, *names]
            values = np.zeros((*angles.shape, 3))
            values[:, :, 0] = angles.to_numpy()
            columns += _placed(values, places, n)
    file = ezc3d.c3d()
    points = np.stack(columns, axis=1)  # (3, points, frames)
    gaps = np.isnan(points).any(axis=0)
    file["parameters"]["POINT"]["RATE"]["value"] = [rate]
    file["parameters"]["POINT"]["LABELS"]["value"] = labels
    file["parameters"]["POINT"]["UNITS"]["value"] = ["mm"]
    file.add_parameter("MANUFACTURER", "SOFTWARE", [EXPORT_MARK])
    if angle_labels:
        for k in range(0, len(angle_labels), _MOST_TEXTS):
            number = f"{k // _MOST_TEXTS + 1}" if k else ""
            file.add_parameter("POINT", f"ANGLES{number}", angle_labels[k : k + _MOST_TEXTS])
        file.add_parameter("POINT", "ANGLE_UNITS", ["deg"])
    file["data"]["points"] = np.concatenate([points, np.ones((1, *points.shape[1:]))])
    file["data"]["meta_points"]["residuals"] = np.where(gaps, -1.0, 0.0)[None]
    # ezc3d appends .c3d to any other name, and does not see a full disk.
    with TemporaryDirectory() as folder:
        written = Path(folder) / "written.c3d"
        file.write(str(written))
        with suppress(ConfigError):
            if len(open_c3d(written).points) == n:
                shutil.copyfile(written, target)
                return
    raise LogError("cannot be written: the file was cut", path=result.path)


def _placed(values: Floats, places: Floats, n: int) -> list[Floats]:
    """(3, n) of each column of (T, K, 3), at its place in time; NaN where nothing is."""
    out = np.full((values.shape[1], 3, n), np.nan)
    out[:, :, places] = np.moveaxis(values, 0, -1)
    return list(out)


Tree = dict[int, list[int]]
"""Marker slot -> slots of its children."""


def write_bvh(result: Result, target: Path, parts: Parts, warn: Warn) -> None:
    """Write one person as a hierarchy of joints with constant offsets, cm, y up.

    A joint's rotation brings the offsets of its children to where the markers are: exactly where
    there is one child, by least squares where there are several. Gaps are bridged and named,
    since BVH has none.
    """
    (motion,) = result.motions.values()
    root, tree = tree_of(result.model)
    needed = [root, *_descendants(tree, root)]
    absent = np.asarray(np.isnan(motion.positions[:, needed]).any(axis=(1, 2)))
    if absent.any():
        warn(f"{result.path}: bridged markers: {pauses(motion.times, absent)}")
    points = _without_gaps(100 * motion.positions @ Y_UP.T, needed)
    rest = _rest_offsets(points, tree)
    lines = [BVH_START]
    order: list[int] = []
    _declare(lines, order, result.model, tree, rest, root)
    rotations = _rotations(points, tree, rest, root)
    lines += ["MOTION", f"Frames: {len(points)}", f"Frame Time: {1 / motion.rate:.8f}"]
    inner = [slot for slot in order if tree.get(slot)]
    turns = [np.degrees(angle) for slot in inner for angle in zxy(np.eye(3), rotations[slot])]
    numbers = np.column_stack([points[:, root], *turns])
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
    if len(reference) == 1:
        a = reference[0] / np.linalg.norm(reference[0])
        b = local[:, 0] / np.linalg.norm(local[:, 0], axis=-1, keepdims=True)
        axis = np.cross(a, b)
        sine = np.linalg.norm(axis, axis=-1, keepdims=True)
        angle = np.arctan2(sine, (b @ a)[:, None])
        return to_matrix(from_vector(axis * angle / np.maximum(sine, 1e-12)))
    return nearest_rotation(np.einsum("ki,tkj->tij", reference, local))


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
