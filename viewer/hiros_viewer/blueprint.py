"""Layouts of ``hiros view``: its panes, and where they stand."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from hiros_mcap.body.angles import JOINTS
from hiros_mcap.body.rotations import Rigid, rotate
from hiros_mcap.skeletons import Floats
from hiros_viewer.columns import LOGGED, STAMP, TIMELINE
from hiros_viewer.entities import KEY, Layer, person_part
from hiros_viewer.palette import BEFORE

_AHEAD = np.array([0.0, 0.0, 3.0])  # z of a camera points where it looks
_BONES = ("bones", "left_bones")
_THIN_JOINT_M, _THIN_BONE_M = 0.012, 0.006
_ROUND_TRUTH_M = 0.014  # joints and bones beside the true ones, which are thin lines
_VERTICAL_VIEW_DEG = 55.0  # of the viewer's eye
_FILLED = 0.95  # of a view
_NEAR = 0.5  # of the eye's distance
_FARTHER = 1.4  # at most, so that cameras are in the view, too
_CAMERA_M = 0.5  # so far from a camera are its name and frustum
_LABEL = np.array([0.0, 0.0, 0.3])  # m, above a head
_WIDE_ROOMS = 2  # as many rooms side by side have place for names of people
_NO_LANES, _A_LANE, _MOST_BELOW = 0.09, 0.052, 0.36  # of the height, so that few lanes are cut
_MOST_DETECTIONS = 12  # of a person, around the result
_HALF = 0.95  # width by height of a room beside as wide a column
_BEHIND = 0.1  # of _AHEAD: where the eye is, so that feet near the camera are seen


@dataclass(frozen=True, slots=True)
class Content:
    """Facts about a recording that a layout needs."""

    stages: Sequence[str]  # in the order of the chain; the last one is the result
    people: Sequence[int]
    cameras: Sequence[str]  # as in entity paths
    boxes: Floats  # (B, 2, 3) m: boxes round people at some times, lowest and highest corner
    camera_poses: Mapping[str, Rigid] = field(default_factory=dict)
    """Of those cameras whose poses are known, in the fixed frame."""
    layers: Sequence[Layer] = (Layer(),)  # the logs, several if they are overlaid
    has_error: bool = False  # whether the result was compared with a truth
    shows_truth: bool = False
    """Whether the truth is drawn in the room, where it makes the result thin."""
    shows_uncertainty: bool = False
    """Whether ellipsoids are drawn round joints, whose own size would hide them."""
    has_predicted: bool = False  # whether somebody is in the result while no camera sees them
    lanes: Mapping[str, str] = field(default_factory=dict)
    """Path of a lane -> what it shows: "person" or "no data"."""
    moved: Collection[str] = ()  # stages whose joints are not those of the result
    longest: int = 0  # who of the people is there for longest: whose curves are seen first
    ranges: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """Kind of curve -> from where to where its axis goes; other axes fit their curves."""
    images: Mapping[str, tuple[int, int]] = field(default_factory=dict)
    """RGB cameras, and width and height of their images, px."""

    @property
    def prefixes(self) -> Sequence[str]:
        """Beginning of the entity paths of each log."""
        return [layer.prefix for layer in self.layers]

    @property
    def box(self) -> tuple[Floats, Floats]:
        """(3,) The lowest and the highest corner, m, of where people nearly always are."""
        low, high = self.boxes[:, 0], self.boxes[:, 1]
        return np.percentile(low, 2, axis=0), np.percentile(high, 98, axis=0)

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
    def hides_detections(self) -> bool:
        """Whether detections are so many that a result would not be seen among them."""
        return len(self.cameras) > _MOST_DETECTIONS

    @property
    def is_raw(self) -> bool:
        """Whether there is nothing but detections, and perhaps the truth."""
        return all(stage == "truth" for stage in self.stages)


def overview(content: Content) -> rrb.Container:
    """Show the room with the result, and beside it all curves, who is there, and the events."""
    if content.is_raw:
        lanes = [_lanes(content)] if content.lanes else []
        return rrb.Vertical(
            _room(content, "Room", stages=[content.final]),
            _key(),
            rrb.Horizontal(_counts(content, _legend_at(content, "LeftBottom")), *lanes),
            row_shares=[3, 0.25, 1],
        )
    angles = _tabs(content, [_angles(content, person) for person in content.people])
    side = [_error(content)] if content.has_error else []
    speed = _series(content, "speed", "Speed, m/s")
    if len(content.prefixes) == 2:
        side += [_series(content, "distance", "Joint distance, mm"), speed]
    else:
        side += [speed, _counts(content)]
    below = min(_MOST_BELOW, _NO_LANES + _A_LANE * len(content.lanes))
    wide, pairs = side[: len(side) % 2], side[len(side) % 2 :]
    curves = [4, *[2.2] * len(wide), 1.2 * len(pairs)]
    key = (0.145 if len(content.prefixes) == 2 else 0.105) / (1 - below)  # lines have their height
    shares = [key / (1 - key) * sum(curves), *curves]
    return rrb.Vertical(
        rrb.Horizontal(
            _room(content, "Room", stages=[content.final]),
            rrb.Vertical(
                _key(),
                angles,
                *wide,
                rrb.Grid(*pairs, grid_columns=2),
                row_shares=shares,
            ),
            column_shares=[4, 3],
        ),
        rrb.Horizontal(_lanes(content), _events(content), column_shares=[2, 3]),
        row_shares=[1 - below, below],
    )


def _lanes(content: Content) -> Any:
    """Return who is there, and when nothing was recorded.

    It shows whatever has states, also people who come while it is watched.
    """
    in_result = ["People in the result"] * (not content.is_raw)
    name = "; ".join([*in_result, *["no data"] * ("no data" in content.lanes.values())])
    name = name[:1].upper() + name[1:]
    return rrb.StateTimelineView(origin="/", contents="/**", name=name, time_view=_whole())


def stages(content: Content) -> rrb.Container:
    """Show what the stages changed: before and after in one room, and how far joints moved."""
    before, after = content.before, content.final
    name = f"{before.capitalize()} and {after}"
    room = _room(content, name, stages=[before, after], cameras=[], aspect=_HALF)
    moved = [
        _series(content, "moved", f"Joints, {stage} to {after}: mean mm", f"/moved/{stage}/**")
        for stage in content.stages
        if stage not in ("tracked", "truth", after) and stage in content.moved
    ]
    residual = _series(content, "residual", "Detections to the result: mean mm")
    error = [_error(content)] if content.has_error else []
    right = [_key(), *moved, *error, residual, _events(content)]
    shares = [0.6 + 0.8 * (len(content.prefixes) == 2), *[2] * (len(right) - 1)]
    return rrb.Horizontal(room, rrb.Vertical(*right, row_shares=shares), column_shares=[1, 1])


def cameras(content: Content) -> rrb.Container:
    """Every camera's detections and the result as it sees them, and how far they are apart."""
    rooms = [
        _room(content, camera, stages=[content.final], cameras=[camera], seen_by=camera)
        for camera in content.cameras
    ]
    rooms += [_image(camera, *size) for camera, size in content.images.items()]
    n = len(rooms)
    columns = n if n < 4 else math.isqrt(n - 1) + 1
    below = [_counts(content, _legend_at(content, "LeftBottom"))]
    if not content.is_raw:
        corner = _legend_at(content, "LeftTop")
        below = [_series(content, "residual", "Distance to the result, mm", corner=corner)]
        if content.lanes:  # else the viewer fills it with advice
            below.append(_lanes(content))
    grid = rrb.Grid(*rooms, grid_columns=columns)
    shares = [3, 0.25 + 0.25 * (len(content.prefixes) == 2), 1.15]
    return rrb.Vertical(grid, _key(), rrb.Horizontal(*below), row_shares=shares)


LAYOUTS: dict[str, Callable[[Content], Any]] = {
    "overview": overview,
    "stages": stages,
    "cameras": cameras,
}


def fitting(content: Content, layout: str) -> str:
    """Return the layout itself, or the overview where that has nothing to show."""
    is_empty = {
        "stages": not content.before,
        "cameras": not (content.cameras or content.images),
    }
    return "overview" if is_empty.get(layout, False) else layout


def blueprint(
    content: Content, layout: str = "overview", *, follows: bool = False
) -> rrb.Blueprint:
    """Return a layout by its name in :data:`LAYOUTS`, paused at the start.

    If it ``follows``, it shows what came last.
    """
    plays: dict[str, Any] = {"play_state": "paused", "loop_mode": "all"}
    if follows:
        plays = {"play_state": "following", "loop_mode": "off"}
    return rrb.Blueprint(
        LAYOUTS[fitting(content, layout)](content),
        rrb.TimePanel(timeline=TIMELINE, state="collapsed", **plays),
        collapse_panels=True,
        auto_views=False,
    )


def _room(
    content: Content,
    name: str,
    *,
    stages: Sequence[str],
    cameras: Sequence[str] | None = None,
    seen_by: str = "",
    aspect: float = 1.4,
) -> Any:
    """Return a 3D view of ``stages`` and of the detections of ``cameras`` (None = all).

    It looks from the camera ``seen_by`` if its pose is known, else at all people and cameras, in a
    view of this width by height; the result is thin then, so that the camera's own detections are
    seen beside it.
    Of two stages the first one is thin and grey, and its displacement to the second one is drawn.
    The truth is beside one stage that nobody else covers: detections are left out there, and where
    those of many cameras would cover everybody.
    """
    contents = ["+ /world/**"]
    visible = content.cameras if cameras is None else cameras
    shows_truth = content.shows_truth and len(stages) == 1 and not seen_by
    is_covered = shows_truth or (stages and not seen_by and content.hides_detections)
    if content.is_raw or not is_covered:
        contents += [f"+ /detections/{camera}/**" for camera in visible]
    stages = [stage for stage in stages if stage]
    contents += [f"+ {prefix}/{stage}/**" for prefix in content.prefixes for stage in stages]
    overrides: dict[str, Any] = {}
    if len(stages) > 1:
        contents += _all(content, f"/displacement/{stages[0]}/**")
        earlier = _paths(content, stages[0])
        grey = rr.LineStrips3D.from_fields(colors=[BEFORE], radii=0.004)
        # Their bones are millimetres apart.
        overrides = _thin_styles(content, stages[1])
        overrides |= {f"{path}/{bones}": grey for path in earlier for bones in _BONES}
        contents += [f"- {path}/{part}" for path in earlier for part in ("name", "trail")]
    elif stages and (content.shows_uncertainty or seen_by):
        joint = 0.004 if content.shows_uncertainty else _THIN_JOINT_M
        overrides = _thin_styles(content, stages[0], joint)
    elif stages and shows_truth:
        overrides = _thin_styles(content, stages[0], _ROUND_TRUTH_M, _ROUND_TRUTH_M)
    if shows_truth and "truth" not in stages:
        contents += _all(content, "/truth/**") + _all(content, "/error_lines/**")
    if content.shows_uncertainty:
        contents += _all(content, "/uncertainty/**")
    trail = rrb.VisibleTimeRanges(
        [
            rr.VisibleTimeRange(
                timeline,
                start=rr.TimeRangeBoundary.cursor_relative(seconds=-2.0),
                end=rr.TimeRangeBoundary.cursor_relative(),
            )
            for timeline in (TIMELINE, STAMP, LOGGED)
        ]
    )
    overrides |= {f"{path}/trail": trail for stage in stages for path in _paths(content, stage)}
    eye, target = _eye(content, aspect)
    if pose := content.camera_poses.get(seen_by):
        ahead = rotate(pose.xyzw, _AHEAD)
        target = np.add(*content.box) / 2
        eye = pose.translation
        if ahead @ (target - eye) > 0:  # else z is not this frame's optical axis
            target, eye = eye + ahead, eye - _BEHIND * ahead
        # Names hide people, and so does a frustum beside the eye.
        for camera in dict.fromkeys([*content.cameras, *content.camera_poses]):
            place = content.camera_poses.get(camera, pose).translation
            near = float(np.linalg.norm(place - pose.translation)) < 1.0
            contents.append(f"- /world/cameras/{camera}/{'**' if near else 'name'}")
        if len(content.cameras) > _WIDE_ROOMS:  # the lanes below name the people's colours
            contents += [f"- {path}/name" for stage in stages for path in _paths(content, stage)]
    else:
        # Their frusta would hide people.
        contents += [f"- /world/cameras/{name}/**" for name in _beside_eye(content, eye, target)]
    return rrb.Spatial3DView(
        origin="/",
        contents=contents,
        name=name,
        background=(24, 27, 31),
        line_grid=rrb.LineGrid3D(visible=True, spacing=0.5, color=(255, 255, 255, 25)),
        eye_controls=rrb.EyeControls3D(position=eye, look_target=target, eye_up=(0, 0, 1)),
        overrides=overrides,  # type: ignore[arg-type]
    )


def _image(camera: str, width: int, height: int) -> Any:
    """Return a view of what an RGB camera sees: the whole image, of a width and height in px."""
    return rrb.Spatial2DView(
        origin=f"/images/{camera}",
        contents=["+ /images/" + camera + "/**"],
        name=camera,
        background=(24, 27, 31),
        visual_bounds=rrb.VisualBounds2D(x_range=(0, width), y_range=(0, height)),
    )


def _thin_styles(
    content: Content, stage: str, joint: float = _THIN_JOINT_M, bone: float = _THIN_BONE_M
) -> dict[str, Any]:
    """Return looks of a stage that lets see what is millimetres away from it."""
    bones, joints = rr.LineStrips3D.from_fields(radii=bone), rr.Points3D.from_fields(radii=joint)
    paths = _paths(content, stage)
    return {f"{path}/{part}": bones for path in paths for part in _BONES} | dict.fromkeys(
        paths, joints
    )


def _paths(content: Content, stage: str) -> list[str]:
    return [
        f"{p}/{stage}/{person_part(person)}" for p in content.prefixes for person in content.people
    ]


def _beside_eye(content: Content, eye: Floats, target: Floats) -> list[str]:
    """Return the cameras that are near the eye (3,), m, and before the middle of what it sees."""
    ahead = target - eye
    distance = float(np.linalg.norm(ahead))
    names = []
    for name, pose in content.camera_poses.items():
        way = pose.translation - eye
        near = float(np.linalg.norm(way))
        cosine = float(way @ ahead) / (near * distance) if near > 0 else 1.0
        aside = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)) - np.arctan2(_CAMERA_M / 2, near))
        if near < _NEAR * distance and aside < _VERTICAL_VIEW_DEG / 6:
            names.append(name)
    return names


def _eye(content: Content, aspect: float) -> tuple[Floats, Floats]:
    """(3,) Where to look from and at, m, to see everybody from feet to head.

    The cameras are seen, too, unless people would be much smaller. It looks from the cameras' side
    if they have one, else from a corner. ``aspect`` is the view's width by its height.
    """
    low, high = content.box
    centre = (low + high) / 2
    back = np.array([-0.55, -0.85])
    places = [pose.translation for pose in content.camera_poses.values()]
    if places:
        offset = (np.mean(places, axis=0) - centre)[:2]
        if np.linalg.norm(offset) > 1.0:
            cosine, sine = np.cos(np.radians(22.0)), np.sin(np.radians(22.0))
            back = np.array([[cosine, -sine], [sine, cosine]]) @ offset
    outward = np.array([*(back / np.linalg.norm(back)), 0.45])
    outward /= np.linalg.norm(outward)
    right = np.cross([0.0, 0.0, 1.0], outward)
    right /= np.linalg.norm(right)
    axes = np.array([right, np.cross(outward, right), outward])
    lows, highs = (content.boxes[:, k].clip(low, high) for k in (0, 1))
    picks = np.array([*product((False, True), repeat=3)])[:, None]
    corners = np.where(picks, highs + _LABEL, lows).reshape(-1, 3) - centre
    beside = [
        place - centre + _CAMERA_M * way for place in places for way in (*axes[:2], *-axes[:2])
    ]
    target, distance = _framed(corners, axes, aspect)
    if beside:
        all_target, farther = _framed(np.concatenate([corners, beside]), axes, aspect)
        if farther <= _FARTHER * distance:
            target, distance = all_target, farther
    target = target + centre
    return target + distance * outward, target


def _framed(points: Floats, axes: Floats, aspect: float) -> tuple[Floats, float]:
    """Return the (3,) centre, m, of a view that holds points (N, 3), and the eye's distance, m.

    ``axes`` (3, 3) point to the right, up, and towards the eye.
    """
    slope = _FILLED * np.tan(np.radians(_VERTICAL_VIEW_DEG / 2))
    *spans, near = axes @ points.T
    target, distance = np.zeros(3), 0.0
    for span, axis, reach in zip(spans, axes, (aspect * slope, slope), strict=False):
        high, low = (span / reach + near).max(), (-span / reach + near).max()
        target = target + reach * (high - low) / 2 * axis
        distance = max(distance, (high + low) / 2)
    return target, distance


def _all(content: Content, pattern: str) -> list[str]:
    return [f"{prefix}{pattern}" for prefix in content.prefixes]


def _tabs(content: Content, views: Sequence[Any]) -> Any:
    """Return a tab for each person; that of who is there for longest is open."""
    people = list(content.people)
    first = people.index(content.longest) if content.longest in people else 0
    return rrb.Tabs(*views, active_tab=first if first < len(views) else None)


def _counts(content: Content, corner: Any = None) -> Any:
    return _series(content, "people", "People per camera", corner=corner)


def _series(content: Content, kind: str, name: str, path: str = "", corner: Any = None) -> Any:
    """Return a view of curves of a kind, with a legend in a ``corner`` where it covers few of them.

    Else the room and the lanes tell the colours; the viewer names the curve under the pointer.
    ``path`` is that of the curves; "" = all of the kind.
    """
    path = path or f"/{kind}/**"
    values = content.ranges.get(kind)
    return rrb.TimeSeriesView(
        origin="/",
        contents=list(dict.fromkeys([path, *_all(content, path)])),
        name=name,
        plot_legend=rrb.PlotLegend(corner, visible=corner is not None),
        axis_x=_whole(),
        axis_y=None if values is None else rrb.ScalarAxis(range=values),
    )


def _legend_at(content: Content, corner: str) -> Any:
    """Return where cameras are named in a large plot of their curves: nowhere if they are many."""
    return rrb.Corner2D[corner] if len(content.cameras) <= 4 else None


def _whole() -> Any:
    """Return a time axis from the first to the last row, on every timeline.

    The viewer's own choice ends where it had read to when it was opened.
    """
    ever = rr.TimeRangeBoundary.infinite()
    return rrb.TimeAxis(view_range=rr.TimeRange(start=ever, end=ever))


def _key() -> Any:
    """Return the lines that say what colours mean, and which log is which."""
    return rrb.TextDocumentView(origin=KEY, name="Colours", titlebar=False)


def _angles(content: Content, person: int) -> Any:
    """Return a view per joint, in each its left and its right curve."""
    views = [
        _series(
            content,
            "angles",
            f"{joint.capitalize()} flexion, °",
            f"/angles/{person_part(person)}/{joint}_flexion",
        )
        for joint in JOINTS
    ]
    return rrb.Grid(*views, grid_columns=2, name=f"Person {person}")


def _error(content: Content) -> Any:
    return _series(content, "error", "Error, mm: mean over joints")


def _events(content: Content) -> Any:
    """Return the list of events, so that each is read in full."""
    columns = rrb.TextLogColumns(timeline_columns=[TIMELINE], text_log_columns=["body"])
    return rrb.TextLogView(
        origin="/", contents=_all(content, "/log"), name="Events", columns=columns
    )
