"""What is shown beside what: the layouts of ``hiros view``."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from hiros_mcap.body.rotations import Rigid, rotate
from hiros_viewer.columns import LOGGED, STAMP, TIMELINE
from hiros_viewer.entities import CALIBRATION, CAMERA_TABLE, KEY, MAGNIFIED, person_part
from hiros_viewer.palette import BEFORE

if TYPE_CHECKING:
    import rerun.blueprint as rrb

    from hiros_mcap.skeletons import Floats

TRAIL_S = 2.0
JOINTS = ("shoulder", "elbow", "hip", "knee")
LIMBS = ("upper arm", "forearm", "thigh", "shin")
_BESIDE_M = 1.0
_AHEAD = np.array([0.0, 0.0, 3.0])  # z of a camera points where it looks
_BONES = ("bones", "left_bones")
_THIN_JOINT_M = 0.012
_VERTICAL_VIEW_DEG = 55.0  # of the viewer's eye


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
    camera_poses: Mapping[str, Rigid] = field(default_factory=dict)
    """Of those cameras whose poses are known, in the fixed frame."""
    prefixes: Sequence[str] = ("",)
    """Of the logs that are overlaid."""
    has_error: bool = False
    """Whether the result was compared with a truth."""
    shows_truth: bool = False
    """Whether the truth is drawn in the room, where it makes the result thin."""
    shows_uncertainty: bool = False
    """Whether ellipsoids are drawn round joints, whose own size would hide them."""
    has_moves: bool = False
    """Whether the cameras' poses before and after a calibration are shown."""
    has_faults: bool = True
    """Whether a camera's view was wrong for a while."""
    longest: int = 0
    """Who of the people is there for longest: whose curves are seen first."""
    ranges: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """Kind of curve -> from where to where its axis goes; other axes fit their curves."""

    @property
    def final(self) -> str:
        """The stage to look at first."""
        real = [stage for stage in self.stages if stage != "truth"]
        return real[-1] if real else (self.stages[-1] if self.stages else "")

    @property
    def before(self) -> str:
        """The earliest stage whose frames have the result's times, else the tracker's."""
        earlier = [stage for stage in self.stages if stage not in ("truth", self.final)]
        return next((stage for stage in earlier if stage != "tracked"), "".join(earlier[:1]))

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
            rrb.Horizontal(
                *([_moves()] if content.has_moves else []),
                _counts(content),
            ),
            row_shares=[3, 1],
        )
    angles = _tabs(content, [_angles(content, person) for person in content.people])
    speed = _series("Speed, m/s", _all(content, "/speed/**"))
    side = [angles, speed, _counts(content)]
    if content.has_moves:
        side.append(_moves())
    if len(content.prefixes) == 2:
        side.insert(1, _series("Joint distance between the logs, mm", ["/distance/**"]))
    if content.has_error:
        side.insert(1, _error(content))
    lanes = rrb.StateTimelineView(
        origin="/",
        contents=[*_all(content, "/state/**"), "/views/**"],
        name="People in the result, and when a camera's view is wrong",
        time_view=_whole(),
    )
    return rrb.Vertical(
        rrb.Horizontal(
            _room(content, "Room", shown=[content.final]),
            rrb.Vertical(_key(), *side, row_shares=[0.8, 5, *([2] * (len(side) - 1))]),
            column_shares=[4, 3],
        ),
        rrb.Horizontal(lanes, _events(content), column_shares=[2, 3]),
        row_shares=[2.8, 1],
    )


def stages(content: Content) -> rrb.Container:
    """Show what the stages changed: before and after in one room, and how far joints moved."""
    import rerun.blueprint as rrb

    before, after = content.before, content.final
    if not before:
        return overview(content)
    name = f"{before.capitalize()} grey, {after} coloured, displacement x {MAGNIFIED:.0f} white"
    room = _room(content, name, shown=[before, after], cameras=[])
    moved = [
        _series(f"Joints, {stage} to {after}: mean mm", _all(content, f"/moved/{stage}/**"))
        for stage in content.stages
        if stage not in ("tracked", "truth", after)
    ]
    residual = _series("Detections to the result: mean mm", ["/residual/**"])
    return rrb.Horizontal(
        room, rrb.Vertical(*moved, residual, _events(content)), column_shares=[1, 1]
    )


def person(content: Content) -> rrb.Container:
    """One person's angles and limbs, a tab per person."""
    import rerun.blueprint as rrb

    tabs = [
        rrb.Vertical(
            _key(),
            _angles(content, who),
            _sides(content, "limbs", who, LIMBS, "m"),
            _error(content, who)
            if content.has_error
            else _series("Speed, m/s", _all(content, f"/speed/{person_part(who)}")),
            row_shares=[0.34, 2, 2, 1],
            name=f"Person {who}",
        )
        for who in content.people
    ]
    if not tabs or content.is_raw:
        return overview(content)
    return rrb.Horizontal(
        _room(content, "Room", shown=[content.final]), _tabs(content, tabs), column_shares=[1, 1]
    )


def cameras(content: Content) -> rrb.Container:
    """Every camera's detections and the result as it sees them, and how far they are apart."""
    import rerun.blueprint as rrb

    rooms = [
        _room(content, camera, shown=[content.final], cameras=[camera], seen_by=camera)
        for camera in content.cameras
    ]
    below = [_counts(content)]
    if not content.is_raw:
        table = rrb.TextDocumentView(origin=CAMERA_TABLE, name="Cameras in numbers")
        wrong = rrb.StateTimelineView(
            origin="/",
            contents=["/views/**"],
            name="When a camera's view is wrong",
            time_view=_whole(),
        )
        below = [table, _series("Distance to the result, mm", ["/residual/**"])]
        below += [wrong] if content.has_faults else []  # else the viewer fills it with advice
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
    content: Content,
    name: str,
    *,
    shown: Sequence[str],
    cameras: Sequence[str] | None = None,
    seen_by: str = "",
) -> Any:
    """Return a 3D view of the stages in ``shown`` and detections of ``cameras`` (None = all).

    It looks from the camera ``seen_by`` if its pose is known, else at the people; the result is
    thin then, so that the camera's own detections are seen beside it.
    Of two stages the first one is thin and grey, and its displacement to the second one is drawn.
    """
    import rerun as rr
    import rerun.blueprint as rrb

    what = ["+ /world/**"]
    seen = content.cameras if cameras is None else cameras
    what += [f"+ /{kind}/{camera}/**" for kind in ("detections", "marked") for camera in seen]
    shown = [stage for stage in shown if stage]
    what += [f"+ {prefix}/{stage}/**" for prefix in content.prefixes for stage in shown]
    overrides: dict[str, Any] = {}
    if len(shown) > 1:
        what += _all(content, f"/displacement/{shown[0]}/**")
        overrides = _compared_looks(content, *shown)
        earlier = _paths(content, shown[0])
        what += [f"- {path}/{part}" for path in earlier for part in ("name", "trail")]
    elif shown and (content.shows_truth or content.shows_uncertainty or seen_by):
        joint = 0.004 if content.shows_uncertainty else _THIN_JOINT_M
        overrides = _thin_looks(content, shown[0], joint)
    if content.shows_truth and "truth" not in shown:
        what += _all(content, "/truth/**") + _all(content, "/error_lines/**")
    if content.shows_uncertainty:
        what += _all(content, "/uncertainty/**")
    trail = rrb.VisibleTimeRanges(
        [
            rr.VisibleTimeRange(
                timeline,
                start=rr.TimeRangeBoundary.cursor_relative(seconds=-TRAIL_S),
                end=rr.TimeRangeBoundary.cursor_relative(),
            )
            for timeline in (TIMELINE, STAMP, LOGGED)
        ]
    )
    overrides |= {
        f"{prefix}/{stage}/{person_part(who)}/trail": trail
        for prefix in content.prefixes
        for stage in shown
        for who in content.people
    }
    eye, target = _eye(content), content.centre - [0, 0, 0.1]
    if pose := content.camera_poses.get(seen_by):
        eye = pose.translation
        ahead = rotate(pose.xyzw, _AHEAD)
        if ahead @ (target - eye) > 0:  # else z is not this frame's optical axis
            target = eye + ahead
        for other in content.cameras:  # names hide people, and so does a frustum beside the eye
            place = content.camera_poses.get(other, pose).translation
            near = float(np.linalg.norm(place - pose.translation)) < _BESIDE_M
            what.append(f"- /world/cameras/{other}/{'**' if near else 'name'}")
    return rrb.Spatial3DView(
        origin="/",
        contents=what,
        name=name,
        background=(24, 27, 31),
        line_grid=rrb.LineGrid3D(visible=True, spacing=0.5, color=(255, 255, 255, 25)),
        eye_controls=rrb.EyeControls3D(position=eye, look_target=target, eye_up=(0, 0, 1)),
        overrides=overrides,  # type: ignore[arg-type]
    )


def _compared_looks(content: Content, before: str, after: str) -> dict[str, Any]:
    """Return looks of two stages whose bones are millimetres apart: both thin, the first grey."""
    import rerun as rr

    look = rr.LineStrips3D.from_fields(colors=[BEFORE], radii=0.004)
    return _thin_looks(content, after) | {
        f"{path}/{bones}": look for path in _paths(content, before) for bones in _BONES
    }


def _thin_looks(content: Content, stage: str, joint: float = _THIN_JOINT_M) -> dict[str, Any]:
    """Return looks of a stage that lets see what is millimetres away from it."""
    import rerun as rr

    bones, joints = rr.LineStrips3D.from_fields(radii=0.006), rr.Points3D.from_fields(radii=joint)
    paths = _paths(content, stage)
    return {f"{path}/{part}": bones for path in paths for part in _BONES} | dict.fromkeys(
        paths, joints
    )


def _paths(content: Content, stage: str) -> list[str]:
    """Return the entities of everybody at a stage."""
    return [f"{p}/{stage}/{person_part(who)}" for p in content.prefixes for who in content.people]


def _eye(content: Content) -> Floats:
    """(3,) Where to look from, m: from the cameras' side if they have one, else from a corner.

    People fill the view: a standing person's height, or the ground that they walk on.
    """
    back, half = np.array([-0.55, -0.85]), np.radians(_VERTICAL_VIEW_DEG / 2)
    across = max(1.2, 0.7 * (content.reach + 0.4))  # a view is wider than high
    distance = across / np.tan(half) + 0.3 * content.reach
    if content.camera_poses:
        places = [pose.translation for pose in content.camera_poses.values()]
        offset = (np.mean(places, axis=0) - content.centre)[:2]
        if np.linalg.norm(offset) > 1.0:
            cosine, sine = np.cos(np.radians(22.0)), np.sin(np.radians(22.0))
            back = np.array([[cosine, -sine], [sine, cosine]]) @ offset
    direction = np.array([*(back / np.linalg.norm(back)), 0.45])
    return np.asarray(content.centre + distance * direction / np.linalg.norm(direction))


def _all(content: Content, pattern: str) -> list[str]:
    return [f"{prefix}{pattern}" for prefix in content.prefixes]


def _tabs(content: Content, views: Sequence[Any]) -> Any:
    """Return a tab for each person; that of who is there for longest is open."""
    import rerun.blueprint as rrb

    people = list(content.people)
    first = people.index(content.longest) if content.longest in people else 0
    return rrb.Tabs(*views, active_tab=first if first < len(views) else None)


def _counts(content: Content) -> Any:
    """Return the curves of how many people each camera reports."""
    return _series("People per camera", ["/people/**"], content.ranges.get("people"))


def _series(name: str, contents: Sequence[str], values: tuple[float, float] | None = None) -> Any:
    """Return a view of curves without a legend, which would cover them.

    The room and the lanes tell the colours; the viewer names the curve under the pointer.
    ``values`` is the range of the axis; None = it fits the curves.
    """
    import rerun.blueprint as rrb

    legend = rrb.PlotLegend(visible=False)
    return rrb.TimeSeriesView(
        origin="/",
        contents=list(contents),
        name=name,
        plot_legend=legend,
        axis_x=_whole(),
        axis_y=None if values is None else rrb.ScalarAxis(range=values),
    )


def _whole() -> Any:
    """Return a time axis from the first to the last row, on every timeline.

    The viewer's own choice ends where it had read to when it was opened.
    """
    import rerun as rr
    import rerun.blueprint as rrb

    ever = rr.TimeRangeBoundary.infinite()
    return rrb.TimeAxis(view_range=rr.TimeRange(start=ever, end=ever))


def _key() -> Any:
    """Return the line that says how left and right are told apart."""
    import rerun.blueprint as rrb

    return rrb.TextDocumentView(origin=KEY, name="Left and right", titlebar=False)


def _angles(content: Content, who: int) -> Any:
    return _sides(content, "angles", who, [f"{joint} flexion" for joint in JOINTS], "deg")


def _sides(content: Content, kind: str, who: int, parts: Sequence[str], unit: str) -> Any:
    """Return a view per joint or limb, in each its left and its right curve."""
    import rerun.blueprint as rrb

    person = person_part(who)
    views = [
        _series(
            f"{part.capitalize()}, {unit}",
            _all(content, f"/{kind}/{person}/{part.replace(' ', '_')}"),
            content.ranges.get(f"{kind}/{part}"),
        )
        for part in parts
    ]
    return rrb.Grid(*views, grid_columns=2, name=f"Person {who}")


def _moves() -> Any:
    """Return the table of cameras before and after a calibration."""
    import rerun.blueprint as rrb

    return rrb.TextDocumentView(origin=CALIBRATION, name="Cameras before and after")


def _error(content: Content, who: int | None = None) -> Any:
    """Return the curves of the error, of everybody or of one person."""
    part = "**" if who is None else person_part(who)
    return _series("Error, mm: mean over joints", _all(content, f"/error/{part}"))


def _events(content: Content) -> Any:
    """Return the list of events, so that each is read in full."""
    import rerun.blueprint as rrb

    columns = rrb.TextLogColumns(timeline_columns=[TIMELINE], text_log_columns=["body"])
    return rrb.TextLogView(
        origin="/", contents=_all(content, "/log"), name="Events", columns=columns
    )
