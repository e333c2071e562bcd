"""Skeletons as a Rerun recording: what is drawn, where in the tree, in which colour.

::

    /world                      coordinates, cameras/<camera> as frusta with their names
    /detections/<camera>        what the camera reports, in the fixed frame, thin and dim
    /<stage>/<person>           joints; stages are tracked merged optimized filtered truth
    .../bones .../left_bones    left limbs have a darker shade;  .../name  label above the head
    .../trail                   path of the root
    /angles/<person>/<joint> /limbs/<person>/<limb>    curves of the last stage, left and right
    /speed/<person>             of the last stage
    /displacement/<stage>/<person>   lines to where a stage had the joints;  /moved/...  its mean
    /people/<camera>, /residual/<camera>   skeletons that it reports, distance to the last stage
    /error_lines/<person>, /error/<person>   from the result to the truth; their length, mm
    /state/<person>             while somebody is tracked;  /log   events
    /marked/<camera>/<fault>    detections that are mirrored or far off;  /views/...   when
    /cameras                    numbers of each camera

A person's part of a path is person_<id>. Time is in seconds from the start, and as a date.
Rows are collected and sent in columns, a batch at a time, so that memory stays bounded.
"""

from __future__ import annotations

import heapq
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from hiros_mcap.body.anatomy import ANGLE_NAMES, MAIN_ANGLES, anatomical_angles, continued
from hiros_mcap.body.rotations import Rigid
from hiros_mcap.body.symmetry import split_side, symmetry_of
from hiros_mcap.evaluate.match import MATCH_DISTANCE
from hiros_mcap.evaluate.pairing import best_pairs, skeleton_distances
from hiros_mcap.evaluate.smoothness import lengths_of
from hiros_mcap.evaluate.truth import Truth
from hiros_mcap.events import Event
from hiros_mcap.skeletons import UNTRACKED, Flags, Floats, Frame, SkeletonModel, Stamps
from hiros_viewer.camera_moves import CameraMove
from hiros_viewer.columns import (
    DetectionRows,
    Line,
    PersonRows,
    PoseBatch,
    Poses,
    ScalarRows,
    StageRows,
    TextRows,
)
from hiros_viewer.displacement import EarlierPoses, mean_distances
from hiros_viewer.entities import (
    Entities,
    Layer,
    fault_part,
    path_part,
    person_hue,
    person_part,
)
from hiros_viewer.palette import FAULTY, SIDES, curve_colour, pale
from hiros_viewer.view_check import FaultySpan, ViewCheck

if TYPE_CHECKING:
    import rerun as rr

STAGES = ("tracked", "merged", "optimized", "filtered", "truth")
BATCH = 4000
"""Frames collected before they are sent."""
_FIRST_BATCH = 400
"""Before anybody was drawn: the first picture comes soon."""
GONE_NS = 250_000_000
"""Somebody or something that was not seen for this long is hidden."""
_ALONE = Layer()
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
    layer : which of several logs this is, when they are overlaid.
    """

    def __init__(
        self,
        recording: rr.RecordingStream,
        model: SkeletonModel,
        *,
        final: str = "filtered",
        layer: Layer = _ALONE,
        batch: int = BATCH,
    ) -> None:
        self.model = model
        self.final = final
        self.people: set[int] = set()
        self.start: int | None = None
        """ns; what seconds count from. None = the first frame."""
        self.bounds: list[Floats] = []
        self.camera_poses: Mapping[str, Rigid] = {}
        """By name, in the fixed frame."""
        self.truth: Truth | None = None
        """What to compare the last stage with, on the markers of the model."""
        self.shows_truth = False
        """Whether the truth is to be seen in the room; its error is plotted in any case."""
        self.most_people = 0
        """In one detection message."""
        self.has_moves = False
        """Whether poses before and after a calibration were drawn."""
        self.ranges: dict[str, tuple[float, float]] = {}
        """Kind of curve, as "limbs/thigh" -> where most of its values are."""
        self.n_true = 0
        """Frames of the last stage whose instant the truth covers."""
        self._layer, self._prefix = layer, layer.prefix
        self._batch = batch
        self._collected = 0
        self._n_detections = 0
        n = model.n_markers
        self._detections = defaultdict[str, DetectionRows](lambda: DetectionRows(PoseBatch(n)))
        self._stages = defaultdict[str, StageRows](lambda: StageRows(PoseBatch(n)))
        self._scalars: dict[str, ScalarRows] = {}
        self._curves: dict[tuple[str, str], ScalarRows] = {}
        self._texts = defaultdict[str, TextRows](TextRows)
        self._earlier = defaultdict[tuple[str, int], EarlierPoses](EarlierPoses)
        """By stage and person."""
        mirror = symmetry_of(model).mirror
        self._checks = defaultdict[str, ViewCheck](lambda: ViewCheck(mirror))
        """By camera."""
        self._marks = defaultdict[tuple[str, str], DetectionRows](
            lambda: DetectionRows(PoseBatch(n))
        )
        """By camera and kind of fault: its detections that have it."""
        self._lane_looks: dict[str, Line] = {}
        """By path."""
        self._true = defaultdict[int, list[tuple[int, Floats]]](list)
        """By person: stamps and true poses that are not among the earlier ones yet."""
        self._reference = _Reference()
        self._waiting: list[tuple[int, int, str, Floats]] = []
        """Heap of detections that the last stage has not come to: stamp, number, camera, joints."""
        self._alive: set[int] = set()
        self._lengths = Counter[int]()
        """Frames of the last stage that everybody is in."""
        self._root = _root_slot(model)
        self._entities = Entities(recording, model, self._root, layer)
        self._limbs = limb_links(model)

    @property
    def prefix(self) -> str:
        """What stands before the entities of this log."""
        return self._layer.prefix

    @property
    def cameras(self) -> list[str]:
        """Names of the cameras, in the order of their colours."""
        return list(self._detections)

    @property
    def longest(self) -> int:
        """Who is there for longest in the last stage."""
        people = self._lengths
        return max(people, key=people.__getitem__, default=0)

    @property
    def stages(self) -> list[str]:
        """Names of the stages that were drawn."""
        return list(self._stages)

    # -- what does not change ------------------------------------------------------------------

    def begin(
        self, cameras: Mapping[str, Rigid], later: Mapping[str, Mapping[float, Rigid]] | None = None
    ) -> None:
        """Draw what stands still: axes, colours, and the cameras at their poses in the room.

        ``later`` has the further poses of cameras that were moved, by the time in s.
        """
        if not self._layer.number:
            # Dim behind a result; without one, detections are all there is to see.
            self._entities.room(dim_detections=bool(self.final))
        self.camera_poses = cameras
        for number, (name, pose) in enumerate(cameras.items()):
            _ = self._detections[name]  # cameras keep the order in which they are drawn
            self._entities.camera(name, number, pose)
            for seconds, moved in (later or {}).get(name, {}).items():
                self._entities.camera(f"{name} from {seconds:.1f} s", number, moved)

    def moves(self, moves: Sequence[CameraMove]) -> None:
        """Draw where cameras were before a calibration, and how far they moved."""
        self.has_moves = True
        self._entities.moves(moves)

    def explain(self, *lines: str) -> None:
        """Add lines to those that say what colours mean, Markdown."""
        self._entities.key(*lines)

    # -- frames --------------------------------------------------------------------------------

    def detections(self, camera: str, frame: Frame | Poses) -> None:
        """Draw what a camera reports; the frame is in the fixed frame."""
        rows = self._detections[camera]
        self._hide_after_pause(rows, frame.stamp)
        rows.add(frame)
        self._curve("/people", camera).add(frame.stamp, len(frame.ids))
        self.most_people = max(self.most_people, len(frame.ids))
        if self.final:
            positions = np.ascontiguousarray(frame.positions)
            heapq.heappush(self._waiting, (frame.stamp, self._n_detections, camera, positions))
            self._n_detections += 1
            if len(self._waiting) > _MOST_WAITING:
                heapq.heappop(self._waiting)
        self._count(frame.stamp)

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
        """Draw how far detections are from the nearest person each, and mark wrong ones."""
        check = self._checks[camera]
        known = len(check.distances)
        faults = check.compare(positions, people)
        if len(check.distances) > known:
            self._curve("/residual", camera).add(stamp, check.distances[-1])
        for kind, rows in faults.items():
            if rows.any():
                wrong = positions[rows]
                certain = np.ones(wrong.shape[:2])
                ids = np.full(len(wrong), UNTRACKED)
                self._marks[camera, kind].add(Poses(stamp, camera, ids, wrong, certain))
            elif (camera, kind) in self._marks:
                self._marks[camera, kind].hide(stamp)
        self._tell(camera, check.spans(stamp, faults))

    def _tell(self, camera: str, spans: Iterable[FaultySpan]) -> None:
        """Show when a camera's view was wrong: a lane, and a line in the list of events."""
        for span in spans:
            path = f"/views/{path_part(camera)}/{fault_part(span.kind)}"
            self._lane_looks[path] = Line(f"{camera} {span.kind}", FAULTY[span.kind])
            self._texts[path].add(span.start, span.kind)
            self._texts[path].add(span.end, "gone")
            detail = f"for {(span.end - span.start) / 1e9:.2f} s"
            self.event(Event(span.start, f"view {span.kind}", UNTRACKED, camera, detail))

    def describe_cameras(self, report: Mapping[str, Mapping[str, Any]]) -> None:
        """Show the numbers of each camera: those of the run, by camera, and what was drawn."""
        rows = []
        for camera in self.cameras:
            run, check = report.get(camera, {}), self._checks[camera]
            used = f"{run['used']} of {run['messages']}" if run.get("messages") else "-"
            counts = [str(run.get(name, "-")) for name in ("flips", "outliers")]
            rows.append((camera, used, *check.row(), *counts))
        if rows and self.final:
            self._entities.camera_table(rows)

    def stage(self, name: str, frame: Frame | Poses) -> None:
        """Draw a stage's people."""
        rows = self._stages[name]
        self._end_before_pause(name, rows, frame.stamp)
        place = rows.poses.size
        rows.poses.add(frame)
        ids = frame.ids.tolist()
        for person in ids:
            if person != UNTRACKED:
                person_rows = rows.people.get(person)
                if person_rows is None:
                    person_rows = rows.people[person] = PersonRows()
                    if name != "truth" or not self.final:
                        self.people.add(person)
                self._hide_after_pause(person_rows, frame.stamp)
                person_rows.add(frame.stamp, place)
                rows.shown[person] = person_rows
            place += 1
        # The tracker's frames are of one camera each, which does not see everybody.
        self._hide_gone(rows, ids, frame.stamp, GONE_NS if name == "tracked" else 0)
        if name == self.final:
            self._compare(_Reference(frame.stamp, np.ascontiguousarray(frame.positions)))
            self._lengths.update(person for person in ids if person != UNTRACKED)
            self._states(ids, frame.stamp)
            if self.truth is not None and self.truth.covers(frame.stamp):
                self._match(frame, self.truth)
        self._count(frame.stamp)

    def _match(self, frame: Frame | Poses, truth: Truth) -> None:
        """Note the true pose of everybody in a frame who is near a true person."""
        self.n_true += 1
        true = truth.at(frame.stamp)[0]
        distances = skeleton_distances(true, frame.positions)
        distances[:, frame.ids == UNTRACKED] = np.inf
        for row, column in best_pairs(np.where(distances < MATCH_DISTANCE, distances, np.inf)):
            self._true[int(frame.ids[column])].append((frame.stamp, true[row]))

    def _hide_gone(self, rows: StageRows, ids: list[int], stamp: int, patience: int) -> None:
        """Hide people whom this frame lacks."""
        gone = [
            person
            for person, person_rows in rows.shown.items()
            if person not in ids and stamp - person_rows.last >= patience
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

    def _hide_after_pause(self, rows: DetectionRows | PersonRows, stamp: int) -> None:
        """Hide what was last shown before a pause of the channel."""
        if rows.shown and stamp - rows.last > 2 * GONE_NS:
            rows.hide(rows.last + GONE_NS)

    def _states(self, ids: list[int], stamp: int) -> None:
        """Note when somebody comes and goes."""
        here = set(ids) - {UNTRACKED}
        if here == self._alive:
            return
        for person in sorted(here - self._alive):
            self._lane(person).add(stamp, "tracked")
        self._leave(self._alive - here, stamp)
        self._alive = here

    def _leave(self, people: set[int], stamp: int) -> None:
        for person in sorted(people):
            self._lane(person).add(stamp, "gone")

    def _lane(self, person: int) -> TextRows:
        path = f"{self._prefix}/state/{person_part(person)}"
        self._lane_looks[path] = self._person_line(person)
        return self._texts[path]

    def event(self, event: Event) -> None:
        """Write an event into the log."""
        level = "WARN" if event.is_warning else "INFO"
        self._texts[f"{self._prefix}/log"].add(event.stamp, self._layer.named(event.text), level)

    def distance(self, stamp: int, name: str, millimetres: float) -> None:
        """Add to the curve of joint distances between two logs, mm."""
        self._curve("/distance", name).add(stamp, millimetres)

    def _curve(self, kind: str, name: str) -> ScalarRows:
        """Return the rows of a single curve, made when it is first asked for."""
        rows = self._curves.get((kind, name))
        if rows is None:
            known = ["mean", "largest"] if kind == "/distance" else self.cameras
            line = Line(name, curve_colour(known.index(name)))
            rows = self._curves[kind, name] = ScalarRows([line])
            self._scalars[f"{kind}/{path_part(name)}"] = rows
        return rows

    # -- sending -------------------------------------------------------------------------------

    def _count(self, stamp: int) -> None:
        """Count a frame, and send what was collected once it is enough."""
        if self.start is None:
            self.start = stamp
        self._collected += 1
        if self._collected >= (self._batch if self.bounds else min(self._batch, _FIRST_BATCH)):
            self.flush()

    def finish(self) -> None:
        """Send what is left, and hide everybody after the last frame."""
        for rows in self._detections.values():
            rows.hide(rows.last + GONE_NS)
        for stage in self._stages.values():
            for person_rows in stage.shown.values():
                person_rows.hide(person_rows.last + GONE_NS)
        self._compare(_Reference(self._reference.stamp + 2 * GONE_NS))
        for marks in self._marks.values():
            marks.hide(marks.last + GONE_NS)
        for camera, check in self._checks.items():
            self._tell(camera, check.finish())
        final = self._stages.get(self.final)
        self._leave(self._alive, (final.last if final else 0) + GONE_NS)
        self.flush()

    def flush(self) -> None:
        """Send what was collected so far."""
        self._collected = 0
        self._entities.start = self.start or 0
        for number, (camera, rows) in enumerate(self._detections.items()):
            if rows.stamps:
                highest = self._entities.detections(camera, number, rows)
                if not self.final:
                    self._extend_bounds(highest)
                rows.sent()
        for (camera, kind), marks in self._marks.items():
            if marks.stamps:
                self._entities.marks(camera, kind, marks)
                marks.sent()
        for person, noted in self._true.items():
            stamps, poses = zip(*noted, strict=True)
            self._earlier["truth", person].add(np.array(stamps), np.stack(poses))
        self._true.clear()
        for name in sorted(self._stages, key=lambda name: name == self.final):
            self._send_stage(name, self._stages[name])
        for path, curve in self._scalars.items():
            if curve.stamps:
                self._entities.curves(path, curve)
                curve.sent()
        for path, lines in self._texts.items():
            if lines.stamps:
                if path in self._lane_looks:
                    self._entities.lane(path, lines, self._lane_looks[path])
                else:
                    self._entities.log_lines(path, lines)
                lines.sent()

    def _send_stage(self, stage: str, rows: StageRows) -> None:
        """Send everybody of a stage."""
        for person, person_rows in rows.people.items():
            if person_rows.stamps:
                path = f"{self._prefix}/{stage}/{person_part(person)}"
                shown, highest = self._entities.person(
                    path, person_rows, rows.poses, is_strong=stage == (self.final or "truth")
                )
                self._extend_bounds(highest)
                poses = rows.poses.positions[np.array(person_rows.places)[shown]]
                stamps = np.array(person_rows.stamps)
                if stage == self.final:
                    self._show_displacements(person, stamps, shown, poses)
                    if shown.any():
                        self._derive_curves(person, person_rows, stamps[shown], poses)
                elif stage in self._before():
                    self._earlier[stage, person].add(stamps[shown], poses)
                person_rows.sent()
        rows.poses.clear()

    def _extend_bounds(self, highest: Floats) -> None:
        """Note where people are, for the eye that is to look at them."""
        if len(self.bounds) < _MOST_BOUNDS:
            self.bounds += list(highest[~np.isnan(highest[:, 0])][::10])

    def _before(self) -> tuple[str, ...]:
        """Return the stages whose frames have the result's times: those between both ends."""
        return STAGES[1 : max(STAGES.index(self.final), 1)] if self.final in STAGES else ()

    def _show_displacements(self, person: int, stamps: Stamps, shown: Flags, poses: Floats) -> None:
        """Draw how far the result, ``poses`` (K, M, 3) of the rows shown, is from each stage."""
        result = np.full((len(stamps), self.model.n_markers, 3), np.nan)
        result[shown] = poses
        drawn = [stage for stage in self._before() if stage in self._stages]
        for stage in drawn:
            before = self._earlier[stage, person].at(stamps, self.model.n_markers)
            path = f"{stage}/{person_part(person)}"
            if stage == drawn[0]:
                self._entities.displacements(
                    f"{self._prefix}/displacement/{path}", stamps.tolist(), result, before
                )
            apart = 1000 * mean_distances(before, result)
            known = ~np.isnan(apart)
            lines = [self._person_line(person)]
            self._extend(f"{self._prefix}/moved/{path}", lines, stamps[known], apart[known])
        if self.truth is not None:
            self._show_errors(person, stamps, result)

    def _show_errors(self, person: int, stamps: Stamps, result: Floats) -> None:
        """Draw how far the result, (T, M, 3) m, is from the truth."""
        true = self._earlier["truth", person].at(stamps, self.model.n_markers)
        part = person_part(person)
        self._entities.errors(f"{self._prefix}/error_lines/{part}", stamps.tolist(), result, true)
        mean = 1000 * mean_distances(result, true)
        known = ~np.isnan(mean)
        lines = [self._person_line(person)]
        self._extend(f"{self._prefix}/error/{part}", lines, stamps[known], mean[known])

    def _person_line(self, person: int) -> Line:
        """Return the curve of a person, in its colour."""
        return Line(self._layer.named(f"person {person}"), person_hue(person, self._layer))

    def _side_lines(self, names: Sequence[str]) -> list[Line]:
        """Return curves of which the left ones are pale and thin, the right ones strong."""
        lines = []
        for name in names:
            side = split_side(name)[1]
            colour = pale(SIDES[side]) if self._layer.number else SIDES[side]
            lines.append(Line(self._layer.named(name), colour, 2.5 if side == "right" else 1.5))
        return lines

    def _extend_sides(
        self, kind: str, person: int, names: Sequence[str], stamps: Stamps, values: Floats
    ) -> None:
        """Add to curves (T, len(names)); what is left and right of one joint shares an entity."""
        path = f"{self._prefix}/{kind}/{person_part(person)}"
        parts = [split_side(name)[0] for name in names]
        for part in dict.fromkeys(parts):
            columns = [k for k, own in enumerate(parts) if own == part]
            lines = self._side_lines([names[k] for k in columns])
            self._widen(f"{kind}/{part}", values[:, columns])
            self._extend(f"{path}/{part.replace(' ', '_')}", lines, stamps, values[:, columns])

    def _derive_curves(self, person: int, rows: PersonRows, stamps: Stamps, poses: Floats) -> None:
        """Angles, limb lengths and speed of the last stage."""
        main = [ANGLE_NAMES.index(name) for name in MAIN_ANGLES]
        jumping = anatomical_angles(self.model, poses, unwrapped=False)[:, main]
        angles = continued(jumping, rows.last_angles)
        rows.last_angles = angles[-1]
        self._extend_sides("angles", person, MAIN_ANGLES, stamps, np.degrees(angles))
        if self._limbs:
            lengths = lengths_of(poses, self.model)[:, list(self._limbs.values())]
            self._extend_sides("limbs", person, tuple(self._limbs), stamps, lengths)
        moments, roots = stamps, poses[:, self._root]
        if rows.last_root is not None:
            moments = np.insert(moments, 0, rows.last_root[0])
            roots = np.insert(roots, 0, rows.last_root[1], axis=0)
        rows.last_root = (int(stamps[-1]), poses[-1, self._root])
        steps = np.diff(moments)
        steady = (steps > 0) & (steps < GONE_NS)
        speeds = np.linalg.norm(np.diff(roots, axis=0), axis=-1)[steady] / (steps[steady] / 1e9)
        lines = [self._person_line(person)]
        path = f"{self._prefix}/speed/{person_part(person)}"
        self._extend(path, lines, moments[1:][steady], speeds)

    def _widen(self, kind: str, values: Floats) -> None:
        """Note where curves are, all but their outliers."""
        known = values[~np.isnan(values)]
        if known.size:
            low, high = np.percentile(known, [0.5, 99.5])
            past = self.ranges.get(kind, (low, high))
            self.ranges[kind] = min(past[0], float(low)), max(past[1], float(high))

    def _extend(self, path: str, lines: Sequence[Line], stamps: Stamps, values: Floats) -> None:
        self._scalars.setdefault(path, ScalarRows(lines)).extend(stamps, values)


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
