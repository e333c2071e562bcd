"""Postures that no body takes: the angle ranges of everybody in some logs, and where they are left.

    python benchmarks/postures.py [--system NAME ...] [--ranges] LOG [LOG ...]

Every log is processed, and judged by the angles that ``hiros export`` writes. A case is a time
longer than 0.1 s in which an angle of a person is outside what a body can do (``LIMITS``), or in
which somebody who stands has both feet 0.25 m above the floor. ``--ranges`` prints the least and
the greatest angle of everybody.

The plane and the rotation of an arm, and the flexion of one that is lifted sideways, are singular
and not judged. The floor is where the lower foot of everybody is for most of the time.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hiros_mcap.body.anatomy import ANGLE_NAMES, anatomical_angles
from hiros_mcap.body.symmetry import split_side
from hiros_mcap.config import load_config
from hiros_mcap.defaults import LEAST_CONFIDENCE
from hiros_mcap.io.result import Motion, Result, open_result
from hiros_mcap.running.pipeline import ProcessOptions, process
from hiros_mcap.skeletons import Flags, Floats, SkeletonModel

SYSTEMS = ("fuse", "fuse-realtime", "hiros", "hiros-realtime")
LIMITS = {
    "hip flexion": (-35.0, 140.0),
    "knee flexion": (-10.0, 155.0),
    "elbow flexion": (-10.0, 160.0),
    "neck flexion": (-80.0, 80.0),
    "neck side bend": (-80.0, 80.0),
    "shoulder flexion": (-75.0, 190.0),
}
"""Degrees: the ends of what textbooks of joint measurement give, and what markers add."""
SHORTEST = 0.1  # s
SIDEWAYS = 60.0  # degrees; the flexion of an arm that is lifted farther sideways is not judged
STANDS, FLOATS = 0.7, 0.25  # m above the floor: the pelvis of who stands, and feet that float
_FEET, _PELVIS = ("ankle", "foot"), ("pelvis", "spinebase", "midhip", "hips")


class Case(NamedTuple):
    """A time in which somebody has a posture that no body takes."""

    person: int
    what: str
    begin: float  # s
    end: float
    extreme: float  # degrees or m
    sure: float  # greatest of the least confidences of the person's joints there


def angles_of(model: SkeletonModel, motion: Motion) -> dict[str, Floats]:
    """Angle -> its course, degrees, from the lower limit less 90 on."""
    angles = anatomical_angles(
        model, motion.positions, motion.orientations, motion.axes, unwrapped=False
    )
    table = dict(zip(ANGLE_NAMES, np.degrees(angles).T, strict=True))
    courses = {}
    for name, course in table.items():
        limits = next((pair for part, pair in LIMITS.items() if name.endswith(part)), None)
        if limits is None:
            continue
        middle = sum(limits) / 2
        course = (course - middle + 180) % 360 - 180 + middle
        if name.endswith("shoulder flexion"):
            away = table[name.replace("flexion", "abduction")]
            course = np.where(np.abs(away) < SIDEWAYS, course, np.nan)
        courses[name] = course
    return courses


def feet_and_pelvis(model: SkeletonModel, motion: Motion) -> tuple[Floats, Floats]:
    """Height of the lower foot, and of the pelvis, m."""
    names = [split_side(name)[0] for name in model.marker_names]
    feet = [k for k, name in enumerate(names) if name in _FEET]
    pelvis = [k for k, name in enumerate(names) if name in _PELVIS][:1]
    heights = motion.positions[:, :, 2]
    lowest = np.nanmin(np.pad(heights[:, feet], ((0, 0), (0, 1)), constant_values=np.inf), axis=1)
    return np.where(np.isinf(lowest), np.nan, lowest), heights[:, pelvis[0]]


def cases_of(result: Result) -> Iterator[Case]:
    """Yield the cases of a result."""
    model = result.model
    motions = result.trusted(LEAST_CONFIDENCE).motions
    heights = {person: feet_and_pelvis(model, motion) for person, motion in motions.items()}
    floor = np.nanpercentile(np.concatenate([feet for feet, _ in heights.values()]), 25)
    for person, motion in motions.items():
        for name, course in angles_of(model, motion).items():
            low, high = next(pair for part, pair in LIMITS.items() if name.endswith(part))
            beyond = np.maximum(low - course, course - high)
            yield from _times(person, name, motion, course, beyond)
        feet, pelvis = heights[person]
        above = np.where(pelvis > floor + STANDS, feet - floor - FLOATS, np.nan)
        yield from _times(person, "feet above the floor", motion, feet - floor, above)


def _times(
    person: int, what: str, motion: Motion, course: Floats, beyond: Floats
) -> Iterator[Case]:
    """Yield the times in which ``beyond`` is above 0 for longer than SHORTEST."""
    out: Flags = beyond > 0
    edges = np.diff(np.concatenate([[0], out.astype(int), [0]]))
    interval = 1 / motion.rate if len(motion.times) > 1 else 0.0
    for a, b in zip(np.flatnonzero(edges > 0), np.flatnonzero(edges < 0), strict=True):
        begin, end = motion.times[a], motion.times[b - 1]
        if end - begin + interval > SHORTEST:
            worst = a + int(np.argmax(beyond[a:b]))
            sure = float(motion.confidences[a:b].min(axis=1).max())
            yield Case(person, what, begin, end + interval, float(course[worst]), sure)


def processed(log: Path, system: str) -> Result:
    """Return the result of a log."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out.mcap"
        config = load_config(None, (), system=system)
        process(log, out, config=config, options=ProcessOptions(system=system))
        return open_result(out)


def show_ranges(result: Result) -> None:
    """Print the least and the greatest angle of everybody."""
    for person, motion in result.trusted(LEAST_CONFIDENCE).motions.items():
        for name, course in angles_of(result.model, motion).items():
            print(
                f"    person {person} {name:22} {np.nanmin(course):6.0f} {np.nanmax(course):6.0f}"
            )


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("logs", nargs="+", type=Path, metavar="LOG")
    parser.add_argument("--system", action="append", metavar="NAME")
    parser.add_argument("--ranges", action="store_true")
    given = parser.parse_args()
    for system in given.system or SYSTEMS:
        total = 0
        for log in given.logs:
            result = processed(log, system)
            cases = list(cases_of(result))
            total += len(cases)
            print(
                f"{system} {log.stem}: people {len(result.motions)}, cases {len(cases)}", flush=True
            )
            for case in cases:
                print(
                    f"  person {case.person} {case.what:22} {case.begin:6.2f} to "
                    f"{case.end:6.2f} s, {case.extreme:7.2f}, confidence {case.sure:.2f}"
                )
            if given.ranges:
                show_ranges(result)
        print(f"{system}: {total} cases", flush=True)


if __name__ == "__main__":
    main()
