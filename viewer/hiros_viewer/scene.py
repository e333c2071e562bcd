"""Skeletons as a Rerun recording: what is drawn, where in the tree, in which colour.

::

    /world                      coordinates, cameras/<camera> as frusta
    /detections/<camera>        what the camera reports, in the fixed frame, dim
    /<stage>/<person>           joints and bones; stages are tracked merged optimized filtered truth
    /<stage>/<person>/name      label above the head; .../trail  path of the root
    /angles/<person> /limbs/<person> /speed/<person>   curves of the last stage
    /people/<camera>, /residual/<camera>   skeletons that it reports, distance to the last stage
    /state/<person>             while somebody is tracked;  /log   events

Rows are collected and sent in columns, a batch at a time, so that memory stays bounded.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from hiros_mcap.angles import ANGLES, flexions
from hiros_mcap.colours import RGB, person_colour
from hiros_mcap.evaluate.motion import lengths_of
from hiros_mcap.events import Event
from hiros_mcap.rotations import Rigid
from hiros_mcap.skeletons import UNTRACKED, Flags, Floats, Frame, SkeletonModel
from hiros_mcap.symmetry import split_side
from hiros_viewer.columns import TIMELINE, BodyRows, PointRows, ScalarRows, TextRows
from hiros_viewer.palette import CAMERAS, CLASSES, camera_colour, curve_colour, pale

if TYPE_CHECKING:
    import rerun as rr

STAGES = ("tracked", "merged", "optimized", "filtered", "truth")
BATCH = 4000
"""Frames collected before they are sent."""
GONE_NS = 250_000_000
"""Somebody or something that was not seen for this long is hidden."""
_JOINT_M = 0.022
_BONE_M = 0.011
_DETECTION_M = 0.008
_FIRST_CAMERA_CLASS = 2 * CLASSES
_CLASSES_PER_CAMERA = 30
_LABEL_ABOVE_M = 0.18
_MOST_BOUNDS = 2000
_ROOTS = ("pelvis", "spinebase", "midhip", "hips", "spine_base", "spinemid")
_LIMBS = {
    "upper arm": ("shoulder", "elbow"),
    "forearm": ("elbow", "wrist"),
    "thigh": ("hip", "knee"),
    "shin": ("knee", "ankle"),
}


@dataclass(slots=True)
class _Reference:
    """The last stage's people at its newest frames, to compare detections with."""

    stamp: int = 0
    positions: Floats = field(default_factory=lambda: np.zeros((0, 0, 3)))


class Scene:
    """Draws frames into a recording; call :meth:`finish` at the end.

    Parameters
    ----------
    recording : where to draw. model : of all frames.
    final : the stage that curves and residuals are taken from.
    prefix : put before every entity of this log when two logs are overlaid.
    is_second : of two logs that are overlaid; drawn in paler colours.
    team : number and name of the system that made this, when several are overlaid: everybody of
        it has one colour, and its name beside the id.
    """

    def __init__(
        self,
        recording: rr.RecordingStream,
        model: SkeletonModel,
        *,
        final: str = "filtered",
        prefix: str = "",
        is_second: bool = False,
        team: tuple[int, str] | None = None,
        batch: int = BATCH,
    ) -> None:
        self.recording = recording
        self.model = model
        self.final = final
        self.people: set[int] = set()
        self.cameras: list[str] = []
        self.stages: list[str] = []
        self.bounds: list[Floats] = []
        self.camera_centre: Floats | None = None
        self._prefix = prefix
        self._first_class = CLASSES if is_second else 0
        self._team = team
        self._batch = batch
        self._collected = 0
        self._points: dict[str, PointRows] = {}
        self._scalars: dict[str, ScalarRows] = {}
        self._texts: dict[str, TextRows] = {}
        self._bodies: dict[str, BodyRows] = {}
        self._started: set[str] = set()
        self._nowhere = np.full((model.n_markers, 3), np.nan)
        self._reference = _Reference()
        self._alive: set[int] = set()
        self._last: dict[str, int] = {}
        self._root = _root_slot(model)
        self._bone_ends = model.links[(model.links >= 0).all(axis=1)]
        self._limbs = limb_links(model)

    # -- what does not change ------------------------------------------------------------------

    def begin(self, cameras: Mapping[str, Rigid], fov: tuple[float, float] = (75.0, 65.0)) -> None:
        """Draw what stands still: axes, colours, and the cameras at their poses in the room.

        ``fov`` is the frusta's field of view in degrees; the log does not tell it.
        """
        import rerun as rr

        self.recording.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        self.recording.log("/", self._annotations(), static=True)
        if cameras:
            self.camera_centre = np.mean([pose.translation for pose in cameras.values()], axis=0)
        for name, pose in cameras.items():
            self._camera(name)
            path = f"/world/cameras/{_part(name)}"
            self.recording.log(
                path,
                rr.Transform3D(
                    translation=pose.translation, quaternion=rr.Quaternion(xyzw=pose.xyzw)
                ),
                static=True,
            )
            half = np.tan(np.radians(np.array(fov) / 2))
            focal = 320 / half[0]
            self.recording.log(
                f"{path}/view",
                rr.Pinhole(
                    focal_length=float(focal),
                    width=640,
                    height=float(2 * focal * half[1]),
                    image_plane_distance=0.35,
                    camera_xyz=rr.ViewCoordinates.RDF,
                    color=camera_colour(self.cameras.index(name)),
                    line_width=0.004,
                ),
                static=True,
            )

    def _annotations(self) -> Any:
        """Colours and bones of every class."""
        import rerun as rr

        bones = [(int(parent), int(child)) for parent, child in self._bone_ends]
        joints = [(k, name) for k, name in enumerate(self.model.marker_names)]

        def description(
            number: int, name: str, colour: RGB, links: Sequence[tuple[int, int]] = ()
        ) -> Any:
            return rr.ClassDescription(
                info=(number, name, colour),
                keypoint_annotations=[(k, joint, colour) for k, joint in joints],
                keypoint_connections=links,
            )

        people = [description(k, f"person {k}", person_colour(k)) for k in range(CLASSES)]
        other = [description(CLASSES + k, "", pale(person_colour(k))) for k in range(CLASSES)]
        dim = [
            description(
                _FIRST_CAMERA_CLASS + c * _CLASSES_PER_CAMERA + k, "", camera_colour(c), bones
            )
            for c in range(len(CAMERAS))
            for k in range(_CLASSES_PER_CAMERA)
        ]
        return rr.AnnotationContext([*people, *other, *dim])

    # -- frames --------------------------------------------------------------------------------

    def detections(self, frame: Frame) -> None:
        """Draw what a camera reports; the frame is in the fixed frame."""
        self._camera(frame.source)
        index = self.cameras.index(frame.source) % len(CAMERAS)
        path = f"/detections/{_part(frame.source)}"
        rows = self._points.setdefault(path, PointRows())
        self._hide_after_pause(rows, frame.stamp)
        n, m = frame.n_people, self.model.n_markers
        classes = [_camera_class(index, k) for k in range(n) for _ in range(m)]
        radii = _DETECTION_M * _sure(frame.marker_confidences).reshape(-1)
        rows.add(frame.stamp, frame.positions.reshape(-1, 3), radii, classes, list(range(m)) * n)
        self._curve(f"/people/{_part(frame.source)}", (frame.source,), frame.stamp, np.array([n]))
        self._residual(frame)
        self._count()

    def _residual(self, frame: Frame) -> None:
        """Mean joint distance of each detection to the nearest person of the last stage."""
        if abs(frame.stamp - self._reference.stamp) > GONE_NS or not frame.n_people:
            return
        distance = np.linalg.norm(
            frame.positions[:, None] - self._reference.positions[None], axis=-1
        )
        known = ~np.isnan(distance)
        mean = np.where(known, distance, 0).sum(axis=-1) / np.maximum(known.sum(axis=-1), 1)
        mean[~known.any(axis=-1)] = np.inf
        nearest = mean.min(axis=1, initial=np.inf)
        nearest = nearest[nearest < 1.0]
        if nearest.size:
            self._curve(
                f"/residual/{_part(frame.source)}",
                (frame.source,),
                frame.stamp,
                np.array([1000 * nearest.mean()]),
            )

    def stage(self, name: str, frame: Frame) -> None:
        """Draw a stage's people."""
        if name not in self.stages:
            self.stages.append(name)
        final = name == self.final
        self._end_before_pause(name, frame.stamp)
        for row, person in enumerate(frame.ids.tolist()):
            if person == UNTRACKED:
                continue
            self.people.add(person)
            self._body(name, person, frame, row)
        self._hide_gone(name, frame)
        if final:
            self._reference = _Reference(frame.stamp, frame.positions)
            self._states(frame)
        self._count()

    def _body(self, stage: str, person: int, frame: Frame, row: int) -> None:
        rows = self._bodies.setdefault(f"{self._prefix}/{stage}/{person}", BodyRows())
        self._hide_after_pause(rows, frame.stamp)
        rows.add(frame.stamp, frame.positions[row], frame.marker_confidences[row])

    def _hide_gone(self, stage: str, frame: Frame) -> None:
        """Hide people whom this frame lacks; the tracker's frames are of one camera each."""
        patience = GONE_NS if stage == "tracked" else 0
        start = f"{self._prefix}/{stage}/"
        present = {f"{start}{person}" for person in frame.ids.tolist()}
        for path, rows in self._bodies.items():
            is_gone = rows.shown and path.startswith(start) and path not in present
            if is_gone and frame.stamp - rows.last >= patience:
                rows.hide(frame.stamp)

    def _end_before_pause(self, stage: str, stamp: int) -> None:
        """Hide a stage's people during a pause of its channel: nobody knows where they are."""
        last = self._last.get(stage, stamp)
        self._last[stage] = stamp
        if stamp - last <= 2 * GONE_NS:
            return
        for path, rows in self._bodies.items():
            if path.startswith(f"{self._prefix}/{stage}/"):
                rows.hide(last + GONE_NS)
        if stage == self.final:
            self._leave(self._alive, last + GONE_NS)
            self._alive = set()

    def _hide_after_pause(self, rows: PointRows | BodyRows, stamp: int) -> None:
        """Hide what was last shown before a pause of the channel."""
        if rows.shown and stamp - rows.last > 2 * GONE_NS:
            rows.hide(rows.last + GONE_NS)

    def _states(self, frame: Frame) -> None:
        """Note when somebody comes and goes."""
        here = {person for person in frame.ids.tolist() if person != UNTRACKED}
        for person in sorted(here - self._alive):
            self._texts.setdefault(f"{self._prefix}/state/{person}", TextRows()).add(
                frame.stamp, "tracked"
            )
        self._leave(self._alive - here, frame.stamp)
        self._alive = here

    def _leave(self, people: set[int], stamp: int) -> None:
        for person in sorted(people):
            self._texts[f"{self._prefix}/state/{person}"].add(stamp, "gone")

    def event(self, event: Event) -> None:
        """Write an event into the log."""
        who = f" person {event.person}" if event.person >= 0 else ""
        where = f" {event.source}" if event.source else ""
        detail = f": {event.detail}" if event.detail else ""
        level = "WARN" if any(w in event.kind for w in ("lost", "rejected", "doubted")) else "INFO"
        self._texts.setdefault(f"{self._prefix}/log", TextRows()).add(
            event.stamp, f"{event.kind}{who}{where}{detail}", level
        )

    def distance(self, stamp: int, name: str, millimetres: float) -> None:
        """Add to the curve of joint distances between two logs, mm."""
        self._curve(f"/distance/{name}", (name,), stamp, np.array([millimetres]))

    def _curve(self, path: str, names: Sequence[str], stamp: int, values: Floats) -> None:
        self._scalars.setdefault(path, ScalarRows(tuple(names))).add(stamp, values)

    def _camera(self, name: str) -> None:
        if name not in self.cameras:
            self.cameras.append(name)

    # -- sending -------------------------------------------------------------------------------

    def _count(self) -> None:
        self._collected += 1
        if self._collected >= self._batch:
            self.flush()

    def finish(self) -> None:
        """Send what is left, and hide everybody after the last frame."""
        for rows in self._points.values():
            rows.hide(rows.last + GONE_NS)
        for body in self._bodies.values():
            body.hide(body.last + GONE_NS)
        self._leave(self._alive, self._last.get(self.final, 0) + GONE_NS)
        self.flush()

    def flush(self) -> None:
        """Send what was collected so far."""
        self._collected = 0
        for path, rows in self._points.items():
            if rows.stamps:
                self._send_points(path, rows)
        for path, body in self._bodies.items():
            if body.stamps:
                self._send_body(path, body)
        for path, curve in self._scalars.items():
            if curve.stamps:
                self._send_scalars(path, curve)
        for path, lines in self._texts.items():
            if lines.stamps:
                self._send_texts(path, lines)

    def _send_points(self, path: str, rows: PointRows) -> None:
        """Send a camera's detections: several bodies in one batch, told apart by their classes."""
        import rerun as rr

        parts = rr.Points3D.columns(
            positions=np.concatenate(rows.points),
            radii=np.concatenate(rows.radii),
            class_ids=np.array([c for row in rows.classes for c in row], np.uint16),
            keypoint_ids=np.array([k for row in rows.keypoints for k in row], np.uint16),
        ).partition([len(points) for points in rows.points])
        if path not in self._started:
            self._started.add(path)
            look = rr.Points3D.from_fields(show_labels=False)
            self.recording.log(path, look, static=True)
        self.recording.send_columns(path, [_times(rows.stamps)], parts)
        rows.stamps, rows.points, rows.radii = [], [], []
        rows.classes, rows.keypoints = [], []

    def _send_body(self, path: str, rows: BodyRows) -> None:
        """Send joints, bones, label and trail of one person, derived for all rows at once."""
        import rerun as rr

        if path not in self._started:
            self._started.add(path)
            self._send_looks(path)
        times = _times(rows.stamps)
        shown = np.array([pose is not None for pose in rows.poses])
        poses = np.stack([pose for pose in rows.poses if pose is not None] or [self._nowhere])
        poses = poses[: int(shown.sum())]
        confidences = np.array(rows.confidences).reshape(len(poses), self.model.n_markers)
        counts = np.where(shown, self.model.n_markers, 0)
        joints = rr.Points3D.columns(
            positions=poses.reshape(-1, 3), radii=(_JOINT_M * _sure(confidences)).reshape(-1)
        )
        self.recording.send_columns(path, [times], joints.partition(counts))

        bones = poses[:, self._bone_ends]
        whole = ~np.isnan(bones).any(axis=(2, 3))
        per_row = np.zeros(len(shown), int)
        per_row[shown] = whole.sum(axis=1)
        strips = rr.LineStrips3D.columns(strips=bones[whole].astype(np.float32))
        self.recording.send_columns(f"{path}/bones", [times], strips.partition(per_row))

        known = ~np.isnan(poses[:, :, 0])
        there = known.any(axis=1)
        tops = np.empty((len(poses), 3))
        places = np.where(known[:, :, np.newaxis], poses, 0.0).sum(axis=1)
        tops[:, :2] = (places / np.maximum(known.sum(axis=1), 1)[:, np.newaxis])[:, :2]
        tops[:, 2] = np.where(known, poses[:, :, 2], -np.inf).max(axis=1) + _LABEL_ABOVE_M
        singles = np.zeros(len(shown), int)
        singles[shown] = there
        for part, spots in (("name", tops), ("trail", poses[:, self._root])):
            column = rr.Points3D.columns(positions=spots[there])
            self.recording.send_columns(f"{path}/{part}", [times], column.partition(singles))
        if len(self.bounds) < _MOST_BOUNDS:
            self.bounds += list((tops - [0, 0, _LABEL_ABOVE_M])[there][::10])
        self._derive_curves(path, rows, poses, shown)
        rows.stamps, rows.poses, rows.confidences = [], [], []

    def _send_looks(self, path: str) -> None:
        """Say once how a person's entities look."""
        import rerun as rr

        stage, person = path.rsplit("/", 2)[-2:]
        which = int(person) if self._team is None else self._team[0]
        number = self._first_class + which % CLASSES
        keypoints = list(range(self.model.n_markers))
        label = f"truth {person}" if stage == "truth" else person
        label = label if self._team is None else f"{self._team[1]} {person}"
        for part, look in (
            ("", rr.Points3D.from_fields(
                class_ids=[number], keypoint_ids=keypoints, show_labels=False)),
            ("/bones", rr.LineStrips3D.from_fields(
                class_ids=[number], radii=_BONE_M, show_labels=False)),
            ("/name", rr.Points3D.from_fields(
                class_ids=[number], radii=0.001, labels=[label], show_labels=True)),
            ("/trail", rr.Points3D.from_fields(
                class_ids=[number], radii=0.005, show_labels=False)),
        ):  # fmt: skip
            self.recording.log(f"{path}{part}", look, static=True)

    def _derive_curves(self, path: str, rows: BodyRows, poses: Floats, shown: Flags) -> None:
        """Angles, limb lengths and speed of the last stage."""
        stage, person = path.rsplit("/", 2)[-2:]
        if stage != self.final or not len(poses):
            return
        stamps = [stamp for stamp, yes in zip(rows.stamps, shown, strict=True) if yes]
        angles = np.degrees(flexions(self.model, poses))
        self._extend(f"{self._prefix}/angles/{person}", ANGLES, stamps, angles)
        if self._limbs:
            lengths = lengths_of(poses, self.model)[:, list(self._limbs.values())]
            self._extend(f"{self._prefix}/limbs/{person}", tuple(self._limbs), stamps, lengths)
        times, roots = np.array(stamps), poses[:, self._root]
        if rows.last_root is not None:
            times = np.insert(times, 0, rows.last_root[0])
            roots = np.insert(roots, 0, rows.last_root[1], axis=0)
        rows.last_root = (stamps[-1], poses[-1, self._root])
        steps = np.diff(times)
        steady = (steps > 0) & (steps < GONE_NS)
        speeds = np.linalg.norm(np.diff(roots, axis=0), axis=-1)[steady] / (steps[steady] / 1e9)
        moments = times[1:][steady].tolist()
        name = (f"person {person}",)
        self._extend(f"{self._prefix}/speed/{person}", name, moments, speeds[:, np.newaxis])

    def _extend(self, path: str, names: Sequence[str], stamps: list[int], values: Floats) -> None:
        self._scalars.setdefault(path, ScalarRows(tuple(names))).extend(stamps, values)

    def _send_scalars(self, path: str, rows: ScalarRows) -> None:
        import rerun as rr

        if not rows.started:
            rows.started = True
            lines = rr.SeriesLines(names=list(rows.names), colors=self._line_colours(path, rows))
            self.recording.log(path, lines, static=True)
        values = np.concatenate(rows.values)
        parts = rr.Scalars.columns(scalars=values).partition([len(rows.names)] * len(rows.stamps))
        self.recording.send_columns(path, [_times(rows.stamps)], parts)
        rows.stamps, rows.values = [], []

    def _line_colours(self, path: str, rows: ScalarRows) -> list[tuple[int, int, int]]:
        """One colour per line; a person's single line has that person's."""
        if len(rows.names) > 1:
            return [person_colour(k) for k in range(len(rows.names))]
        last = path.split("/")[-1]
        if path.startswith((f"{self._prefix}/speed", "/speed")) and last.isdigit():
            return [person_colour(int(last))]
        known = [_part(name) for name in self.cameras]
        return [curve_colour(known.index(last) if last in known else 0)]

    def _send_texts(self, path: str, rows: TextRows) -> None:
        import rerun as rr

        if path.endswith("/log"):
            parts = rr.TextLog.columns(text=rows.texts, level=rows.levels)
        else:
            parts = rr.StateChange.columns(state=rows.texts)
        self.recording.send_columns(path, [_times(rows.stamps)], parts)
        rows.stamps, rows.texts, rows.levels = [], [], []


def limb_links(model: SkeletonModel) -> dict[str, int]:
    """Name -> link slot of upper arms, forearms, thighs and shins, as far as the model has them."""
    slots = {split_side(name): slot for slot, name in enumerate(model.marker_names)}
    ends = {p: k for k, p in enumerate(zip(model.link_parents, model.link_children, strict=True))}
    found = {}
    for side in ("left", "right"):
        for name, (upper, lower) in _LIMBS.items():
            link = ends.get((slots.get((upper, side), -2), slots.get((lower, side), -2)))
            if link is not None:
                found[f"{side} {name}"] = link
    return found


def _root_slot(model: SkeletonModel) -> int:
    names = [split_side(name)[0] for name in model.marker_names]
    return next((names.index(root) for root in _ROOTS if root in names), 0)


def _sure(confidences: Floats) -> Floats:
    """Size of a joint by its confidence: half for a guess, full if sure or unknown."""
    return np.asarray(0.5 + 0.5 * np.clip(np.nan_to_num(confidences, nan=1.0), 0, 1))


def _camera_class(camera: int, row: int) -> int:
    """Class of a camera's detection; bones join joints of one class, so each body has its own."""
    return _FIRST_CAMERA_CLASS + camera * _CLASSES_PER_CAMERA + row % _CLASSES_PER_CAMERA


def _part(name: str) -> str:
    """Return a name as one part of an entity path."""
    return name.strip("/").replace("/", "_") or "_"


def _times(stamps: Sequence[int]) -> Any:
    import rerun as rr

    return rr.TimeColumn(TIMELINE, timestamp=np.array(stamps, "datetime64[ns]"))
