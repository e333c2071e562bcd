"""Results for biomechanics: TRC and MOT of OpenSim, and C3D."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hiros_mcap.skeletons import Floats

if TYPE_CHECKING:
    from hiros_mcap.io.result import Motion, Result

# OpenSim's coordinates (Rajagopal 2016) by our angles, with the factor between their signs.
_COORDINATES = {
    "pelvis_tilt": ("pelvis tilt", -1),
    "pelvis_list": ("pelvis obliquity", 1),
    "pelvis_rotation": ("pelvis rotation", 1),
    "lumbar_extension": ("trunk flexion", -1),
    "lumbar_bending": ("trunk side bend", 1),
    "lumbar_rotation": ("trunk rotation", 1),
    **{
        f"{name}_{side[0]}": (f"{side} {angle}", factor)
        for side in ("right", "left")
        for name, angle, factor in (
            ("hip_flexion", "hip flexion", 1),
            ("hip_adduction", "hip abduction", -1),
            ("hip_rotation", "hip rotation", 1),
            ("knee_angle", "knee flexion", 1),
            ("ankle_angle", "ankle dorsiflexion", 1),
            ("arm_flex", "shoulder flexion", 1),
            ("arm_add", "shoulder abduction", -1),
            ("arm_rot", "shoulder rotation", 1),
            ("elbow_flex", "elbow flexion", 1),
        )
    },
}


def y_up(positions: Floats) -> Floats:
    """Coordinates with z up as OpenSim and animation programs have them, y up: (x, z, -y)."""
    return np.asarray(positions[..., [0, 2, 1]] * np.array([1.0, 1.0, -1.0]))


def only(result: Result) -> Motion:
    """Return the motion of the one person in a result."""
    (motion,) = result.motions.values()
    return motion


def write_trc(result: Result, target: Path, parts: tuple[str, ...]) -> None:
    """Write one person's markers, mm, y up; an empty cell is a gap."""
    motion = only(result)
    names = result.model.marker_names
    rate, n = round(motion.rate, 6), len(motion.times)
    axes = "\t".join(f"X{k}\tY{k}\tZ{k}" for k in range(1, len(names) + 1))
    head = [
        f"PathFileType\t4\t(X/Y/Z)\t{result.path.stem}.trc",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame"
        "\tOrigNumFrames",
        f"{rate:g}\t{rate:g}\t{n}\t{len(names)}\tmm\t{rate:g}\t1\t{n}",
        "Frame#\tTime\t" + "\t\t\t".join(names) + "\t\t",
        f"\t\t{axes}",
        "",
    ]
    points = 1000 * y_up(motion.positions).reshape(n, -1)
    rows = [
        "\t".join([str(k), f"{time:.6f}", *(_cell(value) for value in row)])
        for k, (time, row) in enumerate(zip(motion.times.tolist(), points.tolist(), strict=True), 1)
    ]
    target.write_text("\n".join([*head, *rows]) + "\n", encoding="utf-8")


def _cell(value: float) -> str:
    return "" if np.isnan(value) else f"{value:.4f}"


def write_mot(result: Result, target: Path, parts: tuple[str, ...]) -> None:
    """Write one person's angles as coordinates of OpenSim's Rajagopal model, degrees and m.

    Axial rotations that markers do not show are 0, since OpenSim reads no gaps.
    """
    motion = only(result)
    angles = result.angles()
    columns = {n: f * angles[a].to_numpy() for n, (a, f) in _COORDINATES.items()}
    pelvis = y_up(_pelvis(result, motion))
    columns |= {f"pelvis_t{axis}": pelvis[:, k] for k, axis in enumerate("xyz")}
    numbers = np.nan_to_num(np.stack([motion.times, *columns.values()], axis=-1))
    head = [
        result.path.stem,
        "version=1",
        f"nRows={len(numbers)}",
        f"nColumns={numbers.shape[1]}",
        "inDegrees=yes",
        "endheader",
        "\t".join(["time", *columns]),
    ]
    rows = ["\t".join(f"{value:.6f}" for value in row) for row in numbers.tolist()]
    target.write_text("\n".join([*head, *rows]) + "\n", encoding="utf-8")


def _pelvis(result: Result, motion: Motion) -> Floats:
    """(T, 3) the root of the skeleton: the first marker that no link leads to, m."""
    children = set(result.model.link_children)
    root = next((m for m in range(result.model.n_markers) if m not in children), 0)
    return motion.positions[:, root]


def write_c3d(result: Result, target: Path, parts: tuple[str, ...]) -> None:
    """Write everybody's markers, mm, and angles, degrees, z up; a gap has the residual -1."""
    import ezc3d

    motions = result.motions
    rate = next(iter(motions.values())).rate
    first = min(m.times[0] for m in motions.values())
    last = max(m.times[-1] for m in motions.values())
    n = round((last - first) * rate) + 1
    labels: list[str] = []
    columns: list[Floats] = []
    for person, motion in motions.items():
        places = np.round((motion.times - first) * rate).astype(int)
        before = f"{person}:" if len(motions) > 1 else ""
        if "joints" in parts:
            labels += [f"{before}{name}" for name in result.model.marker_names]
            columns += _placed(1000 * motion.positions, places, n)
        if "angles" in parts:
            angles = result.select(person).angles()
            labels += [f"{before}{name}" for name in angles.columns]
            values = np.zeros((*angles.shape, 3))
            values[:, :, 0] = angles.to_numpy()
            columns += _placed(values, places, n)
    file = ezc3d.c3d()
    points = np.stack(columns, axis=1)  # (3, points, frames)
    gaps = np.isnan(points).any(axis=0)
    file["parameters"]["POINT"]["RATE"]["value"] = [rate]
    file["parameters"]["POINT"]["LABELS"]["value"] = labels
    file["parameters"]["POINT"]["UNITS"]["value"] = ["mm"]
    file["data"]["points"] = np.concatenate([points, np.ones((1, *points.shape[1:]))])
    file["data"]["meta_points"]["residuals"] = np.where(gaps, -1.0, 0.0)[None]
    written = target.with_suffix(".c3d")  # ezc3d appends it to any other name
    file.write(str(written))
    written.replace(target)


def _placed(values: Floats, places: Floats, n: int) -> list[Floats]:
    """(3, n) of each column of (T, K, 3), at its place in time; NaN where nothing is."""
    out = np.full((values.shape[1], 3, n), np.nan)
    out[:, :, places] = np.moveaxis(values, 0, -1)
    return list(out)
