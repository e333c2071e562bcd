"""Pictures of a result for a notebook, which stay in it when it is saved or sent."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from hiros_mcap.errors import ConfigError

if TYPE_CHECKING:
    from pathlib import Path

    from matplotlib.figure import Figure

    from hiros_mcap.io.result import Motion, Result
    from hiros_mcap.skeletons import Floats

_POSES = 5
_INCH = 5.5


class Picture:
    """A drawing that a notebook shows; ``figure`` is matplotlib's."""

    def __init__(self, figure: Figure, text: str) -> None:
        self.figure = figure
        self.text = text

    def __repr__(self) -> str:
        return f"<Picture {self.text}>"

    def _repr_png_(self) -> bytes:
        """PNG for Jupyter, JupyterLab, VS Code and Colab."""
        from hiros_viewer.pictures import png_of

        return png_of(self.figure)

    def save(self, path: Path | str) -> None:
        """Write the picture; the suffix says as what (.png, .svg, .pdf)."""
        self.figure.savefig(path)


def show(result: Result, person: int | None = None) -> Picture:
    """Draw people in the room: poses at a few instants, and their ways from above.

    Early poses are pale. For an interactive view, run ``hiros view`` on the result's file.

    Parameters
    ----------
    result : of :func:`hiros_mcap.open_result`. person : one id; None = everybody.

    Raises
    ------
    ConfigError
        There is nobody to draw.
    """
    from hiros_viewer.pictures import new_figure

    if person is not None:
        result = result.select(person)
    _need_people(result)
    figure = new_figure(2 * _INCH, _INCH)
    room: Any = figure.add_subplot(1, 2, 1, projection="3d")
    above = figure.add_subplot(1, 2, 2)
    for who, motion in result.motions.items():
        colour = _colour(who)
        _draw_poses(room, result, motion, colour)
        way = np.nanmean(motion.positions, axis=1)
        above.plot(way[:, 0], way[:, 1], color=colour, lw=2, label=f"person {who}")
        above.plot(*way[-1, :2], "o", color=colour)
    room.set_aspect("equal")
    room.locator_params(nbins=5)
    room.set(xlabel="x, m", ylabel="y, m", title=result.path.name)
    above.set(xlabel="x, m", ylabel="y, m", title="from above; a dot is the end", aspect="equal")
    above.grid(alpha=0.3)
    above.legend(frameon=False)
    return Picture(figure, f"of {result!r}")


def plot(result: Result, person: int | None = None) -> Picture:
    """Draw the signed joint angles of one person over time, left beside right.

    ``docs/angles.md`` defines them.

    Parameters
    ----------
    result : of :func:`hiros_mcap.open_result`.
    person : an id; None = the one who is there for longest.

    Raises
    ------
    ConfigError
        There is nobody to draw, or the marker names tell no joint.
    """
    from hiros_viewer.figures import angle_grid
    from hiros_viewer.pictures import picture_of

    _need_people(result)
    if person is None:
        person = max(result.motions, key=lambda who: len(result.motions[who].times))
    one = result.select(person)
    seconds = one.motions[person].times
    title = f"{result.path.name}, person {person}"
    figure = picture_of(angle_grid(seconds, one.angles().to_numpy(), None), [title])
    return Picture(figure, f"of the joint angles of {title}")


def _need_people(result: Result) -> None:
    if not result.motions:
        raise ConfigError(f"{result.path}: {result.channel} holds no people")


def _draw_poses(
    room: Any, result: Result, motion: Motion, colour: tuple[float, float, float]
) -> None:
    """Draw the bones of one person at a few instants, the later the stronger."""
    links = result.model.links
    bones = links[(links >= 0).all(axis=1)]
    chosen = np.linspace(0, len(motion.times) - 1, _POSES).astype(int)
    for k, i in enumerate(np.unique(chosen).tolist()):
        ends: Floats = motion.positions[i][bones]
        for bone in ends[~np.isnan(ends).any(axis=(1, 2))]:
            strength = (k + 2) / (_POSES + 1)
            room.plot(*bone.T, color=colour, lw=1.6, alpha=min(1.0, strength))


def _colour(person: int) -> tuple[float, float, float]:
    """Return the person's colour, darker than on a dark ground."""
    from hiros_mcap.io.export.markers import person_colour

    red, green, blue = (0.8 * part / 255 for part in person_colour(person))
    return red, green, blue
