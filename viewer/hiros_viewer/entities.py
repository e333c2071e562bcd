"""How each entity of a recording looks, and how its rows are sent.

Rows go out in columns, a batch at a time: rerun needs a microsecond for a row of a column and a
hundred for a call of its own.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from hiros_mcap.body.rotations import Rigid
from hiros_mcap.io.export.colours import RGB, person_colour
from hiros_mcap.kernels.drawing import Singles, draw_bones, draw_joints, tops
from hiros_mcap.skeletons import Flags, Floats, SkeletonModel, Stamps
from hiros_viewer.columns import (
    HIDDEN,
    DetectionRows,
    PersonRows,
    PoseBatch,
    ScalarRows,
    TextRows,
    columns,
    strips,
    times,
)
from hiros_viewer.palette import CAMERAS, CLASSES, camera_colour, curve_colour, pale

if TYPE_CHECKING:
    import rerun as rr

_JOINT_M = 0.022
_BONE_M = 0.011
_DETECTION_M = 0.008
_LABEL_ABOVE_M = 0.18
_FIELD_OF_VIEW_DEG = (75.0, 65.0)  # of the cameras as they are drawn; the log does not tell it
_FIRST_CAMERA_CLASS = 2 * CLASSES
_CLASSES_PER_CAMERA = 30


class Entities:
    """Draws rows into a recording.

    Parameters
    ----------
    recording : where to draw. model : of all skeletons.
    root : marker whose path is a person's trail.
    is_second : of two logs that are overlaid; people are drawn in paler colours.
    team : number and name of the system that made the log, when several are overlaid: its people
        share one colour, and its name stands beside each id.
    """

    def __init__(
        self,
        recording: rr.RecordingStream,
        model: SkeletonModel,
        root: int,
        *,
        is_second: bool = False,
        team: tuple[int, str] | None = None,
    ) -> None:
        self.recording = recording
        self.model = model
        self._root = root
        self._first_class = CLASSES if is_second else 0
        self._team = team
        self._bones = model.links[(model.links >= 0).all(axis=1)]

    # -- what stands still ---------------------------------------------------------------------

    def room(self, *, dim_detections: bool) -> None:
        """Draw the axes, and say what colours and bones each class has."""
        import rerun as rr

        self.recording.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        self.recording.log("/", self._annotations(dim_detections=dim_detections), static=True)

    def camera(self, name: str, number: int, pose: Rigid) -> None:
        """Draw a camera as a frustum at its pose in the fixed frame."""
        import rerun as rr

        path = f"/world/cameras/{path_part(name)}"
        place = rr.Transform3D(
            translation=pose.translation, quaternion=rr.Quaternion(xyzw=pose.xyzw)
        )
        half = np.tan(np.radians(np.array(_FIELD_OF_VIEW_DEG) / 2))
        focal = 320 / half[0]
        frustum = rr.Pinhole(
            focal_length=float(focal),
            width=640,
            height=float(2 * focal * half[1]),
            image_plane_distance=0.35,
            camera_xyz=rr.ViewCoordinates.RDF,
            color=camera_colour(number),
            line_width=0.004,
        )
        self.recording.log(path, place, static=True)
        self.recording.log(f"{path}/view", frustum, static=True)

    def _annotations(self, *, dim_detections: bool) -> Any:
        """Return the classes: people, people of a second log, and each camera's detections."""
        import rerun as rr

        bones = [(int(parent), int(child)) for parent, child in self._bones]

        def look(number: int, name: str, colour: RGB, links: Sequence[tuple[int, int]] = ()) -> Any:
            names = enumerate(self.model.marker_names)
            return rr.ClassDescription(
                info=(number, name, _packed(colour)),
                keypoint_annotations=[
                    rr.AnnotationInfo(k, joint, _packed(colour)) for k, joint in names
                ],
                keypoint_connections=links,
            )

        people = range(CLASSES)
        classes = [look(k, f"person {k}", person_colour(k)) for k in people]
        classes += [look(CLASSES + k, "", pale(person_colour(k))) for k in people]
        for camera in range(len(CAMERAS)):
            colour = camera_colour(camera) if dim_detections else curve_colour(camera)
            rows = range(_CLASSES_PER_CAMERA)
            classes += [look(_camera_class(camera, row), "", colour, bones) for row in rows]
        return rr.AnnotationContext(classes)

    # -- skeletons -----------------------------------------------------------------------------

    def detections(self, camera: str, number: int, rows: DetectionRows) -> Floats:
        """Send a camera's detections: several people in one batch, told apart by their classes.

        Returns
        -------
        (K, 3) the highest joint of each, m.
        """
        import rerun as rr

        path = f"/detections/{path_part(camera)}"
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
        return _highest(rows.poses, places)

    def person(self, path: str, rows: PersonRows, poses: PoseBatch) -> tuple[Flags, Floats]:
        """Send joints, bones, label and trail of one person, all rows at once.

        Returns
        -------
        (R,) which rows show the person; (K, 3) the highest joint in each of these, m.
        """
        if not rows.started:
            rows.started = True
            self._send_looks(path)
        when, places = times(rows.stamps), np.array(rows.places)
        shown = places != HIDDEN
        joints, radii = self._joints(poses, places[shown], _JOINT_M)
        highest = _highest(poses, places[shown])
        for part, batches, per_pose in self._parts(joints, radii, highest):
            counts = np.zeros(len(places), np.int32)
            counts[shown] = per_pose
            self.recording.send_columns(f"{path}{part}", [when], columns(batches, counts))
        return shown, highest

    def _joints(self, poses: PoseBatch, places: Stamps, largest: float) -> tuple[Singles, Singles]:
        """Return joints (R, M, 3) and radii (R, M), m, of the poses at these places."""
        joints = np.empty((len(places), self.model.n_markers, 3), np.float32)
        radii = np.empty(joints.shape[:2], np.float32)
        draw_joints(poses.positions, poses.confidences, places, largest, joints, radii)
        return joints, radii

    def _parts(
        self, joints: Singles, radii: Singles, highest: Floats
    ) -> Iterator[tuple[str, Mapping[Any, Any], Any]]:
        """Yield a person's entities: path below theirs, batches, how many of it in each pose."""
        import rerun as rr

        where, size = rr.Points3D.descriptor_positions(), rr.Points3D.descriptor_radii()
        points = rr.components.Position3DBatch
        yield "", {where: points(joints), size: rr.components.RadiusBatch(radii)}, joints.shape[1]
        bones = np.empty((len(joints) * len(self._bones), 2, 3), np.float32)
        per_pose = np.empty(len(joints), np.int32)
        n_bones = draw_bones(joints, self._bones, bones, per_pose)
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

    # -- curves, lanes and the log ---------------------------------------------------------------

    def curves(self, path: str, rows: ScalarRows, colours: Sequence[RGB]) -> None:
        """Send the curves of an entity, each in its colour."""
        import rerun as rr

        if not rows.started:
            rows.started = True
            lines = rr.SeriesLines(names=list(rows.names), colors=list(colours))
            self.recording.log(path, lines, static=True)
        parts = rr.Scalars.columns(scalars=np.array(rows.values))
        counts = np.full(len(rows.stamps), len(rows.names))
        self.recording.send_columns(path, [times(rows.stamps)], parts.partition(counts))

    def log_lines(self, path: str, rows: TextRows) -> None:
        """Send lines of the log."""
        import rerun as rr

        parts = rr.TextLog.columns(text=rows.texts, level=rows.levels)
        self.recording.send_columns(path, [times(rows.stamps)], parts)

    def lane(self, path: str, rows: TextRows) -> None:
        """Send when a person was tracked, as a lane with a gap where they are gone."""
        import rerun as rr

        if not rows.started:
            rows.started = True
            colour = _packed(person_colour(int(path.split("/")[-1])))
            look = rr.StateConfiguration(
                values=["tracked", "gone"], colors=[colour, colour], visible=[True, False]
            )
            self.recording.log(path, look, static=True)
        parts = rr.StateChange.columns(state=rows.texts)
        self.recording.send_columns(path, [times(rows.stamps)], parts)


def path_part(name: str) -> str:
    """Return a name as one part of an entity path."""
    return name.strip("/").replace("/", "_") or "_"


def _highest(poses: PoseBatch, places: Stamps) -> Floats:
    """(K, 3) the highest joint of the poses at these places, m; NaN for a pose without joints."""
    highest = np.empty((len(places), 3))
    tops(poses.positions, places, highest)
    return highest


def _camera_class(camera: int, row: Any) -> Any:
    """Class of a camera's detection; bones join joints of one class, so each person has its own."""
    return _FIRST_CAMERA_CLASS + camera * _CLASSES_PER_CAMERA + row % _CLASSES_PER_CAMERA


def _packed(colour: RGB) -> int:
    """Return a colour as the 32 bits that rerun makes of it."""
    red, green, blue = colour
    return red << 24 | green << 16 | blue << 8 | 0xFF
