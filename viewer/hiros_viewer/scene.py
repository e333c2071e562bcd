"""Skeletons as a Rerun recording: what is drawn, where in the tree, in which colour.

::

    /world                      coordinates, cameras/<camera> as frusta with their names
    /detections/<camera>        what the camera reports, in the fixed frame, thin and dim
    /<stage>/<person>           joints; stages are tracked merged optimized filtered truth
    .../bones .../left_bones    left limbs have a darker shade;  .../name  label above the head
    .../trail                   path of the pelvis, or of the middle of the hips
    /angles/<person>/<joint>    curves of the last stage, left and right
    /speed/<person>             of the last stage
    /displacement/<stage>/<person>   lines to where a stage had the joints;  /moved/...  its mean
    /people/<camera>, /residual/<camera>   skeletons that it reports, distance to the last stage
    /error_lines/<person>, /error/<person>   from the result to the truth; their length, mm
    /uncertainty/<person>       ellipsoids that hold the true joints with 68 %
    /<person>                   while somebody is tracked;  /log   events
    /no_data                    while no camera sends anything;  /world/no_data   so in the room
    /images/<camera>            what an RGB camera sees (:mod:`hiros_viewer.images`)

A person's part of a path is person_<id>. Time is in seconds from the start, as a date, and as the
time at which a live system could have known what is shown. Some thousand frames are drawn at once
(:mod:`hiros_viewer.poses`), so that memory stays bounded.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import rerun as rr

from hiros_mcap.body.anatomy import ANGLE_NAMES, MAIN_ANGLES, MOST_RAD, anatomical_angles, continued
from hiros_mcap.body.rotations import Rigid
from hiros_mcap.body.symmetry import split_side
from hiros_mcap.evaluate.match import MATCH_DISTANCE, skeleton_distances
from hiros_mcap.evaluate.mot import best_pairs
from hiros_mcap.evaluate.truth import Truth
from hiros_mcap.events import Event
from hiros_mcap.io.rgb_cameras import RgbCamera
from hiros_mcap.running.observe import DETECTIONS
from hiros_mcap.skeletons import UNTRACKED, Flags, Floats, SkeletonModel, Stamps
from hiros_viewer.columns import GONE_NS, Line, TextRow, after_pauses, ended
from hiros_viewer.entities import (
    LONGEST_M,
    MAGNIFIED,
    Entities,
    Layer,
    path_part,
    person_hue,
    person_part,
)
from hiros_viewer.images import CameraImages
from hiros_viewer.palette import DISTANCES, SIDES, SILENCE, curve_colour, shade
from hiros_viewer.poses import (
    HALF_SIZE,
    HIDDEN,
    UNCERTAIN_STAGE,
    Channel,
    Crowd,
    Poses,
    Uncertainties,
    Visit,
    Visits,
)
from hiros_viewer.view_check import (
    Compared,
    EarlierPoses,
    Waiting,
    apart,
    mean_distances,
)

STAGES = ("tracked", "merged", "optimized", "filtered", "truth")
_ALONE = Layer()
_MOST_BOUNDS = 2000
PERSON, NO_DATA = "person", "no data"
"""What a lane shows."""
SILENCE_S = 1.0
"""Without any message for longer, there is no data; detectors send several messages a second."""
_ROOTS = ("pelvis", "spinebase", "midhip", "hips", "spine_base", "spinemid")


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
    ) -> None:
        self.model = model
        self.final = final
        self.people: set[int] = set()
        self.start: int | None = None  # ns; what seconds count from. None = the first frame.
        self.bounds: list[Floats] = []  # (2, 3) m each: the box around somebody, from feet to head
        self.camera_poses: Mapping[str, Rigid] = {}  # by name, in the fixed frame
        self.truth: Truth | None = None
        """The truth to compare the last stage with, on the markers of the model."""
        self.shows_truth = False
        """Whether the truth is to be seen in the room; its error is plotted in any case."""
        self.uncertainties: Uncertainties | None = None
        """How well joints are known, to be drawn as ellipsoids."""
        self.images: list[CameraImages] = []  # of the RGB cameras
        self.ranges: dict[str, tuple[float, float]] = {}  # of the values of each kind of curve
        self.moved: set[str] = set()  # stages whose joints are not those of the last one
        self.has_predicted = False  # whether somebody whom no camera saw is in the last stage
        self.lanes: dict[str, str] = {}
        """Path of a lane -> what it shows: a person, or no data."""
        self.n_true = 0  # frames of the last stage whose instant the truth covers
        self.layer, self.prefix = layer, layer.prefix
        self._crowds = defaultdict[str, Crowd](Crowd)
        """By camera; in the order in which cameras were first seen."""
        self._stages: dict[str, Visits] = {}
        self._curves: dict[str, Stamps] = {}  # by path: (2,) times of the newest row
        self._texts = defaultdict[str, list[TextRow]](list)
        """By path: rows that are still to be sent."""
        self._lane_styles: dict[str, Line] = {}  # by path
        self._earlier = defaultdict[tuple[str, int], EarlierPoses](EarlierPoses)
        """By stage and person."""
        self._pasts = defaultdict[int, _Past](_Past)  # by person
        self._true_ids = defaultdict[int, dict[int, int]](dict)
        """By person: stamp -> the true person who is nearest."""
        self._newest: Stamps | None = None  # (2,) times of the last message
        self._waiting = Waiting()
        self._lengths = Counter[int]()  # frames of the last stage that everybody is in
        names = [split_side(name)[0] for name in model.marker_names]
        middle = [names.index(root) for root in _ROOTS if root in names]
        hips = [slot for slot, name in enumerate(names) if name == "hip"]
        self._roots = middle[:1] or hips or [0]
        self._recording = recording
        self._entities = Entities(recording, model, self._roots, layer)

    @property
    def cameras(self) -> list[str]:
        """Names of the cameras, in the order of their colours."""
        return list(self._crowds)

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
        if not self.layer.number:
            # Dim behind a result; without one, detections are all there is to see.
            self._entities.room(dim_detections=bool(self.final))
        self.camera_poses = cameras
        for number, (name, pose) in enumerate(cameras.items()):
            _ = self._crowds[name]  # cameras keep the order in which they are drawn
            self._entities.camera(name, number, pose)
            for seconds, moved in (later or {}).get(name, {}).items():
                self._entities.camera(f"{name} from {seconds:.1f} s", number, moved)

    def show_images(self, cameras: Sequence[tuple[RgbCamera, Rigid | None]]) -> None:
        """Draw RGB cameras at their poses, and what they see; after :meth:`begin`."""
        for number, (camera, pose) in enumerate(cameras, start=len(self._crowds)):
            self.images.append(CameraImages(self._recording, camera, number, pose))
            if pose is not None:
                self.camera_poses = {**self.camera_poses, camera.name: pose}
                self._entities.camera(camera.name, number, pose, camera.lens)

    def draw(self, frames: Mapping[Channel, Poses]) -> None:
        """Draw frames of all channels that have the same time: detections, then stages."""
        if self.start is None and frames:
            self.start = min(int(poses.stamps[0]) for poses in frames.values())
        self._entities.start = self.start or 0
        for (kind, source), poses in frames.items():
            if kind == DETECTIONS:
                self.detections(source, poses)
        for kind, _ in sorted(frames, key=lambda channel: channel[0] == self.final):
            if kind != DETECTIONS:
                self.stage(kind, frames[kind, ""])
        self._mark_silence([p for (kind, _), p in frames.items() if kind == DETECTIONS])
        self._send_texts()

    def _mark_silence(self, some: Sequence[Poses]) -> None:
        """Say where nothing was recorded: in the room, in a lane and in the list of events."""
        if not some:
            return
        times = np.concatenate([poses.times for poses in some])
        times = times[np.argsort(times[:, 0], kind="stable")]
        places, before = after_pauses(times, self._newest)
        if self._newest is None or times[-1, 0] > self._newest[0]:
            self._newest = times[-1]
        for start, end in zip(before, times[places], strict=True):
            seconds = float(end[0] - start[0]) / 1e9
            if seconds < SILENCE_S:
                continue
            self._lane("/no_data", Line("no data", SILENCE), NO_DATA)
            self._texts["/no_data"] += [(start, "no data", "INFO"), (end, "gone", "INFO")]
            silence = Event(int(start[0]), "no data", UNTRACKED, "", f"for {seconds:.2f} s")
            self.event(silence, int(start[1]))
            if self.bounds:
                place = np.mean(self.bounds, axis=(0, 1))
                self._entities.no_data(np.stack([start + GONE_NS, end]), place)

    def detections(self, camera: str, poses: Poses) -> None:
        """Draw what a camera reports; it is in the fixed frame."""
        number = list(self._crowds).index(camera) if camera in self._crowds else len(self._crowds)
        rows = self._crowds[camera].rows(poses)
        self._entities.detections(camera, number, poses, rows)
        self._extend_camera("/people", camera, poses.times, poses.counts.astype(float))
        if self.final:
            self._waiting.add(camera, poses)
        else:
            self._extend_bounds(poses.positions)

    def _compare(self, some: Iterable[Compared]) -> None:
        """Draw how far detections are from the nearest person each."""
        for camera, detections, people, rows in some:
            distances = mean_distances(detections, people, rows)
            present = ~np.isnan(distances)
            self._extend_camera("/residual", camera, detections.times[present], distances[present])

    def stage(self, name: str, poses: Poses) -> None:
        """Draw a stage's people."""
        visits = self._stages.get(name)
        if visits is None:
            # The tracker's frames are of one camera each, which does not see everybody.
            visits = self._stages[name] = Visits(GONE_NS if name == "tracked" else 0)
        if name == self.final:
            for image in self.images:
                image.result(poses, self.model, self.layer, self.start or 0)
            self._compare(self._waiting.reached(poses))
            if self.truth is not None:
                self._match(poses, self.truth)
        for visit in visits.of(poses):
            if name != "truth" or not self.final:
                self.people.add(visit.person)
            self._send_visit(name, visit, poses)

    def _match(self, poses: Poses, truth: Truth) -> None:
        """Note the true pose of everybody in a frame who is near a true person."""
        matches = defaultdict[int, list[tuple[int, Floats]]](list)
        self._true_ids.clear()
        frames = zip(poses.stamps.tolist(), poses.rows.tolist(), strict=True)
        for stamp, (begin, end) in frames:
            if not truth.covers(stamp):
                continue
            self.n_true += 1
            true = truth.at(stamp)[0]
            distances = skeleton_distances(true, poses.positions[begin:end])
            distances[:, poses.ids[begin:end] == UNTRACKED] = np.inf
            near = np.where(distances < MATCH_DISTANCE, distances, np.inf)
            for row, column in best_pairs(near):
                person = int(poses.ids[begin + column])
                matches[person].append((stamp, true[row]))
                self._true_ids[person][stamp] = truth.people[row] if truth.people else row
        for person, noted in matches.items():
            stamps, true_poses = zip(*noted, strict=True)
            self._earlier["truth", person].add(np.array(stamps), np.stack(true_poses))

    def _send_visit(self, stage: str, visit: Visit, poses: Poses) -> None:
        path = f"{self.prefix}/{stage}/{person_part(visit.person)}"
        shown = visit.people != HIDDEN
        people = visit.people[shown]
        is_strong = stage == (self.final or "truth")
        seen = zip(visit.times[shown, 0].tolist(), poses.is_predicted[people], strict=True)
        labels = [self._label(stage, visit.person, stamp, gone) for stamp, gone in seen]
        self._entities.person(path, visit, poses, labels, is_strong=is_strong)
        positions = poses.positions[people]
        self._extend_bounds(positions)
        if stage == UNCERTAIN_STAGE:
            self._show_uncertainty(visit, shown, positions)
        if stage == self.final:
            self._states(visit)
            self.has_predicted |= bool(poses.is_predicted[people].any())
            self._lengths[visit.person] += int(shown.sum())
            self._show_displacements(visit, shown, positions)
            if shown.any():
                self._derive_curves(visit.person, visit.times[shown], positions)
        elif stage in self._before():
            self._earlier[stage, visit.person].add(visit.times[shown, 0], positions)

    def _label(self, stage: str, person: int, stamp: int, is_predicted: bool) -> str:
        """Return what is written above somebody; the true person beside the one of the result."""
        if stage == "truth":
            return "" if self.final else f"truth {person}"
        # Beside the other log's, who stands in the same place, there is room for little.
        name = self.layer.named(str(person)) if self.layer.name else f"person {person}"
        if stage != self.final:
            return name
        true = self._true_ids[person].get(stamp) if self.shows_truth else None
        truth = "" if true is None else f" = truth {true}"
        return f"{name}{truth}{', predicted' if is_predicted else ''}"

    def _show_uncertainty(self, visit: Visit, shown: Flags, poses: Floats) -> None:
        """Draw how well the joints ``poses`` (K, M, 3) of the rows shown are known."""
        if self.uncertainties is not None:
            sizes = np.full((len(shown), self.model.n_markers), np.nan)
            sizes[shown] = self.uncertainties.at(visit.person, visit.times[shown, 0])
            joints = np.full((*sizes.shape, 3), np.nan)
            joints[shown] = poses
            self._entities.ellipsoids(visit.person, visit.times, joints, HALF_SIZE * sizes)

    def _states(self, visit: Visit) -> None:
        path = f"{self.prefix}/{person_part(visit.person)}"
        self._lane(path, self._person_line(visit.person), PERSON)
        for row in np.flatnonzero(visit.begins | (visit.people == HIDDEN)).tolist():
            state = "tracked" if visit.begins[row] else "gone"
            self._texts[path].append((visit.times[row], state, "INFO"))

    def _lane(self, path: str, style: Line, kind: str) -> None:
        self._lane_styles[path], self.lanes[path] = style, kind

    def event(self, event: Event, log_time: int | None = None) -> None:
        """Write an event into the log; its time is also its log time unless that is known."""
        level = "WARN" if event.is_warning else "INFO"
        times = np.array([event.stamp, event.stamp if log_time is None else log_time])
        self._texts[f"{self.prefix}/log"].append((times, self.layer.named(event.text), level))

    def distances(self, name: str, times: Stamps, millimetres: Floats) -> None:
        """Add to the curve of joint distances between two logs, mm; times (T, 2)."""
        line = Line(name, DISTANCES[name])
        self._extend(f"/distance/{path_part(name)}", [line], times, millimetres)

    def _extend_camera(self, kind: str, camera: str, times: Stamps, values: Floats) -> None:
        line = Line(camera, curve_colour(self.cameras.index(camera)))
        self._extend(f"{kind}/{path_part(camera)}", [line], times, values)

    def finish(self) -> None:
        """Hide everybody after the last frame, and send what is left."""
        n, none = self.model.n_markers, np.zeros(0, np.int64)
        nobody = Poses(none.reshape(0, 2), none, none, np.zeros((0, n, 3)), np.zeros((0, n)))
        for number, (camera, crowd) in enumerate(self._crowds.items()):
            if len(times := crowd.finish()):
                self._entities.detections(camera, number, nobody, (times, np.zeros(1, np.int64)))
        self._compare(self._waiting.rest())
        for name, visits in self._stages.items():
            for visit in visits.finish():
                self._send_visit(name, visit, nobody)
        for image in self.images:
            image.finish(self.start or 0)
        self._send_texts()

    def _send_texts(self) -> None:
        for path, rows in self._texts.items():
            if rows:
                if path in self._lane_styles:
                    self._entities.lane(path, rows, self._lane_styles[path])
                else:
                    self._entities.log_lines(path, rows)
                rows.clear()

    # -- what is derived of the last stage -------------------------------------------------------

    def _extend_bounds(self, positions: Floats) -> None:
        """Note where people (P, M, 3), m, are, for the eye that is to look at them."""
        some = positions[::10]
        boxes = np.stack([np.fmin.reduce(some, axis=1), np.fmax.reduce(some, axis=1)], axis=1)
        self.bounds += list(boxes[~np.isnan(boxes).any(axis=(1, 2))])
        if len(self.bounds) > _MOST_BOUNDS:
            self.bounds = self.bounds[::2]

    def _before(self) -> tuple[str, ...]:
        """Return the stages whose frames have the result's times: those between both ends."""
        return STAGES[1 : max(STAGES.index(self.final), 1)] if self.final in STAGES else ()

    def _show_displacements(self, visit: Visit, shown: Flags, poses: Floats) -> None:
        """Draw how far the result, ``poses`` (K, M, 3) of the rows shown, is from each stage."""
        person, times = visit.person, visit.times
        result = np.full((len(times), self.model.n_markers, 3), np.nan)
        result[shown] = poses
        drawn = [stage for stage in self._before() if stage in self._stages]
        for stage in drawn:
            before = self._earlier[stage, person].at(times[:, 0], self.model.n_markers)
            path = f"{stage}/{person_part(person)}"
            if stage == drawn[0]:
                whole = f"{self.prefix}/displacement/{path}"
                tips = result + magnified(before - result)
                self._entities.joint_lines(whole, times, (result, tips), is_error=False)
            metres = apart(before, result)
            if (metres > 0).any():
                self.moved.add(stage)
            self._extend_apart(f"moved/{path}", person, times, metres)
        if self.truth is not None:
            true = self._earlier["truth", person].at(times[:, 0], self.model.n_markers)
            part = person_part(person)
            whole = f"{self.prefix}/error_lines/{part}"
            self._entities.joint_lines(whole, times, (result, true), is_error=True)
            self._extend_apart(f"error/{part}", person, times, apart(result, true))

    def _extend_apart(self, path: str, person: int, times: Stamps, metres: Floats) -> None:
        """Add to a person's curve of distances, mm; NaN is left out."""
        present = ~np.isnan(metres)
        lines = [self._person_line(person)]
        self._extend(f"{self.prefix}/{path}", lines, times[present], 1000 * metres[present])

    def _person_line(self, person: int) -> Line:
        """Return the curve of a person, in its colour."""
        line = Line(self.layer.named(f"person {person}"), person_hue(person, self.layer))
        return line._replace(width=line.width * self._widening)

    @property
    def _widening(self) -> float:
        """How much wider curves of the first of several logs are: others would hide them."""
        return 2.5 if self.layer.name and not self.layer.number else 1.0

    def _side_lines(self, names: Sequence[str]) -> list[Line]:
        """Return curves of which the left ones are dim and thin, the right ones strong."""
        lines = []
        for name in names:
            side = split_side(name)[1]
            colour = SIDES[side]
            if self.layer.name:
                hue = person_hue(0, self.layer)
                colour = shade(hue) if side == "left" else hue
            width = 2.5 if side == "right" else 1.5
            lines.append(Line(self.layer.named(name), colour, width * self._widening))
        return lines

    def _extend_angles(self, person: int, times: Stamps, degrees: Floats) -> None:
        """Add to curves of angles (T, A); those of a joint's left and right share an entity."""
        path = f"{self.prefix}/angles/{person_part(person)}"
        parts = [split_side(name)[0] for name in MAIN_ANGLES]
        for part in dict.fromkeys(parts):
            columns = [k for k, side in enumerate(parts) if side == part]
            lines = self._side_lines([MAIN_ANGLES[k] for k in columns])
            self._extend(f"{path}/{part.replace(' ', '_')}", lines, times, degrees[:, columns])

    def _derive_curves(self, person: int, times: Stamps, poses: Floats) -> None:
        """Angles and speed of the last stage."""
        past = self._pasts[person]
        main = [ANGLE_NAMES.index(name) for name in MAIN_ANGLES]
        jumping = anatomical_angles(self.model, poses, unwrapped=False)[:, main]
        angles = past.angles(times, jumping, MOST_RAD[main])
        self._extend_angles(person, times, np.degrees(angles))
        moments, roots = past.continued(times, poses[:, self._roots].mean(axis=1))
        steps = np.diff(moments[:, 0])
        steady = (steps > 0) & (steps < GONE_NS)
        speeds = np.linalg.norm(np.diff(roots, axis=0), axis=-1)[steady] / (steps[steady] / 1e9)
        path = f"{self.prefix}/speed/{person_part(person)}"
        self._extend(path, [self._person_line(person)], moments[1:][steady], speeds)

    def _extend(self, path: str, lines: Sequence[Line], times: Stamps, values: Floats) -> None:
        """Add rows (T, 2) and (T,) or (T, len(lines)) to the curves of an entity."""
        if len(times):
            self._entities.curves(path, lines, *ended(times, values, self._curves.get(path)))
            self._curves[path] = times[-1]
        present = values[~np.isnan(values)]
        if present.size:
            kind = path.removeprefix(self.prefix).split("/")[1]
            # Outliers of angles are the detectors' and not to be seen; errors are.
            spread = [0.5, 99.5] if kind == "angles" else [0.0, 100.0]
            low, high = np.percentile(present, spread)
            past = self.ranges.get(kind, (low, high))
            self.ranges[kind] = min(past[0], float(low)), max(past[1], float(high))


@dataclass(slots=True)
class _Past:
    """Last row of a person's curves, from which the next rows go on."""

    _times: Stamps | None = None  # (2,) of the newest row
    _root: Floats | None = None  # (3,) m, in that row
    _angles: Floats | None = None  # (A,) joint angles, rad, each where it was last known

    def angles(self, times: Stamps, jumping: Floats, most: Floats) -> Floats:
        """Continue angles (T, A), at most (A,) rad, over jumps of 360 degrees but not pauses."""
        places, _ = after_pauses(times, self._times)
        runs = enumerate(np.split(jumping, places))
        parts = [continued(part, None if k else self._angles, most) for k, part in runs]
        newest = parts[-1][::-1]
        row = newest[(~np.isnan(newest)).argmax(axis=0), np.arange(newest.shape[1])]
        earlier = row if self._angles is None or len(parts) > 1 else self._angles
        self._angles = np.where(np.isnan(row), earlier, row)
        return np.concatenate(parts)

    def continued(self, times: Stamps, roots: Floats) -> tuple[Stamps, Floats]:
        """Return rows (T, 2) and places of the root (T, 3) with those before the first."""
        before, place, self._times, self._root = self._times, self._root, times[-1], roots[-1]
        if before is None or place is None:
            return times, roots
        return np.insert(times, 0, before, axis=0), np.insert(roots, 0, place, axis=0)


def magnified(ways: Floats) -> Floats:
    """Return vectors (..., 3), m, some times as long, but at most of the longest length drawn."""
    lengths = MAGNIFIED * np.linalg.norm(ways, axis=-1, keepdims=True)
    arrows: Floats = MAGNIFIED * ways * np.minimum(1.0, LONGEST_M / np.maximum(lengths, LONGEST_M))
    return arrows
