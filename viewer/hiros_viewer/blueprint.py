"""What is shown beside what: the layouts of ``hiros view``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from hiros_viewer.columns import TIMELINE

if TYPE_CHECKING:
    import rerun.blueprint as rrb

    from hiros_mcap.skeletons import Floats

TRAIL_S = 2.0


@dataclass(frozen=True, slots=True)
class Content:
    """What a recording holds, as far as a layout must know."""

    stages: Sequence[str]
    """In the order of the chain; the last one is the result."""
    people: Sequence[int]
    cameras: Sequence[str]
    """As in entity paths."""
    centre: Floats
    """(3,) m: where people are."""
    reach: float
    """m: how far from it."""
    camera_centre: Floats | None = None
    """(3,) m: mean position of the cameras; None if nobody knows."""
    prefixes: Sequence[str] = ("",)
    """Of the logs that are overlaid."""

    @property
    def final(self) -> str:
        """The stage to look at first."""
        real = [stage for stage in self.stages if stage != "truth"]
        return real[-1] if real else (self.stages[-1] if self.stages else "")

    @property
    def is_raw(self) -> bool:
        """Whether there is nothing but detections, and perhaps the truth."""
        return all(stage == "truth" for stage in self.stages)


def overview(content: Content) -> rrb.Container:
    """Show the room with the result, and beside it all curves, who is there, and the events."""
    import rerun.blueprint as rrb

    if content.is_raw:
        return rrb.Vertical(
            _room(content, "Room", shown=[content.final]),
            _series("People per camera", "/people"),
            row_shares=[4, 1],
        )
    curves = rrb.Tabs(
        *(_angles(content, person) for person in content.people[:4]),
        _limbs(content, content.people),
        name="Angles, limbs",
    )
    speed = rrb.TimeSeriesView(origin="/", contents=_all(content, "/speed/**"), name="Speed, m/s")
    side = [curves, speed, _series("People per camera", "/people")]
    if len(content.prefixes) == 2:
        side.insert(0, _series("Joint distance between the logs, mm", "/distance"))
    return rrb.Horizontal(
        rrb.Vertical(
            _room(content, "Room", shown=[content.final]),
            rrb.Horizontal(
                rrb.StateTimelineView(
                    origin="/", contents=_all(content, "/state/**"), name="People"
                ),
                rrb.TextLogView(
                    origin="/",
                    contents=_all(content, "/log"),
                    name="Events",
                    columns=rrb.TextLogColumns(text_log_columns=["loglevel", "body"]),
                ),
                column_shares=[3, 2],
            ),
            row_shares=[4, 1],
        ),
        rrb.Vertical(*side, row_shares=[2, *([1] * (len(side) - 1))]),
        column_shares=[3, 2],
    )


def stages(content: Content) -> rrb.Container:
    """Every stage in a room of its own, on one time cursor."""
    import rerun.blueprint as rrb

    rooms = [
        _room(content, stage.capitalize(), shown=[stage], cameras=[])
        for stage in content.stages
        if stage != "truth"
    ]
    if not rooms:
        rooms = [_room(content, "Detections", shown=[])]
    return rrb.Grid(*rooms, grid_columns=2 if len(rooms) > 1 else 1)


def person(content: Content) -> rrb.Container:
    """One person's angles and limbs, a tab per person."""
    import rerun.blueprint as rrb

    tabs = [
        rrb.Vertical(
            _angles(content, who),
            rrb.Horizontal(
                _limbs(content, [who]), _series("Speed, m/s", "/speed", f"/speed/{who}")
            ),
            row_shares=[2, 1],
            name=f"Person {who}",
        )
        for who in content.people[:8]
    ]
    if not tabs or content.is_raw:
        return overview(content)
    return rrb.Horizontal(
        _room(content, "Room", shown=[content.final]), rrb.Tabs(*tabs), column_shares=[1, 1]
    )


def cameras(content: Content) -> rrb.Container:
    """Every camera's detections beside the result, and how far they are from it."""
    import rerun.blueprint as rrb

    rooms = [
        _room(content, camera, shown=[content.final], cameras=[camera])
        for camera in content.cameras
    ]
    below = [_series("People", "/people")]
    if not content.is_raw:
        below.insert(0, _series("Distance to the result, mm", "/residual"))
    return rrb.Vertical(rrb.Grid(*rooms), rrb.Horizontal(*below), row_shares=[3, 1])


LAYOUTS: dict[str, Callable[[Content], Any]] = {
    "overview": overview,
    "stages": stages,
    "person": person,
    "cameras": cameras,
}


def blueprint(content: Content, layout: str = "overview") -> rrb.Blueprint:
    """Return a layout by its name in :data:`LAYOUTS`, paused at the start."""
    import rerun.blueprint as rrb

    return rrb.Blueprint(
        LAYOUTS[layout](content),
        rrb.TimePanel(timeline=TIMELINE, state="collapsed", play_state="paused", loop_mode="all"),
        collapse_panels=True,
        auto_views=False,
    )


def _room(
    content: Content, name: str, *, shown: Sequence[str], cameras: Sequence[str] | None = None
) -> Any:
    """Return a 3D view; with the stages in ``shown`` and detections of ``cameras`` (None = all)."""
    import rerun as rr
    import rerun.blueprint as rrb

    what = ["+ /world/**"]
    seen = content.cameras if cameras is None else cameras
    what += [f"+ /detections/{camera}/**" for camera in seen]
    shown = [stage for stage in shown if stage]
    what += [f"+ {prefix}/{stage}/**" for prefix in content.prefixes for stage in shown]
    trail = rrb.VisibleTimeRanges(
        [
            rr.VisibleTimeRange(
                TIMELINE,
                start=rr.TimeRangeBoundary.cursor_relative(seconds=-TRAIL_S),
                end=rr.TimeRangeBoundary.cursor_relative(),
            )
        ]
    )
    trails = {
        f"{prefix}/{stage}/{who}/trail": trail
        for prefix in content.prefixes
        for stage in shown
        for who in content.people
    }
    eye = _eye(content)
    return rrb.Spatial3DView(
        origin="/",
        contents=what,
        name=name,
        background=(24, 27, 31),
        line_grid=rrb.LineGrid3D(visible=True, spacing=0.5, color=(255, 255, 255, 25)),
        eye_controls=rrb.EyeControls3D(
            position=eye, look_target=content.centre - [0, 0, 0.1], eye_up=(0, 0, 1)
        ),
        overrides=trails,  # type: ignore[arg-type]
    )


def _eye(content: Content) -> Floats:
    """(3,) Where to look from, m: behind cameras that stand on one side, else from a corner."""
    back, distance = np.array([-0.55, -0.85]), 1.8 * max(content.reach, 1.0) + 1.6
    if content.camera_centre is not None:
        offset = (content.camera_centre - content.centre)[:2]
        if np.linalg.norm(offset) > 1.0:
            turn = np.radians(22.0)
            across = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
            back, distance = across @ offset, max(distance, float(np.linalg.norm(offset)) + 1.2)
    direction = np.array([*(back / np.linalg.norm(back)), 0.45])
    return np.asarray(content.centre + distance * direction / np.linalg.norm(direction))


def _all(content: Content, pattern: str) -> list[str]:
    return [f"+ {prefix}{pattern}" for prefix in content.prefixes]


def _series(name: str, origin: str, contents: str = "") -> Any:
    import rerun.blueprint as rrb

    return rrb.TimeSeriesView(origin="/", contents=[f"+ {contents or origin + '/**'}"], name=name)


def _angles(content: Content, who: int) -> Any:
    import rerun.blueprint as rrb

    return rrb.TimeSeriesView(
        origin="/", contents=_all(content, f"/angles/{who}"), name=f"Angles of {who}, deg"
    )


def _limbs(content: Content, people: Sequence[int]) -> Any:
    import rerun.blueprint as rrb

    contents = [line for who in people for line in _all(content, f"/limbs/{who}")]
    return rrb.TimeSeriesView(origin="/", contents=contents or ["+ /limbs/**"], name="Limbs, m")
