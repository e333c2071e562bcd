"""Poses and clocks found from the people in a log, against the true ones.

python benchmarks/calibration.py                accuracy, standard errors and time
python benchmarks/calibration.py hostile        scenes that must not give a wrong pose silently
python benchmarks/calibration.py evidence FILE FIRST LAST   evidence and errors of scenes, by seeds
python benchmarks/calibration.py limits FILE ...   what other limits of the verdicts would let pass
python benchmarks/calibration.py process [LOG ...]   what hiros process gains by refined poses
python benchmarks/calibration.py clocks         clocks wrong by up to 100 ms in hiros process
python benchmarks/calibration.py LOG ...        real logs without their transforms: halves
python benchmarks/calibration.py consistency LOG ...   one camera left out: recorded and found poses

``--detector ideal``: each joint errs by itself.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from scenes import Scene, late, params_of, simulated, use_detector, write_scene, wrong_stamps

from hiros_mcap.body.rotations import Rigid, angle
from hiros_mcap.body.symmetry import symmetry_of
from hiros_mcap.calibrate import verdict
from hiros_mcap.calibrate.calibration_files import save_cameras
from hiros_mcap.calibrate.people import PeopleCalibration, calibrate_people
from hiros_mcap.calibrate.registration import kabsch
from hiros_mcap.errors import ConfigError, LogError
from hiros_mcap.evaluate.leave_one_out import leave_one_out
from hiros_mcap.io.log import open_log
from hiros_mcap.running.pipeline import ProcessOptions, process
from hiros_mcap.running.process_options import Calibration
from hiros_mcap.running.summary import Summary
from hiros_mcap.simulate import simulate
from hiros_mcap.skeletons import Frame

WRONG_DEG, WRONG_M, WRONG_S = 3.0, 0.15, 0.1
"""A pose or clock that is further off and passes for good is silently wrong."""


def calibrated(scene: Scene) -> tuple[PeopleCalibration, float]:
    """Calibrate a scene, and return how long it took, s."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.mcap"
        scene.write(path)
        start = time.perf_counter()
        with open_log(path) as log:
            found = calibrate_people(log)
        return found, time.perf_counter() - start


@dataclass(frozen=True)
class Error:
    """Of one camera in the frame and time of another."""

    degrees: float
    metres: float
    seconds: float
    claimed: tuple[float, float, float]
    """Standard errors of the same; NaN between cameras of which none is the first."""


def errors_of(scene: Scene, found: PeopleCalibration) -> Iterator[Error]:
    """Yield the errors of all pairs of cameras with a pose."""
    known = [c for c in found.cameras if c.pose is not None and c.verdict != "impossible"]
    for i, one in enumerate(known):
        for other in known[i + 1 :]:
            got = one.pose.inverse() @ other.pose
            true = scene.poses[one.name].inverse() @ scene.poses[other.name]
            lag = other.clock_s - one.clock_s
            wanted = scene.clocks[one.name] - scene.clocks[other.name]
            first = i == 0
            clocks = np.nan_to_num([one.error_ms, other.error_ms]) / 1000
            claimed = (other.error_deg, other.error_mm / 1000, float(np.hypot(*clocks)))
            yield Error(
                float(np.degrees(angle(got.xyzw, true.xyzw))),
                float(np.linalg.norm(got.translation - true.translation)),
                abs(lag - wanted),
                claimed if first else (np.nan,) * 3,
            )


def accuracy(name: str, seeds: Sequence[int], **params: object) -> None:
    """Print the errors, what was claimed, and the time of some scenes of one kind."""
    rows, seconds, verdicts = [], [], []
    for seed in seeds:
        scene = simulated(seed, **params)
        found, took = calibrated(scene)
        rows.append(list(errors_of(scene, found)))
        seconds.append(took)
        verdicts.append(found.verdict)
    every = [error for row in rows for error in row]
    if not every:
        print(f"{name:34} nothing found: {verdicts}")
        return
    table = np.array([(e.degrees, 100 * e.metres, 1000 * e.seconds) for e in every])
    claims = np.array([e.claimed for e in every]) * [1, 100, 1000]
    within = [
        np.mean(table[~np.isnan(claims[:, k]), k] <= 2 * claims[~np.isnan(claims[:, k]), k])
        for k in range(3)
    ]
    median, worst = np.nanmedian(table, axis=0), np.nanmax(table, axis=0)
    print(
        f"{name:34} median {median[0]:.2f} deg {median[1]:.1f} cm {median[2]:.1f} ms  "
        f"worst {worst[0]:.2f} {worst[1]:.1f} {worst[2]:.1f}  within 2 SE "
        f"{within[0]:.0%} {within[1]:.0%} {within[2]:.0%}  {np.median(seconds):.1f} s  "
        f"{ {v: verdicts.count(v) for v in sorted(set(verdicts))} }",
        flush=True,
    )


# -- scenes that do not determine the poses ----------------------------------------------------


def frozen(seed: int, people: int = 1) -> Scene:
    """People who never move: each camera repeats what it saw first, with noise."""
    scene = simulated(seed, people=people, cameras=2, seconds=12.0, shift=0.3)
    rng = np.random.default_rng(seed)
    first: dict[str, Frame] = {}
    frames = []
    for frame in scene.frames:
        if frame.n_people == people:
            still = first.setdefault(frame.source, frame)
            markers = still.markers.copy()
            markers[:, :, :3] += rng.normal(0, 0.007, markers[:, :, :3].shape)
            frames.append(frame.replace(markers=markers))
    return replace(scene, frames=frames)


def only(seed: int, joints: Sequence[int], *, still: bool = False) -> Scene:
    """People of whom a few joints are known."""
    scene = frozen(seed) if still else simulated(seed, people=1, cameras=2, seconds=12.0)
    frames = []
    for frame in scene.frames:
        markers = np.full_like(frame.markers, np.nan)
        markers[:, joints] = frame.markers[:, joints]
        frames.append(frame.replace(markers=markers))
    return replace(scene, frames=frames)


def disjoint(seed: int) -> Scene:
    """Cameras that see the person one after the other."""
    scene = simulated(seed, people=1, cameras=2, seconds=20.0, shift=0.0)
    half = np.median([frame.stamp for frame in scene.frames])
    early = {name: k == 0 for k, name in enumerate(scene.poses)}
    return replace(scene, frames=[f for f in scene.frames if (f.stamp < half) == early[f.source]])


def strangers(seed: int, **params: object) -> Scene:
    """Another person in each camera, who moves at the same time."""
    scenes = [
        simulated(s, people=1, cameras=2, seconds=12.0, shift=0.0, **params)
        for s in (seed, seed + 500)
    ]
    one, other = scenes[0].poses.keys()
    frames = [f for f in scenes[0].frames if f.source == one]
    frames += [f for f in scenes[1].frames if f.source == other]
    return replace(scenes[0], frames=frames)


def phases(seed: int, **params: object) -> Scene:
    """The same person in both cameras, but 7 s later in one of them."""
    scene = simulated(seed, people=1, cameras=2, seconds=24.0, shift=0.0, **params)
    one, other = scene.poses.keys()
    frames = [f if f.source == one else late(f, -7.0) for f in scene.frames]
    start = min(f.stamp for f in frames if f.source == one)
    frames = [f for f in frames if 0 <= (f.stamp - start) / 1e9 <= 14.0]
    return replace(scene, frames=frames, clocks={one: 0.0, other: -7.0})


def swapped(seed: int, action: str) -> Scene:
    """Two people, of whom each camera sees only one, and not the same."""
    scene = simulated(seed, people=2, cameras=2, seconds=12.0, shift=0.0, action=action)
    simulation = simulate(params_of(seed, people=2, cameras=2, seconds=12.0, action=action))
    truth = list(simulation.truth)
    starts = truth[0].stamp
    frames = []
    for frame in scene.frames:
        camera = next(c for c in simulation.cameras if c.name == frame.source)
        true = truth[min(len(truth) - 1, max(0, round((frame.stamp - starts) / 1e9 * 30)))]
        wanted = camera.points(true.positions[camera.index]).mean(axis=0)
        middles = np.nanmean(frame.positions, axis=1)
        away = np.linalg.norm(middles - wanted, axis=1)
        if len(away) and away.min() < 0.3:
            frames.append(frame.select([int(away.argmin())]))
    return replace(scene, frames=frames)


def lone(seed: int) -> Scene:
    """One camera."""
    return simulated(seed, people=1, cameras=1, seconds=8.0)


def mirrored(seed: int, *, swap: bool, **params: object) -> Scene:
    """One of two cameras sees everybody in a mirror: no pose is right."""
    scene = simulated(seed, **{"people": 1, "cameras": 2, "seconds": 12.0, "shift": 0.0, **params})
    _, other = scene.poses
    order = symmetry_of(scene.model).mirror if swap else slice(None)
    frames = []
    for frame in scene.frames:
        if frame.source == other:
            markers = frame.markers[:, order].copy()
            markers[:, :, 0] *= -1.0
            confidences = np.ascontiguousarray(frame.marker_confidences[:, order])
            frame = frame.replace(markers=markers, marker_confidences=confidences)
        frames.append(frame)
    nowhere = Rigid(np.array([0.0, 0.0, 0.0, 1.0]), np.full(3, 1e3))
    return replace(scene, frames=frames, poses={**scene.poses, other: nowhere})


IN_PLACE = (
    "sit",
    "squat",
    "bend",
    "lunge",
    "free_dynamic",
    "free_static",
    "cross_arms",
    "wave",
    "throw",
    "hands_up_down",
)
EQUAL: Mapping[str, object] = {"heights": (1.75, 1.75), "proportions": 0.0}
MIRRORED = ("walk", "squat", "sit", "bend", "free_dynamic", "lunge", "throw", "wave", "eight")
EQUALS = ("walk", "jog", "squat", "sit", "bend", "free_dynamic", "lunge", "free_static")

HOSTILE: Mapping[str, Callable[[int], Scene]] = {
    "a person who never moves": frozen,
    "two people who never move": partial(frozen, people=2),
    "one camera": lone,
    "one camera after the other": disjoint,
    "two joints only": partial(only, joints=(0, 3)),
    "joints on a line, still": partial(only, joints=(0, 1, 2, 3, 26), still=True),
    "another walker in each camera": strangers,
    "another jogger in each camera": partial(strangers, action="jog"),
    "another squatter in each camera": partial(strangers, action="squat"),
    "the same walk, 7 s later": phases,
    "the same squats, 7 s later": partial(phases, action="squat"),
    "each camera sees another of two walkers": partial(swapped, action="walk"),
    "each camera sees another of two who pass": partial(swapped, action="cross"),
    "each camera sees another of two who circle": partial(swapped, action="circle"),
    "each camera sees another of two who sit": partial(swapped, action="sit"),
    "each camera sees another of two who squat": partial(swapped, action="squat"),
    "the same sitting down, 7 s later": partial(phases, action="sit"),
    **{f"strangers of equal size, {a}": partial(strangers, action=a, **EQUAL) for a in EQUALS},
    **{f"in a mirror, {a}": partial(mirrored, swap=True, action=a) for a in MIRRORED},
    "two people in a mirror": partial(mirrored, swap=False, people=2),
    "in a mirror, squat, sides kept": partial(mirrored, swap=False, action="squat"),
    "in a mirror, wave, sides kept": partial(mirrored, swap=False, action="wave"),
}


def usual(seed: int, **params: object) -> Scene:
    """10 to 40 s before two or three cameras, with better and worse detectors."""
    rng = np.random.default_rng([seed, 7])
    seconds, cameras = float(rng.uniform(10.0, 40.0)), int(rng.integers(2, 4))
    shift, bias = float(rng.choice([0.0, 0.02])), float(rng.choice([0.009, 0.02]))
    params = {"people": 1, "seconds": seconds, "cameras": cameras, **params}
    detector = {"bias": bias, "joint": bias}
    return simulated(seed, shift=shift, **params, detector=detector)


IN_PLACES: Mapping[str, Callable[[int], Scene]] = {
    **{f"in place: {a}": partial(usual, action=a) for a in IN_PLACE},
    "in place: two sit": partial(usual, people=2, action="sit"),
}
MOVING: Mapping[str, Callable[[int], Scene]] = {
    "walk": partial(usual, action="walk"),
    "eight": partial(usual, action="eight"),
    "two pass": partial(usual, people=2, action="cross"),
}


def hostile(seeds: Sequence[int]) -> None:
    """Count the verdicts, and the wrong poses among those that pass for good."""
    total = wrong = 0
    for name, make in HOSTILE.items():
        verdicts: list[str] = []
        silent = 0
        for seed in seeds:
            scene = make(seed)
            try:
                found, _ = calibrated(scene)
            except LogError:
                verdicts.append("refused")
                continue
            verdicts.append(found.verdict)
            sure = tuple(c for c in found.cameras if c.verdict in verdict.SURE)
            passed = replace(found, cameras=sure)
            bad = [e for e in errors_of(scene, passed) if is_wrong(e)]
            silent += bool(bad)
            for e in bad[:1]:
                print(
                    f"  seed {seed}: {e.degrees:.1f} deg {100 * e.metres:.0f} cm {e.seconds:.2f} s"
                )
        total, wrong = total + len(verdicts), wrong + silent
        counts = {v: verdicts.count(v) for v in sorted(set(verdicts))}
        print(f"{name:42} {counts}  silently wrong: {silent}", flush=True)
    print(f"{total} scenes, {wrong} silently wrong")


def is_wrong(error: Error) -> bool:
    """Whether an error is one of principle; no clock (NaN) is not."""
    return error.degrees > WRONG_DEG or error.metres > WRONG_M or error.seconds > WRONG_S


# -- limits of the verdicts --------------------------------------------------------------------


def gather(path: Path, seeds: Sequence[int]) -> None:
    """Append evidence and errors of all kinds of scenes to a file, a line of JSON for each."""
    groups = {"hostile": HOSTILE, "in place": IN_PLACES, "moving": MOVING}
    for seed in seeds:
        for group, kinds in groups.items():
            for kind, make in kinds.items():
                scene, row = make(seed), {"group": group, "kind": kind, "seed": seed}
                try:
                    found, _ = calibrated(scene)
                except LogError as error:
                    row["refused"] = str(error)
                else:
                    posed = [c for c in found.cameras if c.pose is not None]
                    row["cameras"] = {c.name: asdict(c.evidence) for c in posed}
                    row["reasons"] = {c.name: c.reason for c in found.cameras}
                    row["verdicts"] = {c.name: c.verdict for c in found.cameras}
                    row["people_mm"] = found.people_mm
                    everyone = replace(
                        found, cameras=tuple(replace(c, verdict="good") for c in posed)
                    )
                    row["errors"] = [asdict(e) for e in errors_of(scene, everyone)]
                    row["pairs"] = [[a.name, b.name] for a, b in combinations(posed, 2)]
                with path.open("a") as file:
                    print(json.dumps(row), file=file)


def limits(paths: Sequence[Path]) -> None:
    """Print what passes with the limits of today, and with others."""
    rows = [json.loads(line) for path in paths for line in path.read_text().splitlines()]
    usable = verdict.USABLE
    print(
        f"{'limits':38} rigs of people in place, who move; worst deg, cm; within 2 SE; hostile "
        "scenes: passed, wrong"
    )
    report("good", verdict.GOOD, rows)
    report("usable", usable, rows)
    report("acceptable", verdict.ACCEPTABLE, rows)
    for name, values in CANDIDATES.items():
        for value in values:
            report(f"usable, {name} {value:g}", usable._replace(**{name: value}), rows)


CANDIDATES: Mapping[str, Sequence[float]] = {
    "error_deg": (0.7, 1.0, 1.5, 3.0),
    "size": (0.01, 0.02, 0.045, 0.06),
    "wander": (0.033, 0.055, 0.065),
    "spread": (0.25, 0.2, 0.12, 0.0),
    "seconds": (3.0, 8.0),
}


def report(name: str, some: verdict.Limits, rows: Sequence[Mapping[str, Any]]) -> None:
    """Print what passes with some limits."""
    counts, errors, silent = {}, [], []
    for group in ("in place", "moving", "hostile"):
        own = [row for row in rows if row["group"] == group]
        passed = []
        for row in own:
            evidence = {n: verdict.Evidence(**e) for n, e in row.get("cameras", {}).items()}
            sure = {n for n, e in evidence.items() if not verdict.weakness_of(e, some)}
            pairs = zip(row.get("pairs", []), row.get("errors", []), strict=True)
            some_errors = [Error(**error) for pair, error in pairs if set(pair) <= sure]
            if some_errors and (group == "hostile" or len(sure) == len(row["reasons"])):
                passed.append(row)
                errors += [] if group == "hostile" else some_errors
                silent += [(row["kind"], row["seed"])] * any(map(is_wrong, some_errors))
        counts[group] = f"{len(passed)} of {len(own)}"
    table = np.array([(e.degrees, e.metres, *e.claimed[:2]) for e in errors] or [[np.nan] * 4])
    known = table[~np.isnan(table[:, 2])]
    within = np.mean(known[:, :2] <= 2.0 * known[:, 2:], axis=0)
    worst = table.max(axis=0)
    print(
        f"{name:38} {counts['in place']:>10} {counts['moving']:>10}; {worst[0]:5.2f} "
        f"{100 * worst[1]:5.1f}; {within[0]:.0%} {within[1]:.0%}; {counts['hostile']}, "
        f"{len(silent)} wrong {silent[:3] or ''}",
        flush=True,
    )


# -- real logs ---------------------------------------------------------------------------------


def halves(path: Path) -> None:
    """Compare the poses found in each half of a log, without its transforms."""
    with open_log(path) as log:
        frames, model = list(log.frames()), log.model
    middle = float(np.median([frame.log_time for frame in frames]))
    parts = [
        Scene(model, [f for f in frames if (f.log_time < middle) == early], {}, {})
        for early in (True, False)
    ]
    first, second = (calibrated(part)[0] for part in parts)
    lines = []
    for one, other, a, b in zip(
        first.cameras, first.cameras[1:], second.cameras, second.cameras[1:], strict=False
    ):
        if None in (one.pose, other.pose, a.pose, b.pose):
            lines.append(f"{other.name} not found")
            continue
        early, late_ = one.pose.inverse() @ other.pose, a.pose.inverse() @ b.pose
        lines.append(
            f"{np.degrees(angle(early.xyzw, late_.xyzw)):.2f} deg "
            f"{100 * np.linalg.norm(early.translation - late_.translation):.1f} cm "
            f"{1000 * abs(other.clock_s - one.clock_s - b.clock_s + a.clock_s):.0f} ms"
        )
    print(f"{path.name:46} {first.verdict}/{second.verdict}: {'; '.join(lines)}", flush=True)


def consistency(path: Path) -> None:
    """Leave one camera out: with the recorded poses, and with those found without them."""
    with open_log(path) as log:
        frames, model = list(log.frames()), log.model
    found, _ = calibrated(Scene(model, frames, {}, {}))
    with tempfile.TemporaryDirectory() as folder:
        cameras = Path(folder) / "cameras.toml"
        save_cameras(cameras, found)
        options = [ProcessOptions(calibrate="off"), ProcessOptions(extrinsics=cameras)]
        cells = []
        for one in options:
            try:
                scores = leave_one_out(path, options=one)
            except (LogError, ConfigError) as error:
                cells.append(f"{error}")
                continue
            errors = [f"{camera.distance.median:.0f}" for camera in scores.cameras]
            cells.append(f"left out {' '.join(errors)} mm")
    print(
        f"{path.name:46} {found.verdict}\n  recorded: {cells[0]}\n  found:    {cells[1]}",
        flush=True,
    )


# -- refined poses before a run ----------------------------------------------------------------

RIGS: Mapping[str, Mapping[str, float]] = {
    "true poses": {"orientation_error": 0.0, "position_error": 0.0},
    "as published": {},
    "1 degree": {"orientation_error": 1.0 / 3**0.5, "position_error": 0.0},
    "2 degrees, 5 cm": {"orientation_error": 2.0 / 3**0.5, "position_error": 0.05 / 3**0.5},
}
"""SD per axis of the published poses."""


def joint_errors(result: Path, truth: Path, late_s: float = 0.0) -> tuple[float, float]:
    """Mean joint error, mm, plain and after one rigid fit of the whole result to the truth.

    ``late_s`` is by how much the result's stamps are late against the truth's, s.
    """
    with open_log(truth, topics=["/truth/*"], output_prefix="/none") as log:
        true, wanted = list(log.frames()), log.model.marker_names
    with open_log(result, topics=["/hiros/filtered"], output_prefix="/none") as log:
        found, names = list(log.frames()), log.model.marker_names
    order = [names.index(name) for name in wanted]
    stamps = np.array([frame.stamp for frame in found]) - round(1e9 * late_s)
    pairs = []
    for frame in true:
        k = int(np.searchsorted(stamps, frame.stamp))
        if not 0 < k < len(stamps):
            continue
        before, after = found[k - 1], found[k]
        share = (frame.stamp - stamps[k - 1]) / (stamps[k] - stamps[k - 1])
        rows = {person: row for row, person in before.tracked()}
        some = [
            (1 - share) * before.positions[rows[person]] + share * after.positions[row]
            for row, person in after.tracked()
            if person in rows
        ]
        for pose in frame.positions if some else ():
            nearest = min(some, key=lambda one: float(np.nanmean(np.abs(one[order] - pose))))
            if np.nanmean(np.abs(nearest[order] - pose)) < 0.2:
                pairs.append(np.stack([nearest[order], pose]))
    got, right = np.concatenate(pairs, axis=1)
    known = ~np.isnan(got + right).any(axis=1)
    got, right = got[known], right[known]
    turn, shift = kabsch(got, right)
    aligned = got @ turn.T + shift - right
    return tuple(1000 * float(np.linalg.norm(e, axis=1).mean()) for e in (got - right, aligned))


def run_errors(log: Path, truth: Path, mode: Calibration) -> tuple[float, float, float, Summary]:
    """Errors of a run, see :func:`joint_errors`, its CPU time, s, and its summary."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out.mcap"
        start = time.process_time()
        summary = process(log, out, options=ProcessOptions(calibrate=mode))
        took = time.process_time() - start
        return *joint_errors(out, truth), took, summary


def refined(name: str, log: Path, truth: Path) -> None:
    """Print what the refinement changes for one log."""
    off, auto = (run_errors(log, truth, mode) for mode in ("off", "auto"))
    verdicts = [camera.verdict for camera in auto[3].poses]
    counts = {v: verdicts.count(v) for v in sorted(set(verdicts))}
    print(
        f"{name:40} {off[0]:6.1f} {auto[0]:6.1f} mm ({auto[0] / off[0] - 1:+.0%})  aligned "
        f"{off[1]:5.1f} {auto[1]:5.1f}  CPU {off[2]:.2f} {auto[2]:.2f} s  {counts}",
        flush=True,
    )


def refine_before_runs(logs: Sequence[Path]) -> None:
    """Print the joint errors without and with refined poses: given logs, or simulated ones."""
    print(f"{'':40}    off   auto")
    for log in logs:
        truth = log.with_suffix(".truth.mcap")
        refined(log.stem, log, truth if truth.exists() else log)
    scenes = () if logs else ((11, 1, 3, "walk"), (12, 2, 5, "walk"), (13, 3, 4, "eight"))
    for seed, people, cameras, action in scenes:
        for name, rig in RIGS.items():
            params = {"seed": seed, "people": people, "cameras": cameras, "action": action}
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder) / "log.mcap"
                write_scene(path, **params, seconds=20.0, rig=rig)
                refined(f"{people} people, {cameras} cameras, {name}", path, path)


def wrong_clocks(seed: int, **params: object) -> None:
    """Print what hiros process makes of clocks that are wrong by up to 100 ms.

    The offset that all clocks share cannot be told from a delay of the detectors. So the error of
    each clock is stated against the median one, and the joint error after that shift, too.
    """
    scene = simulated(seed, shift=0.0, **params)
    wrong = wrong_stamps(scene, seed)
    clocks = wrong.clocks
    with tempfile.TemporaryDirectory() as folder:
        truth, log, out = (Path(folder) / f"{name}.mcap" for name in ("truth", "log", "out"))
        write_scene(truth, seed, **params)
        scene.write(log, transforms=True)
        process(log, out)
        healthy = joint_errors(out, truth)[0]
        wrong.write(log, transforms=True)
        summary = process(log, out, force=True)
        found = dict.fromkeys(clocks, 0.0)
        for camera in summary.cameras:
            faults = (fault for fault in camera.clock if fault.corrected)
            found[camera.name] = sum(fault.seconds for fault in faults)
        left = {name: clocks[name] - found[name] for name in clocks}
        common = float(np.median(list(left.values())))
        off, shifted = (joint_errors(out, truth, s)[0] for s in (0.0, common))
    errors = ", ".join(f"{1000 * (s - common):+.1f}" for s in left.values())
    print(
        f"{params}: healthy {healthy:.1f} mm; as stamped {off:.1f} mm; shifted by the common "
        f"{1000 * common:+.0f} ms {shifted:.1f} mm ({shifted / healthy - 1:+.1%}); clocks against "
        f"the median: {errors} ms",
        flush=True,
    )


def main() -> None:
    arguments = use_detector(sys.argv[1:])
    if arguments == ["clocks"]:
        for seed, people, cameras in ((41, 1, 3), (42, 2, 3), (43, 2, 5)):
            wrong_clocks(seed, people=people, cameras=cameras, seconds=20.0)
        return
    if arguments[:1] == ["process"]:
        refine_before_runs([Path(each) for each in arguments[1:]])
        return
    if arguments[:1] == ["consistency"]:
        for path in arguments[1:]:
            consistency(Path(path))
        return
    if arguments[:1] == ["evidence"]:
        gather(Path(arguments[1]), range(*map(int, arguments[2:])))
        return
    if arguments[:1] == ["limits"]:
        limits([Path(each) for each in arguments[1:]])
        return
    if arguments == ["hostile"]:
        hostile(range(8))
        return
    if arguments:
        for path in arguments:
            halves(Path(path))
        return
    accuracy("2 people, 5 cameras, 30 s", range(5), people=2, cameras=5, seconds=30.0)
    accuracy("1 walker, 2 cameras, 10 s", range(20), people=1, cameras=2, seconds=10.0)
    accuracy("with many flips", range(20), people=1, cameras=2, seconds=10.0, flips=20.0)
    accuracy("4 people, 5 cameras, 15 s", range(3), people=4, cameras=5, seconds=15.0)
    accuracy(
        "2 who pass, 3 cameras, 15 s", range(5), people=2, cameras=3, seconds=15.0, action="cross"
    )
    accuracy("1 walker, 5 cameras, 30 s", range(3), people=1, cameras=5, seconds=30.0)


if __name__ == "__main__":
    main()
