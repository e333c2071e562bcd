"""The gate: every station and policy of fuse off in turn. What does not pass here has no place.

    python benchmarks/stations.py                          simulated logs, realistic detector
    python benchmarks/stations.py LOG...                   these logs as well; LOG.truth.mcap is
                                                           the truth of LOG.mcap
    python benchmarks/stations.py --logs 0 LOG...          these logs alone
    python benchmarks/stations.py LOG --stations 'limb*' 'pose*' --first 900 --detector ideal

A station is switched off by a parameter. Prints Markdown tables, by kind of log: what is measured
with everything on, and by how much it grows with a station off, as mean over the logs and standard
error; counts are sums over the logs. "+" is worse. With a truth: mean and 99th percentile of the
joint error, mm, bending angles and orientations, degrees, ids of people, switches, false and
missing people, true joints within 95 % ellipsoids, %. Without: jitter, % (mm with all on), leaps
(a body's centre is faster than 3 m/s), ids, and how far a camera that is left out is from the
others, mm. Then CPU, s per log, and the lines of the modules that go with the station.

Six logs with two cameras have a standard error of .75 to 2.4 mm; one log says nothing. Real jitter
and leaps rank stations rightly, but not settings: those are chosen by a truth.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import json
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scenes import DETECTOR, realistic

import hiros_mcap
from hiros_mcap.config import Config, Table, load_config
from hiros_mcap.evaluate.leave_one_out import frames_of_cameras, leave_each_out
from hiros_mcap.evaluate.logs import consistency, find_truth
from hiros_mcap.evaluate.match import match
from hiros_mcap.evaluate.scores import coverage_of, score_matches
from hiros_mcap.evaluate.truth import Truth
from hiros_mcap.evaluate.truth_files import load_truth
from hiros_mcap.io.marker_uncertainty import deviations_of
from hiros_mcap.running.preparation import preparation_key
from hiros_mcap.running.process_options import ProcessOptions
from hiros_mcap.running.recording import Recording
from hiros_mcap.skeletons import Frame

LEAP = 3.0
"""m/s of a body's centre; nobody in the logs runs."""


class Station(NamedTuple):
    """A switch, and the modules that would go with it."""

    off: Table
    modules: tuple[str, ...] = ()


INF = float("inf")
STATIONS: Mapping[str, Station] = {
    "nothing": Station({}),
    "poses from people": Station({"input": {"poses": "given"}}),
    "moved cameras": Station(
        {"input": {"moved": False}}, ("calibrate/moved_cameras.py", "calibrate/camera_change.py")
    ),
    "clocks": Station(
        {"input": {"clocks": "off"}}, ("running/clock_alignment.py", "calibrate/coarse_clock.py")
    ),
    "re-identification": Station({"track": {"reidentify": 0.0}}, ("stages/track/reidentify.py",)),
    "copies, double tracks": Station(
        {"track": {"merge_tracks": False}},
        ("stages/track/displaced.py", "stages/track/likeness.py"),
    ),
    "what other cameras confirm": Station(
        {"track": {"confirm_alone": 0.0, "contradiction": INF}}, ("stages/track/support.py",)
    ),
    "jumps left out": Station({"track": {"max_jump": INF}}),
    "limbs of detections": Station(
        {"plausible": {"limbs": False}}, ("stages/detections/plausible.py",)
    ),
    "hidden joints": Station(
        {"plausible": {"behind_others": False}},
        (
            *("stages/detections/hidden.py", "stages/detections/hidden_joints.py"),
            "stages/detections/impossible_postures.py",
        ),
    ),
    "limbs and hidden joints": Station({"plausible": {"limbs": False, "behind_others": False}}),
    "sides over time": Station(
        {"sides": {"over_time": False}},
        tuple(
            f"stages/detections/{name}.py"
            for name in ("sides", "facing", "facing_evidence", "body_axes")
        ),
    ),
    "bridge and carry": Station(
        {"merge": {"bridge": 0.0, "carry": 0.0}},
        ("stages/merge/unseen.py", "stages/track/coverage.py"),
    ),
    "offsets of cameras": Station({"fuse": {"offset": 0.0}}),
    "outliers that last": Station({"fuse": {"outliers_last": 0.0}}, ("stages/fuse/outliers.py",)),
    "majority of cameras": Station({"fuse": {"majority": False}}, ("stages/fuse/majority.py",)),
    "pose prior": Station({"constrain": {"prior": False}}, ("stages/fuse/pose_prior.py",)),
    "rigid groups": Station({"constrain": {"rigid": False}}),
}
Numbers = Mapping[str, float]
COUNTS = ("ids", "switches", "false", "missing", "leaps")
DECIMALS = {
    "mean": 2, "99 %": 1, "angles": 2, "orientation": 2, "in 95 %": 1, "ids": 0, "switches": 0,
    "false": 0, "missing": 0, "jitter": 2, "leaps": 0, "left out": 2, "CPU": 2,
}  # fmt: skip


class Log(NamedTuple):
    """A log of the gate: a file, or what is to be simulated."""

    kind: str
    path: Path | None
    seed: int = 0
    scene: Mapping[str, Any] = {}


def simulated(count: int, first: int, detector: str) -> Iterator[Log]:
    """Yield ``count`` logs of two cameras, half as many of more, and a third of people who turn."""
    kind = {"detector": {"kind": detector}}
    for k in range(count):
        yield Log("simulated, 2 cameras", None, first + k, {**kind, "people": 2 + (k % 6 == 5)})
    for k in range(count // 2):
        around = {"apart": None if k % 2 else 60.0}
        more = {"cameras": 3 + k % 2, "people": 2 + k % 3, "rig": around}
        yield Log("simulated, 3 and 4 cameras", None, first + 100 + k, {**kind, **more})
    for k in range(count // 3):
        turning = {"action": "free_dynamic", "rig": {"apart": 90.0}}
        yield Log("simulated, people who turn", None, first + 200 + k, {**kind, **turning})


def measure(log: Log, stations: Mapping[str, Station]) -> tuple[str, dict[str, Numbers]]:
    """Run a log with each station off; return its kind and the numbers."""
    with tempfile.TemporaryDirectory() as folder:
        path = log.path or realistic(Path(folder) / "log.mcap", log.seed, **log.scene)
        beside = path.with_suffix(".truth.mcap")
        truth = load_truth(beside) if beside.exists() else find_truth(path)
        kind = log.kind if log.path is None else f"given, {'with' if truth else 'without'} truth"
        recordings: dict[object, tuple[Recording, float]] = {}
        found = {}
        for name, station in stations.items():
            config = load_config(system="fuse", named={name: station.off})
            options = ProcessOptions()
            key = preparation_key(config, options)
            if key not in recordings:
                start = time.process_time()
                recording = Recording.read(path, config, options)
                recording.head(100).run(config, options)
                recordings[key] = recording, time.process_time() - start
            recording, seconds = recordings[key]
            start = time.process_time()
            (frames,) = recording.run(config, options, last=True).values()
            seconds += time.process_time() - start
            scored = (
                against(frames, truth, recording) if truth else alone(frames, recording, config)
            )
            found[name] = {**scored, "CPU": seconds}
    return kind, found


def against(frames: Sequence[Frame], truth: Truth, recording: Recording) -> Numbers:
    """Score a result against the truth."""
    truth = truth.moved(start=recording.prepared.log.span[0]).seen_by(recording.model)
    matches = match(frames, truth)
    scores = score_matches(matches, truth, recording.model)
    held = coverage_of(matches, deviations_of(frames, recording.model), recording.model)
    return {
        "mean": scores.mean,
        "99 %": scores.percentile_99,
        "angles": scores.angle_rmse,
        "orientation": scores.orientation_error,
        "in 95 %": 100 * held.within_95 if held else np.nan,
        "ids": len(matches.tracks),
        "switches": scores.switches,
        "false": scores.false or 0,
        "missing": scores.missing,
        "jitter": scores.jitter,
        "leaps": leaps(frames),
    }


def alone(frames: Sequence[Frame], recording: Recording, config: Config) -> Numbers:
    """Score a result that has no truth."""
    result = consistency(frames, recording.model)
    left, _ = leave_each_out(recording, frames_of_cameras(recording), config, ProcessOptions())
    return {
        "jitter": result.jitter,
        "leaps": leaps(frames),
        "ids": result.n_people,
        "left out": float(np.mean([camera.distance.mean for camera in left])),
    }


def leaps(frames: Sequence[Frame]) -> int:
    """How often a body's centre moves faster than anybody."""
    last: dict[int, tuple[int, Any]] = {}
    count = 0
    for frame in frames:
        for row, person in frame.tracked():
            centre = np.nanmean(frame.positions[row], axis=0)
            stamp, before = last.get(person, (0, centre))
            seconds = (frame.stamp - stamp) * 1e-9
            count += 0 < seconds < 0.2 and float(np.linalg.norm(centre - before)) > LEAP * seconds
            last[person] = frame.stamp, centre
    return count


def main() -> None:
    parser = argparse.ArgumentParser(parents=[DETECTOR])
    parser.add_argument("logs", nargs="*", type=Path, metavar="LOG")
    parser.add_argument("--logs", dest="count", type=int, default=12, metavar="N")
    parser.add_argument("--first", type=int, default=1, metavar="SEED")
    parser.add_argument("--stations", nargs="+", default=["*"], metavar="GLOB")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the numbers of all logs")
    given = parser.parse_args()
    chosen = {
        name: station
        for name, station in STATIONS.items()
        if name == "nothing" or any(fnmatchcase(name, glob) for glob in given.stations)
    }
    logs = [*simulated(given.count, given.first, given.detector)]
    logs += [Log("", path) for path in given.logs]
    kinds: dict[str, list[dict[str, Numbers]]] = {}
    with ProcessPoolExecutor(2) as pool:
        for kind, numbers in pool.map(partial(measure, stations=chosen), logs):
            kinds.setdefault(kind, []).append(numbers)
            if given.json:
                given.json.write_text(json.dumps(kinds, indent=1) + "\n")
    for kind, found in kinds.items():
        print(f"\n{kind}: {len(found)} logs\n")
        for line in table(found, chosen):
            print(line)


def table(found: Sequence[Mapping[str, Numbers]], stations: Mapping[str, Station]) -> Iterator[str]:
    """Yield the lines of a table."""
    columns = list(found[0]["nothing"])
    yield f"| off | {' | '.join(columns)} | lines |"
    yield f"|{'---|' * (len(columns) + 2)}"
    for name, station in stations.items():
        cells = [cell(column, [log[name][column] for log in found],
                      [log["nothing"][column] for log in found], base=name == "nothing")
                 for column in columns]  # fmt: skip
        yield f"| {name} | {' | '.join(cells)} | {lines(station) or ''} |"


def cell(column: str, values: Sequence[float], base_values: Sequence[float], *, base: bool) -> str:
    """Return a number, or by how much it grows."""
    digits, now, before = DECIMALS[column], np.array(values), np.array(base_values)
    if column in COUNTS:
        return f"{before.sum():.0f}" if base else f"{now.sum() - before.sum():+.0f}"
    if base:
        return f"{np.nanmean(now):.{digits}f}"
    grown = 100 * (now / before - 1) if column == "jitter" else now - before
    error = np.nanstd(grown, ddof=1) / np.sqrt(len(grown)) if len(grown) > 1 else np.nan
    text = f"{np.nanmean(grown):+.{digits}f}"
    return text if column == "CPU" else f"{text} ({error:.{digits}f})"


def lines(station: Station) -> int:
    """Lines of the modules that go with a station."""
    root = Path(hiros_mcap.__file__).parent
    return sum(len((root / module).read_text().splitlines()) for module in station.modules)


if __name__ == "__main__":
    main()
