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

import heapq
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from hiros_mcap.body.angles import ANGLES, flexions
from hiros_mcap.body.rotations import Rigid
from hiros_mcap.body.symmetry import split_side
from hiros_mcap.evaluate.smoothness import lengths_of
from hiros_mcap.events import Event
from hiros_mcap.io.export.colours import RGB, person_colour
from hiros_mcap.kernels.distance import nearest
from hiros_mcap.kernels.drawing import Singles, draw_bones, draw_joints, tops
from hiros_mcap.skeletons import UNTRACKED, Floats, Frame, SkeletonModel, Stamps
from hiros_viewer.columns import (
    HIDDEN,
    BodyRows,
    DetectionRows,
    PoseBatch,
    Poses,
    ScalarRows,
    StageRows,
    TextRows,
    columns,
    strips,
    times,
)
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
_SAME_BODY_M = 1.0
_MOST_BOUNDS = 2000
_MOST_WAITING = 10_000
_ROOTS = ("pelvis", "spinebase", "midhip", "hips", "spine_base", "spinemid")
_LIMBS = {
    "upper arm": ("shoulder", "elbow"),
    "forearm": ("elbow", "wrist"),
    "thigh": ("hip", "knee"),
    "shin": ("knee", "ankle"),
}


@dataclass(slots=True)
class _Reference:
    """The last stage's people at its newest frame, to compare detections with."""

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
        self.bounds: list[Floats] = []
        self.camera_centre: Floats | None = None
        self._prefix = prefix
        self._first_class = CLASSES if is_second else 0
        self._team = team
        self._batch = batch
        self._collected = 0
        self._n_detections = 0
        self._detections: dict[str, DetectionRows] = {}
        self._stages: dict[str, StageRows] = {}
        self._scalars: dict[str, ScalarRows] = {}
        self._curves: dict[tuple[str, str], ScalarRows] = {}
        self._texts: dict[str, TextRows] = {}
        self._reference = _Reference()
        self._waiting: list[tuple[int, int, str, Floats]] = []
        """Heap of detections that the last stage has not come to: stamp, number, camera, joints."""
        self._alive: set[int] = set()
        self._root = _root_slot(model)
        self._bone_ends = model.links[(model.links >= 0).all(axis=1)]
        self._limbs = limb_links(model)

    @property
    def cameras(self) -> list[str]:
        """Names of the cameras, in the order of their colours."""
        return list(self._detections)

    @property
    def stages(self) -> list[str]:
        """Names of the stages that were drawn."""
        return list(self._stages)

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
        for number, (name, pose) in enumerate(cameras.items()):
            self._detections[name] = DetectionRows(PoseBatch(self.model.n_markers))
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
                    color=camera_colour(number),
                    line_width=0.004,
                ),
                static=True,
            )

    def _annotations(self) -> Any:
        """Colours and bones of every class."""
        import rerun as rr

        bones = [(int(parent), int(child)) for parent, child in self._bone_ends]

        def joints(colour: RGB) -> list[Any]:
            names = enumerate(self.model.marker_names)
            return [rr.AnnotationInfo(k, name, _packed(colour)) for k, name in names]

        def description(
            number: int,
            name: str,
            colour: RGB,
            keypoints: Sequence[Any],
            links: Sequence[tuple[int, int]] = (),
        ) -> Any:
            return rr.ClassDescription(
                info=(number, name, _packed(colour)),
                keypoint_annotations=keypoints,
                keypoint_connections=links,
            )

        classes = []
        for number in range(CLASSES):
            colour = person_colour(number)
            classes.append(description(number, f"person {number}", colour, joints(colour)))
        for number in range(CLASSES):
            colour = pale(person_colour(number))
            classes.append(description(CLASSES + number, "", colour, joints(colour)))
        for camera in range(len(CAMERAS)):
            # Dim behind a result; without one, nothing else is there to be seen.
            colour = camera_colour(camera) if self.final else curve_colour(camera)
            keypoints = joints(colour)
            classes += [
                description(_camera_class(camera, row), "", colour, keypoints, bones)
                for row in range(_CLASSES_PER_CAMERA)
            ]
        return rr.AnnotationContext(classes)

    # -- frames --------------------------------------------------------------------------------

    def detections(self, camera: str, frame: Frame | Poses) -> None:
        """Draw what a camera reports; the frame is in the fixed frame."""
        rows = self._detections.get(camera)
        if rows is None:
            rows = self._detections[camera] = DetectionRows(PoseBatch(self.model.n_markers))
        self._hide_after_pause(rows, frame.stamp)
        rows.add(frame)
        self._curve("/people", camera).add(frame.stamp, len(frame.ids))
        if self.final:
            positions = np.ascontiguousarray(frame.positions)
            heapq.heappush(self._waiting, (frame.stamp, self._n_detections, camera, positions))
            self._n_detections += 1
            if len(self._waiting) > _MOST_WAITING:
                heapq.heappop(self._waiting)
        self._count()

    def _compare(self, newest: _Reference) -> None:
        """Draw how far detections up to the last stage's newest frame are from its people.

        Each is compared with the frame that is nearest in time. The last stage is seconds behind
        the cameras: it looks ahead, and waits until it knows people's limbs.
        """
        while self._waiting and self._waiting[0][0] <= newest.stamp:
            stamp, _, camera, positions = heapq.heappop(self._waiting)
            is_newer = newest.stamp - stamp < stamp - self._reference.stamp
            near = newest if is_newer else self._reference
            if abs(near.stamp - stamp) <= GONE_NS:
                self._residual(camera, stamp, positions, near.positions)
        self._reference = newest

    def _residual(self, camera: str, stamp: int, positions: Floats, people: Floats) -> None:
        """Draw the mean joint distance of detections to the nearest person each."""
        apart = np.empty(len(positions))
        nearest(positions, people, apart)
        same = [distance for distance in apart.tolist() if distance < _SAME_BODY_M]
        if same:
            self._curve("/residual", camera).add(stamp, 1000 * sum(same) / len(same))

    def stage(self, name: str, frame: Frame | Poses) -> None:
        """Draw a stage's people."""
        rows = self._stages.get(name)
        if rows is None:
            rows = self._stages[name] = StageRows(PoseBatch(self.model.n_markers))
        self._end_before_pause(name, rows, frame.stamp)
        place = rows.poses.size
        rows.poses.add(frame)
        ids = frame.ids.tolist()
        for person in ids:
            if person != UNTRACKED:
                body = rows.bodies.get(person)
                if body is None:
                    body = rows.bodies[person] = BodyRows()
                    self.people.add(person)
                self._hide_after_pause(body, frame.stamp)
                body.add(frame.stamp, place)
                rows.shown[person] = body
            place += 1
        # The tracker's frames are of one camera each, which does not see everybody.
        self._hide_gone(rows, ids, frame.stamp, GONE_NS if name == "tracked" else 0)
        if name == self.final:
            self._compare(_Reference(frame.stamp, np.ascontiguousarray(frame.positions)))
            self._states(ids, frame.stamp)
        self._count()

    def _hide_gone(self, rows: StageRows, ids: list[int], stamp: int, patience: int) -> None:
        """Hide people whom this frame lacks."""
        gone = [
            person
            for person, body in rows.shown.items()
            if person not in ids and stamp - body.last >= patience
        ]
        for person in gone:
            rows.shown.pop(person).hide(stamp)

    def _end_before_pause(self, stage: str, rows: StageRows, stamp: int) -> None:
        """Hide a stage's people during a pause of its channel: nobody knows where they are."""
        last = rows.last or stamp
        rows.last = stamp
        if stamp - last <= 2 * GONE_NS:
            return
        rows.hide_all(last + GONE_NS)
        if stage == self.final:
            self._leave(self._alive, last + GONE_NS)
            self._alive = set()

    def _hide_after_pause(self, rows: DetectionRows | BodyRows, stamp: int) -> None:
        """Hide what was last shown before a pause of the channel."""
        if rows.shown and stamp - rows.last > 2 * GONE_NS:
            rows.hide(rows.last + GONE_NS)

    def _states(self, ids: list[int], stamp: int) -> None:
        """Note when somebody comes and goes."""
        here = set(ids) - {UNTRACKED}
        if here == self._alive:
            return
        for person in sorted(here - self._alive):
            rows = self._texts.setdefault(f"{self._prefix}/state/{person}", TextRows())
            rows.add(stamp, "tracked")
        self._leave(self._alive - here, stamp)
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
        self._curve("/distance", name).add(stamp, millimetres)

    def _curve(self, kind: str, name: str) -> ScalarRows:
        """Return the rows of a single curve, made when it is first asked for."""
        rows = self._curves.get((kind, name))
        if rows is None:
            rows = self._curves[kind, name] = ScalarRows((name,))
            self._scalars[f"{kind}/{_part(name)}"] = rows
        return rows

    # -- sending -------------------------------------------------------------------------------

    def _count(self) -> None:
        self._collected += 1
        if self._collected >= self._batch:
            self.flush()

    def finish(self) -> None:
        """Send what is left, and hide everybody after the last frame."""
        for rows in self._detections.values():
            rows.hide(rows.last + GONE_NS)
        for stage in self._stages.values():
            for body in stage.shown.values():
                body.hide(body.last + GONE_NS)
        self._compare(_Reference(self._reference.stamp + 2 * GONE_NS))
        final = self._stages.get(self.final)
        self._leave(self._alive, (final.last if final else 0) + GONE_NS)
        self.flush()

    def flush(self) -> None:
        """Send what was collected so far."""
        self._collected = 0
        for number, (camera, rows) in enumerate(self._detections.items()):
            if rows.stamps:
                self._send_detections(f"/detections/{_part(camera)}", number, rows)
        for name, stage in self._stages.items():
            self._send_stage(name, stage)
        for path, curve in self._scalars.items():
            if curve.stamps:
                self._send_scalars(path, curve)
        for path, lines in self._texts.items():
            if lines.stamps:
                self._send_texts(path, lines)

    def _send_detections(self, path: str, number: int, rows: DetectionRows) -> None:
        """Send a camera's detections: several bodies in one batch, told apart by their classes."""
        import rerun as rr

        if not rows.started:
            rows.started = True
            look = rr.Points3D.from_fields(show_labels=False)
            self.recording.log(path, look, static=True)
        n_markers = self.model.n_markers
        counts = np.array(rows.counts)
        # Each pose's row in its own frame: its place in the batch less that of its frame's first.
        places = np.arange(rows.poses.size)
        order = places - np.repeat(np.cumsum(counts) - counts, counts)
        joints, radii = self._joints(rows.poses, places, _DETECTION_M)
        classes = _camera_class(number % len(CAMERAS), order).astype(np.uint16)
        keypoints = np.tile(np.arange(n_markers, dtype=np.uint16), len(places))
        parts = {
            rr.Points3D.descriptor_positions(): rr.components.Position3DBatch(joints),
            rr.Points3D.descriptor_radii(): rr.components.RadiusBatch(radii),
            rr.Points3D.descriptor_class_ids(): rr.components.ClassIdBatch(
                np.repeat(classes, n_markers)
            ),
            rr.Points3D.descriptor_keypoint_ids(): rr.components.KeypointIdBatch(keypoints),
        }
        self.recording.send_columns(path, [times(rows.stamps)], columns(parts, n_markers * counts))
        if not self.final and len(self.bounds) < _MOST_BOUNDS:
            highest = np.empty((len(places), 3))
            tops(rows.poses.positions, places, highest)
            self.bounds += list(highest[~np.isnan(highest[:, 0])][::10])
        rows.stamps, rows.counts = [], []
        rows.poses.clear()

    def _joints(self, poses: PoseBatch, places: Stamps, largest: float) -> tuple[Singles, Singles]:
        """Return joints (R, M, 3) and radii (R, M), m, of the poses at these places."""
        joints = np.empty((len(places), self.model.n_markers, 3), np.float32)
        radii = np.empty(joints.shape[:2], np.float32)
        draw_joints(poses.positions, poses.confidences, places, largest, joints, radii)
        return joints, radii

    def _send_stage(self, stage: str, rows: StageRows) -> None:
        """Send everybody of a stage."""
        for person, body in rows.bodies.items():
            if body.stamps:
                self._send_body(stage, person, body, rows.poses)
        rows.poses.clear()

    def _send_body(self, stage: str, person: int, rows: BodyRows, poses: PoseBatch) -> None:
        """Send joints, bones, label and trail of one person, all rows at once."""
        path = f"{self._prefix}/{stage}/{person}"
        if not rows.started:
            rows.started = True
            self._send_looks(path)
        when, places = times(rows.stamps), np.array(rows.places)
        shown = places != HIDDEN
        mine = places[shown]
        joints, radii = self._joints(poses, mine, _JOINT_M)
        highest = np.empty((len(mine), 3))
        tops(poses.positions, mine, highest)
        for part, batches, per_pose in self._parts(joints, radii, highest):
            counts = np.zeros(len(places), np.int32)
            counts[shown] = per_pose
            self.recording.send_columns(f"{path}{part}", [when], columns(batches, counts))
        if len(self.bounds) < _MOST_BOUNDS:
            self.bounds += list(highest[~np.isnan(highest[:, 0])][::10])
        if stage == self.final and len(mine):
            self._derive_curves(person, rows, np.array(rows.stamps)[shown], poses.positions[mine])
        rows.stamps, rows.places = [], []

    def _parts(
        self, joints: Singles, radii: Singles, highest: Floats
    ) -> Iterator[tuple[str, Mapping[Any, Any], Any]]:
        """Yield a person's entities: path below theirs, batches, how many of it in each pose."""
        import rerun as rr

        where, size = rr.Points3D.descriptor_positions(), rr.Points3D.descriptor_radii()
        points = rr.components.Position3DBatch
        yield "", {where: points(joints), size: rr.components.RadiusBatch(radii)}, joints.shape[1]
        bones = np.empty((len(joints) * len(self._bone_ends), 2, 3), np.float32)
        per_pose = np.empty(len(joints), np.int32)
        n_bones = draw_bones(joints, self._bone_ends, bones, per_pose)
        yield "/bones", {rr.LineStrips3D.descriptor_strips(): strips(bones[:n_bones])}, per_pose
        there = ~np.isnan(highest[:, 0])
        labels = highest[there] + np.array([0, 0, _LABEL_ABOVE_M])
        yield "/name", {where: points(labels)}, there
        yield "/trail", {where: points(joints[there, self._root])}, there

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

    def _derive_curves(self, person: int, rows: BodyRows, stamps: Stamps, poses: Floats) -> None:
        """Angles, limb lengths and speed of the last stage."""
        angles = np.degrees(flexions(self.model, poses))
        self._extend(f"{self._prefix}/angles/{person}", ANGLES, stamps, angles)
        if self._limbs:
            lengths = lengths_of(poses, self.model)[:, list(self._limbs.values())]
            self._extend(f"{self._prefix}/limbs/{person}", tuple(self._limbs), stamps, lengths)
        moments, roots = stamps, poses[:, self._root]
        if rows.last_root is not None:
            moments = np.insert(moments, 0, rows.last_root[0])
            roots = np.insert(roots, 0, rows.last_root[1], axis=0)
        rows.last_root = (int(stamps[-1]), poses[-1, self._root])
        steps = np.diff(moments)
        steady = (steps > 0) & (steps < GONE_NS)
        speeds = np.linalg.norm(np.diff(roots, axis=0), axis=-1)[steady] / (steps[steady] / 1e9)
        name = (f"person {person}",)
        self._extend(f"{self._prefix}/speed/{person}", name, moments[1:][steady], speeds)

    def _extend(self, path: str, names: Sequence[str], stamps: Stamps, values: Floats) -> None:
        self._scalars.setdefault(path, ScalarRows(tuple(names))).extend(stamps, values)

    def _send_scalars(self, path: str, rows: ScalarRows) -> None:
        import rerun as rr

        if not rows.started:
            rows.started = True
            lines = rr.SeriesLines(names=list(rows.names), colors=self._line_colours(path, rows))
            self.recording.log(path, lines, static=True)
        parts = rr.Scalars.columns(scalars=np.array(rows.values))
        counts = np.full(len(rows.stamps), len(rows.names))
        self.recording.send_columns(path, [times(rows.stamps)], parts.partition(counts))
        rows.stamps, rows.values = [], []

    def _line_colours(self, path: str, rows: ScalarRows) -> list[tuple[int, int, int]]:
        """One colour per line; a person's single line has that person's."""
        if len(rows.names) > 1:
            return [person_colour(k) for k in range(len(rows.names))]
        last = path.split("/")[-1]
        if path.startswith((f"{self._prefix}/speed", "/speed")) and last.isdigit():
            return [person_colour(int(last))]
        known = [_part(name) for name in self.cameras]
        if path.startswith("/distance/"):
            known = ["mean", "largest"]
        return [curve_colour(known.index(last) if last in known else 0)]

    def _send_texts(self, path: str, rows: TextRows) -> None:
        import rerun as rr

        if path.endswith("/log"):
            parts = rr.TextLog.columns(text=rows.texts, level=rows.levels)
        else:
            if not rows.started:
                rows.started = True
                self.recording.log(path, self._lane(path), static=True)
            parts = rr.StateChange.columns(state=rows.texts)
        self.recording.send_columns(path, [times(rows.stamps)], parts)
        rows.stamps, rows.texts, rows.levels = [], [], []

    def _lane(self, path: str) -> Any:
        """Somebody's lane has their colour, and a gap where they are gone."""
        import rerun as rr

        colour = person_colour(int(path.split("/")[-1]))
        return rr.StateConfiguration(
            values=["tracked", "gone"],
            colors=[_packed(colour), _packed(colour)],
            visible=[True, False],
        )


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


def _camera_class(camera: int, row: Any) -> Any:
    """Class of a camera's detection; bones join joints of one class, so each body has its own."""
    return _FIRST_CAMERA_CLASS + camera * _CLASSES_PER_CAMERA + row % _CLASSES_PER_CAMERA


def _packed(colour: RGB) -> int:
    """Return a colour as the 32 bits that rerun makes of it."""
    red, green, blue = colour
    return red << 24 | green << 16 | blue << 8 | 0xFF


def _part(name: str) -> str:
    """Return a name as one part of an entity path."""
    return name.strip("/").replace("/", "_") or "_"
