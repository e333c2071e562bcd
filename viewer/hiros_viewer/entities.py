"""How each entity of a recording looks, and how its rows are sent.

Rows go out in columns, a batch at a time: rerun needs a microsecond for a row of a column and a
hundred for a call of its own.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt
import rerun as rr

from hiros_mcap.body.intrinsics import Intrinsics
from hiros_mcap.body.rotations import Rigid
from hiros_mcap.body.symmetry import split_side
from hiros_mcap.io.export.markers import RGB, person_colour
from hiros_mcap.skeletons import Flags, Floats, SkeletonModel, Stamps
from hiros_viewer.columns import Line, TextRow, columns, strips, time_columns
from hiros_viewer.palette import (
    CAMERAS,
    CLASSES,
    DISPLACEMENT,
    ERROR,
    TRUTH,
    camera_colour,
    curve_colour,
    faint,
    label_colour,
    pale,
    shade,
)
from hiros_viewer.poses import HIDDEN, Poses, Visit

_JOINT_M = 0.03
_BONE_M = 0.018
_DETECTION_M = 0.006
_THIN = -1.0  # rerun counts negative radii in points on the screen
_LABEL_ABOVE_M, _LABEL_STEP_M = 0.18, 0.16  # above the head; above the label of another log
_ERROR_PX = -1.0
_TRUTH_PX = -0.8
_ELLIPSOID_ALPHA, _ELLIPSOID_LINE = 110, -0.5
MAGNIFIED = 5.0
"""Displacements are millimetres; drawn to scale nobody would see them."""
LONGEST_M = 0.5
"""Length of a displacement as it is drawn: longer lines would leave the view."""
_FIELD_OF_VIEW_DEG = (75.0, 65.0)  # of the cameras as they are drawn; the log does not tell it
_LEFT = 2 * CLASSES  # offset of people's classes
_FIRST_CAMERA_CLASS = 4 * CLASSES
_TRUE = 5 * CLASSES
_FAINT = 10 * CLASSES


Counts = npt.NDArray[np.integer[Any]]
Singles = npt.NDArray[np.float32]
Rows = tuple[Stamps, Stamps]
"""(R, 2) times, and (R,) how many people are in each row."""


@dataclass(frozen=True, slots=True)
class Layer:
    """Which of several overlaid logs is drawn."""

    prefix: str = ""  # put before the log's entities
    name: str = ""  # put before people's names and the names of curves; "" if there is one log
    number: int = 0  # of several logs: that of the colour which everybody in it has
    file: str = ""  # its name outside the viewer, if that is another one

    def named(self, text: str) -> str:
        """Return what something is called in this log."""
        return f"{self.name} {text}" if self.name else text


KEY = "/key"


class Entities:
    """Draws rows into a recording.

    Parameters
    ----------
    recording : where to draw. model : of all skeletons.
    roots : markers whose mean leaves a person's trail. layer : which of the overlaid logs this is.
    """

    def __init__(
        self, recording: rr.RecordingStream, model: SkeletonModel, roots: list[int], layer: Layer
    ) -> None:
        self.recording = recording
        self.model = model
        self.start = 0  # ns; what seconds count from
        self._roots = roots
        self._above = _LABEL_ABOVE_M + _LABEL_STEP_M * layer.number
        self._layer = layer
        self._begun: set[str] = set()
        bones = model.links[(model.links >= 0).all(axis=1)]
        sides = [split_side(name)[1] for name in model.marker_names]
        left = np.array([sides[child] == "left" for child in bones[:, 1]], bool)
        self._bones = {"/bones": bones[~left], "/left_bones": bones[left]}

    # -- what stands still ---------------------------------------------------------------------

    def room(self, *, dim_detections: bool) -> None:
        """Draw the axes, and say what colours and bones each class has."""
        self.recording.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        classes = _annotations(self.model.marker_names, dim_detections=dim_detections)
        self.recording.log("/", classes, static=True)

    def camera(self, name: str, number: int, pose: Rigid, lens: Intrinsics | None = None) -> None:
        """Draw a camera as a frustum at its pose in the fixed frame, with its lens if known."""
        style = name, camera_colour(number), label_colour(curve_colour(number))
        self._frustum(f"/world/cameras/{path_part(name)}", pose, style, lens)

    def no_data(self, times: Stamps, place: Floats) -> None:
        """Say "no data" at a place (3,), m, from the first to the second of times (2, 2)."""
        if self._is_new("/world/no_data"):
            style = rr.Points3D.from_fields(
                colors=[TRUTH], radii=0.001, labels=["no data"], show_labels=True
            )
            self.recording.log("/world/no_data", style, static=True)
        parts = {rr.Points3D.descriptor_positions(): rr.components.Position3DBatch([place])}
        self._send("/world/no_data", times, parts, np.array([1, 0]))

    def _frustum(
        self, path: str, pose: Rigid, style: tuple[str, RGB, RGB], lens: Intrinsics | None = None
    ) -> None:
        """Draw a camera; ``style`` is its name or "", its colour, and that of the name."""
        name, colour, text_colour = style
        place = rr.Transform3D(
            translation=pose.translation, quaternion=rr.Quaternion(xyzw=pose.xyzw)
        )
        half = np.tan(np.radians(np.array(_FIELD_OF_VIEW_DEG) / 2))
        focal = 320 / half[0]
        width, height = (640.0, float(2 * focal * half[1])) if lens is None else lens.size
        frustum = rr.Pinhole(
            focal_length=float(focal) if lens is None else lens.focal,
            width=width,
            height=height,
            image_plane_distance=0.35,
            camera_xyz=rr.ViewCoordinates.RDF,
            color=colour,
            line_width=0.004,
        )
        self.recording.log(path, place, static=True)
        self.recording.log(f"{path}/view", frustum, static=True)
        if name:
            label = rr.Points3D(
                [[0.0, -0.3, 0.0]], radii=0.001, labels=[name], colors=[text_colour]
            )
            self.recording.log(f"{path}/name", label, static=True)

    # -- skeletons -----------------------------------------------------------------------------

    def detections(self, camera: str, number: int, poses: Poses, rows: Rows) -> None:
        """Send a camera's detections, thin: everybody's joints and bones in one batch.

        ``rows`` are times (R, 2) and counts (R,) of people, whose poses follow each other.
        """
        path = f"/detections/{path_part(camera)}"
        if self._is_new(path):
            which = _FIRST_CAMERA_CLASS + number % len(CAMERAS)
            style = rr.Points3D.from_fields(class_ids=[which], show_labels=False)
            self.recording.log(path, style, static=True)
            for part, code in zip(self._bones, (which, which + len(CAMERAS)), strict=True):
                bones = rr.LineStrips3D.from_fields(radii=_THIN, class_ids=code, show_labels=False)
                self.recording.log(f"{path}{part}", bones, static=True)
        people = np.arange(len(poses.ids))
        joints, radii = self._joints(poses, people, _DETECTION_M)
        keypoints = np.tile(np.arange(self.model.n_markers, dtype=np.uint16), len(people))
        parts = {
            rr.Points3D.descriptor_positions(): rr.components.Position3DBatch(joints),
            rr.Points3D.descriptor_radii(): rr.components.RadiusBatch(radii),
            rr.Points3D.descriptor_keypoint_ids(): rr.components.KeypointIdBatch(keypoints),
        }
        times, counts = rows
        self._send(path, times, parts, self.model.n_markers * counts)
        self._send_bones(path, joints, rows)

    def _send_bones(self, path: str, joints: Singles, rows: Rows) -> None:
        times, counts = rows
        frames = np.repeat(np.arange(len(counts)), counts)
        for part, batches, per_pose in self._bone_parts(joints):
            per_row = np.bincount(frames, per_pose, len(counts)).astype(np.int32)
            self._send(f"{path}{part}", times, batches, per_row)

    def person(
        self, path: str, visit: Visit, poses: Poses, labels: Sequence[str], *, is_strong: bool
    ) -> None:
        """Send joints, bones, labels and trail of one person.

        ``labels`` are those of the rows that show the person, "" = none. ``is_strong`` is the
        result; what it was made of is thin beside it.
        """
        if self._is_new(path):
            self._send_styles(path, is_strong=is_strong)
        shown = visit.people != HIDDEN
        people = visit.people[shown]
        joints, radii = self._joints(poses, people, _JOINT_M if is_strong else _DETECTION_M)
        highest = _highest(poses, people) + np.array([0, 0, self._above])
        for part, batches, per_pose in self._parts(joints, radii, highest, np.array(labels) != ""):
            counts = np.zeros(len(shown), np.int32)
            counts[shown] = per_pose
            self._send(f"{path}{part}", visit.times, batches, counts)
        if len(people):
            self._send_changes(path, visit.times[shown], labels, poses.is_predicted[people])

    def _send_changes(
        self, path: str, times: Stamps, labels: Sequence[str], is_predicted: Flags
    ) -> None:
        """Send what seldom changes in rows (R, 2): the label, and whether the person is faint."""
        states = list(zip(labels, is_predicted.tolist(), strict=True))
        new = [k for k, state in enumerate(states) if not k or state != states[k - 1]]
        code, when = self._class_of(path), time_columns(times[new], self.start)
        classes = np.where(is_predicted[new], _FAINT + code % CLASSES, code)
        for part, shift in (("", 0), *zip(self._bones, (0, _LEFT), strict=True)):
            kind = rr.LineStrips3D if part in self._bones else rr.Points3D
            column = kind.columns(class_ids=classes + shift)
            self.recording.send_columns(f"{path}{part}", when, column)
        column = rr.Points3D.columns(labels=[labels[k] for k in new])
        self.recording.send_columns(f"{path}/name", when, column)

    def _class_of(self, path: str) -> int:
        """Return the class of a person's right limbs and trunk."""
        if path.split("/")[-2] == "truth":
            return _TRUE
        return colour_number(person_of(path), self._layer) % CLASSES

    def _is_new(self, path: str) -> bool:
        """Whether it was not said yet how an entity looks; it is to be said now."""
        is_new = path not in self._begun
        self._begun.add(path)
        return is_new

    def _send(self, path: str, times: Stamps, batches: Mapping[Any, Any], counts: Counts) -> None:
        """Send rows (R, 2) of an entity, each with so many instances of its components."""
        when = time_columns(times, self.start)
        self.recording.send_columns(path, when, columns(batches, counts))

    def ellipsoids(self, person: int, times: Stamps, joints: Floats, half_sizes: Floats) -> None:
        """Send pale ellipsoids round joints (T, M, 3), m, of half axes (T, M), m; none for NaN."""
        path = f"{self._layer.prefix}/uncertainty/{person_part(person)}"
        if self._is_new(path):
            red, green, blue = pale(person_hue(person, self._layer))
            style = rr.Ellipsoids3D.from_fields(
                colors=[(red, green, blue, _ELLIPSOID_ALPHA)],
                fill_mode=rr.components.FillMode.TransparentFillMajorWireframe,
                line_radii=_ELLIPSOID_LINE,
                show_labels=False,
            )
            self.recording.log(path, style, static=True)
        present = ~(np.isnan(joints).any(axis=2) | np.isnan(half_sizes))
        sizes = np.repeat(half_sizes[present][:, None], 3, axis=1).astype(np.float32)
        centers = joints[present].astype(np.float32)
        parts = {
            rr.Ellipsoids3D.descriptor_half_sizes(): rr.components.HalfSize3DBatch(sizes),
            rr.Ellipsoids3D.descriptor_centers(): rr.components.Translation3DBatch(centers),
        }
        self._send(path, times, parts, present.sum(axis=1))

    def joint_lines(
        self, path: str, times: Stamps, ends: tuple[Floats, Floats], *, is_error: bool
    ) -> None:
        """Send lines between two (T, M, 3), m, none where either is NaN.

        They lead to the true joints, or to where a stage before had them.
        """
        if self._is_new(path):
            colour, radius = (ERROR, _ERROR_PX) if is_error else (DISPLACEMENT, _THIN)
            lines = rr.LineStrips3D.from_fields(colors=[colour], radii=radius)
            self.recording.log(path, lines, static=True)
        present = ~np.isnan(ends[0] - ends[1]).any(axis=2)
        strokes = np.stack([end[present] for end in ends], axis=1).astype(np.float32)
        parts = {rr.LineStrips3D.descriptor_strips(): strips(strokes)}
        self._send(path, times, parts, present.sum(axis=1))

    def _joints(self, poses: Poses, people: Stamps, largest: float) -> tuple[Singles, Singles]:
        """Return joints (K, M, 3) and radii (K, M), m, of some of the poses."""
        confidences = poses.confidences[people]
        sure = np.clip(np.where(np.isnan(confidences), 1.0, confidences), 0.0, 1.0)
        radii = largest * (0.5 + 0.5 * sure)  # full size at 1 or if it is unknown, half at 0
        return poses.positions[people].astype(np.float32), radii.astype(np.float32)

    def _parts(
        self, joints: Singles, radii: Singles, labels: Floats, has_label: Flags
    ) -> Iterator[tuple[str, Mapping[Any, Any], Any]]:
        """Yield a person's entities: path below theirs, batches, how many of it in each pose."""
        where, size = rr.Points3D.descriptor_positions(), rr.Points3D.descriptor_radii()
        points = rr.components.Position3DBatch
        yield "", {where: points(joints), size: rr.components.RadiusBatch(radii)}, joints.shape[1]
        yield from self._bone_parts(joints)
        there = ~np.isnan(labels[:, 0])
        yield "/name", {where: points(labels[there & has_label])}, there & has_label
        yield "/trail", {where: points(joints[there][:, self._roots].mean(axis=1))}, there

    def _bone_parts(self, joints: Singles) -> Iterator[tuple[str, Mapping[Any, Any], Any]]:
        """Yield bones like :meth:`_parts`: those of left limbs have an entity of their own."""
        for part, ends in self._bones.items():
            there = ~np.isnan(joints[:, ends, 0]).any(axis=2)
            bones = {rr.LineStrips3D.descriptor_strips(): strips(joints[:, ends][there])}
            yield part, bones, there.sum(axis=1)

    def _send_styles(self, path: str, *, is_strong: bool) -> None:
        """Say once how a person's entities look; classes and labels change."""
        is_true = self._class_of(path) == _TRUE
        colour = TRUTH if is_true else person_hue(person_of(path), self._layer)
        keypoints, radius = list(range(self.model.n_markers)), _BONE_M if is_strong else _THIN
        radius = _TRUTH_PX if is_true and not is_strong else radius
        bones = rr.LineStrips3D.from_fields(radii=radius, show_labels=False)
        for part, style in (
            ("", rr.Points3D.from_fields(keypoint_ids=keypoints, show_labels=False)),
            ("/name", rr.Points3D.from_fields(
                colors=[label_colour(colour)], radii=0.001, show_labels=True)),
            ("/trail", rr.Points3D.from_fields(
                class_ids=[self._class_of(path)], radii=0.005, show_labels=False)),
            *((part, bones) for part in self._bones),
        ):  # fmt: skip
            self.recording.log(f"{path}{part}", style, static=True)

    # -- curves, lanes and the log ---------------------------------------------------------------

    def curves(self, path: str, lines: Sequence[Line], times: Stamps, values: Floats) -> None:
        """Send rows (T, 2) and (T, len(lines)) of the curves of an entity."""
        if self._is_new(path):
            names, colours, widths = map(list, zip(*lines, strict=True))
            style = rr.SeriesLines(names=names, colors=colours, widths=widths)
            self.recording.log(path, style, static=True)
        parts = rr.Scalars.columns(scalars=values.ravel())
        counts = np.full(len(times), len(lines))
        self.recording.send_columns(path, time_columns(times, self.start), parts.partition(counts))

    def log_lines(self, path: str, rows: Sequence[TextRow]) -> None:
        """Send lines of the log."""
        stamps, texts, levels = zip(*rows, strict=True)
        parts = rr.TextLog.columns(text=texts, level=levels)
        times = np.array(stamps)
        # The list of events has room for hundredths of a second.
        times[:, 0] = self.start + (times[:, 0] - self.start + 5_000_000) // 10**7 * 10**7
        self.recording.send_columns(path, time_columns(times, self.start), parts)

    def lane(self, path: str, rows: Sequence[TextRow], style: Line) -> None:
        """Send a lane: filled in the first of its states, with a gap where that is gone."""
        times, texts, _ = zip(*rows, strict=True)
        if self._is_new(path):
            states = rr.StateConfiguration(
                values=[texts[0], "gone"],
                labels=[style.name, "gone"],
                colors=[packed(style.colour)] * 2,
                visible=[True, False],
            )
            self.recording.log(path, states, static=True)
        parts = rr.StateChange.columns(state=texts)
        self.recording.send_columns(path, time_columns(np.array(times), self.start), parts)


def colour_number(person: int, layer: Layer) -> int:
    """Return the number of a person's colour: of several logs, each has one."""
    return layer.number if layer.name else person


def person_hue(person: int, layer: Layer) -> RGB:
    """Return a person's colour, as in the room."""
    return person_colour(colour_number(person, layer))


def path_part(name: str) -> str:
    """Return a name as one part of an entity path."""
    return name.strip("/").replace("/", "_") or "_"


def person_part(person: int) -> str:
    """Return a person as one part of an entity path; spaces would be shown with backslashes."""
    return f"person_{person}"


def person_of(path: str) -> int:
    """Return the person whose entity this is."""
    return int(path.rsplit("_", 1)[-1])


def _highest(poses: Poses, people: Stamps) -> Floats:
    """(K, 3) mean x and y and greatest z of some of the poses, m; NaN for one without joints."""
    positions = poses.positions[people]
    there = ~np.isnan(positions)
    count = np.where(there.any(axis=1), there.sum(axis=1), np.nan)
    highest = np.where(there, positions, 0.0).sum(axis=1) / count
    greatest = np.fmax.reduce(positions[:, :, 2], axis=1, initial=-np.inf)
    highest[:, 2] = np.where(np.isinf(greatest), np.nan, greatest)
    return np.asarray(highest)


def packed(colour: RGB) -> int:
    """Return a colour as the 32 bits that rerun makes of it."""
    red, green, blue = colour
    return red << 24 | green << 16 | blue << 8 | 0xFF


@cache
def _annotations(marker_names: tuple[str, ...], *, dim_detections: bool) -> Any:
    """Return the classes: people, and each camera's detections. They take a tenth of a second."""
    sides = [split_side(name)[1] for name in marker_names]

    def keypoints(number: int, name: str, colour: RGB, left: int) -> list[Any]:
        plain, dark = packed(colour), packed(shade(colour))
        joints = [
            rr.AnnotationInfo(k, joint, dark if side == "left" else plain)
            for k, (joint, side) in enumerate(zip(marker_names, sides, strict=True))
        ]
        return [
            rr.ClassDescription(info=(number, name, plain), keypoint_annotations=joints),
            rr.ClassDescription(info=(left, name, dark)),
        ]

    classes = keypoints(_TRUE, "truth", TRUTH, _LEFT + _TRUE)
    for k in range(CLASSES):
        hue, hidden = person_colour(k), _FAINT + k
        classes += keypoints(k, f"person {k}", hue, _LEFT + k)
        classes += keypoints(hidden, f"person {k}", faint(hue), _LEFT + hidden)
    for camera in range(len(CAMERAS)):
        colour = camera_colour(camera) if dim_detections else curve_colour(camera)
        number = _FIRST_CAMERA_CLASS + camera
        classes += keypoints(number, "", colour, number + len(CAMERAS))
    return rr.AnnotationContext(classes)
