"""Pictures, drawn by matplotlib: in files, on pages and in notebooks; the floor from above."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hiros_mcap.outputs import replacing
from hiros_viewer.figures import MARKED, SPREAD, CurveGrid, CurvePlot

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from hiros_mcap.plan.planning import PlannedCamera, RoomPlan
    from hiros_mcap.simulate.settings import RigParams
    from hiros_mcap.skeletons import Flags, Floats


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure, size in inches."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def picture_of(grid: CurveGrid, title: Sequence[str] = ()) -> Figure:
    """Draw plots of curves below lines of a title."""
    n = max(map(len, grid.rows))
    figure = new_figure(11, grid.height)
    if title:
        figure.suptitle("\n".join(filter(None, title)), fontsize=9, x=0.01, ha="left")
    table = figure.subplots(len(grid.rows), n, sharex=True, squeeze=False)
    for row, cells in zip(grid.rows, table, strict=True):
        for plot, axes in zip(row, cells, strict=False):
            _draw(plot, axes)
            for mark in grid.marks:
                colour = MARKED[mark.kind]
                axes.axvspan(mark.start, mark.end, color=colour, alpha=0.25, lw=0, zorder=0)
        for axes in cells[len(row) :]:
            axes.set_visible(False)
    table[0, 0].set_xlim(grid.x_range)
    for axes in table[-1]:
        axes.set_xlabel(grid.x_title)
    return figure


def _draw(plot: CurvePlot, axes: Axes) -> None:
    """Draw one plot; its curves are named in their colours above its right end."""
    if plot.has_zero:
        axes.axhline(0, color=SPREAD, lw=0.8)
    for curve in plot.curves:
        dots = "o" if curve.has_dots else None
        axes.plot(curve.x, curve.y, color=curve.colour, lw=curve.width, marker=dots)
    axes.set_title(plot.title, loc="left", fontsize=9)
    axes.set(ylabel=plot.y_title, ylim=plot.y_range)
    place, style = 1.0, {"transform": axes.transAxes, "ha": "right", "va": "bottom"}
    for curve in reversed(plot.curves) if len(plot.curves) > 1 else ():
        axes.text(place, 1.01, curve.name, color=curve.colour, fontsize=9, **style)  # type: ignore[arg-type]
        place -= 0.022 * (len(curve.name) + 1)
    # What carries no data goes.
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(alpha=0.3)
    axes.set_axisbelow(True)


def png_of(figure: Figure) -> bytes:
    """Return a figure as PNG; the same figure gives the same bytes."""
    buffer = io.BytesIO()
    # Without matplotlib's version; the name is how a later run knows the file.
    figure.savefig(buffer, format="png", dpi=150, metadata={"Software": "hiros"})
    return buffer.getvalue()


def save_png(figure: Figure, path: Path) -> None:
    """Write a figure as PNG, whole or not at all; raises LogError if it cannot be written."""
    with replacing(path) as temporary:
        temporary.write_bytes(png_of(figure))


_CAMERA, _FURTHER, _WALL, _HATCH = "#111111", "#0a7d4b", "#444444", "#555555"
_WIDTH = 8.0  # inches
_BESIDE = 0.6  # m, around the room
_WEDGE = 0.45  # m; length of the sign that shows which way a camera looks
_ENOUGH = 0.8  # share of people that two cameras should see; below, the floor is hatched


def floor_figure(plan: RoomPlan) -> Figure:
    """Draw the plan."""
    x0, y0, x1, y1 = plan.params.area
    height = 1.5 + 0.78 * _WIDTH * (y1 - y0 + 2 * _BESIDE) / (x1 - x0 + 2 * _BESIDE)
    figure = new_figure(_WIDTH, float(np.clip(height, 3.5, 16.0)))
    axes = figure.subplots()
    _draw_map(figure, axes, plan)
    axes.plot([x0, x1, x1, x0, x0], [y0, y0, y1, y1, y0], color=_WALL, lw=2.5, zorder=4)
    for camera in plan.cameras:
        _draw_camera(axes, camera, plan, _CAMERA)
    _draw_camera(axes, plan.further, plan, _FURTHER)
    axes.set(xlabel="x, m", ylabel="y, m", aspect="equal")
    axes.set(xlim=(x0 - _BESIDE, x1 + _BESIDE), ylim=(y0 - _BESIDE, y1 + _BESIDE))
    axes.spines[:].set_visible(False)
    axes.set_title(_title(plan), loc="left", fontsize=10)
    _legend(figure)
    return figure


def _title(plan: RoomPlan) -> str:
    x0, y0, x1, y1 = plan.params.area
    count, people = len(plan.cameras), plan.params.people
    who = f"{people} {'person' if people == 1 else 'people'}"
    return (
        f"{x1 - x0:g} m x {y1 - y0:g} m, {count} camera{'s' * (count > 1)}, {who}\n"
        f"expected error {plan.expected.error_mm:.0f} mm; "
        f"two cameras see {math.floor(100 * plan.expected.two + 1e-6)} %; "
        f"with one more camera {plan.further.then.error_mm:.0f} mm"
    )


def _draw_map(figure: Figure, axes: Axes, plan: RoomPlan) -> None:
    floor, errors = plan.floor, plan.errors_mm
    x, y = _edges(floor.x), _edges(floor.y)
    finite = errors[np.isfinite(errors)]
    low, high = (finite.min(), np.percentile(finite, 98)) if len(finite) else (0.0, 1.0)
    high = max(high, low + 1.0)
    axes.set_facecolor("#ffffff")
    mesh = axes.pcolormesh(x, y, errors, cmap="YlOrRd", vmin=low, vmax=high, zorder=1)
    bar = figure.colorbar(mesh, ax=axes, extend="max", shrink=0.8, pad=0.02)
    bar.set_label("expected error of a joint, mm")
    _hatch(axes, x, y, plan.two < _ENOUGH)


def _hatch(axes: Axes, x: Floats, y: Floats, few: Flags) -> None:
    """Hatch the cells (rows, columns) that fewer than two cameras see."""
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path

    unit = np.asarray(Path.unit_rectangle().vertices, float)
    boxes = [unit * [x[k + 1] - x[k], y[j + 1] - y[j]] + [x[k], y[j]] for j, k in np.argwhere(few)]
    if boxes:
        cells = Path.make_compound_path(*(Path(box, closed=True) for box in boxes))
        style: dict[str, Any] = {"fc": "none", "ec": _HATCH, "hatch": "///", "lw": 0}
        axes.add_patch(PathPatch(cells, zorder=2, **style))


def _edges(middles: Floats) -> Floats:
    half = (middles[1] - middles[0]) / 2 if len(middles) > 1 else 0.5
    return np.append(middles - half, middles[-1] + half)


def _draw_camera(axes: Axes, camera: PlannedCamera, plan: RoomPlan, colour: str) -> None:
    """Draw where a camera stands, what it sees within the room, and which way it looks."""
    from matplotlib.patches import Rectangle

    x0, y0, x1, y1 = plan.params.area
    room = Rectangle((x0, y0), x1 - x0, y1 - y0, transform=axes.transData)
    dashed = "--" if camera is plan.further else "-"
    seen = axes.plot(*_sector(camera, plan.params.rig).T, dashed, color=colour, lw=1, alpha=0.55)
    seen[0].set(clip_path=room, zorder=3)
    near = _sector(camera, plan.params.rig, _WEDGE)
    axes.fill(*near.T, color=colour, alpha=0.45, lw=0, zorder=5)
    axes.plot(camera.x, camera.y, "o", color=colour, ms=9, mec="white", zorder=6, clip_on=False)
    bearing = np.radians(camera.bearing_deg)
    name = "+1" if camera is plan.further else camera.name.removeprefix("camera_")
    behind = camera.x - 0.4 * np.cos(bearing), camera.y - 0.4 * np.sin(bearing)
    axes.text(*behind, name, color=colour, ha="center", va="center", weight="bold", zorder=6)


def _sector(camera: PlannedCamera, rig: RigParams, far: float = np.inf) -> Floats:
    """(n, 2) the outline of what a camera sees from above, as far as its range or ``far``, m."""
    half = np.radians(rig.fov[0]) / 2
    aside = np.linspace(-half, half, 25)
    # The range is a depth along the axis.
    lengths = np.minimum(rig.range[1] / np.cos(aside), far)
    angles = np.radians(camera.bearing_deg) + aside
    middle = np.array([camera.x, camera.y])
    ends = middle + lengths[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    return np.concatenate([[middle], ends, [middle]])


def _legend(figure: Figure) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    dot: dict[str, Any] = {"marker": "o", "ls": "", "ms": 8}
    handles = [
        Line2D([], [], color=_CAMERA, label="camera", **dot),
        Line2D([], [], color=_FURTHER, label="one more camera", **dot),
        Patch(fc="none", ec=_HATCH, hatch="///", lw=0, label="fewer than two cameras"),
    ]
    figure.legend(handles=handles, loc="outside lower left", ncols=3, frameon=False)


def joint_map(cameras: Mapping[str, Mapping[str, float]], unit: str) -> Figure:
    """Plot a number of each joint by camera."""
    names = list(dict.fromkeys(name for joints in cameras.values() for name in joints))
    table: Floats = np.array(
        [[joints.get(name, np.nan) for name in names] for joints in cameras.values()]
    )
    figure = new_figure(0.28 * len(names) + 2.5, 0.35 * len(cameras) + 2.2)
    axes = figure.subplots()
    image = axes.imshow(table, aspect="auto", cmap="viridis", vmin=0)
    axes.set_xticks(range(len(names)), names, rotation=90, fontsize=8)
    axes.set_yticks(range(len(cameras)), list(cameras), fontsize=8)
    figure.colorbar(image, label=unit)
    bright = np.nanmax(table, initial=0.0) / 2
    for (row, column), value in np.ndenumerate(table):
        if not np.isnan(value):
            colour = "black" if value > bright else "white"
            axes.text(
                column, row, f"{value:.0f}", ha="center", va="center", fontsize=7, color=colour
            )
    return figure
