"""What detectors err by along the camera's ray and across it: on film, simulated, and real Kinects.

    PYTHONPATH=.:cli:schemas:viewer python benchmarks/depth_errors.py [--cache FOLDER] [LOG...]

- Film: world landmarks of MediaPipe against the near-truth of OpenPose (``film.py``), which itself
  errs by about 23 mm, and puts joints elsewhere: both are in the columns "across", too.
- Simulated: three realistic scenes of ``scenes.py`` for each kind of detector, 10 s, seeds from
  7300 on, against the truth.
- LOGs of real depth cameras have no truth. Two cameras tell what each errs by, if both err alike:
  the root of half of the variance at which they disagree. What both err by alike is not in it.

Prints Markdown: root mean squares of joints, mm, along the ray, and across it by axis. Errors of
more than 1 m are of somebody else, and left out.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from film import JOINTS, OF_MODEL, PARTS, load
from scenes import REALISTIC, guessing, published

from hiros_mcap.body.rotations import Rigid
from hiros_mcap.body.symmetry import split_side, symmetry_of
from hiros_mcap.calibrate.given_poses import views_of
from hiros_mcap.calibrate.guessed_depth import depth_errors
from hiros_mcap.calibrate.sampling import Rig
from hiros_mcap.calibrate.survey import Survey, camera_faults, fixed_cameras
from hiros_mcap.evaluate.truth import Truth
from hiros_mcap.io.log import open_log
from hiros_mcap.skeletons import Floats, Frame

SEEDS = range(7300, 7303)
FARTHEST_M, EXCHANGED = 1.0, 0.6
LAGS_S = (0.1, 0.5, 2.0)
LIMBS = (("knee", "ankle"), ("elbow", "wrist"), ("shoulder", "elbow"), ("hip", "knee"))


class Errors(NamedTuple):
    """Errors of a camera's views of a person, in the order of time."""

    camera: str
    along: Floats
    """(T, 12) m, away from the camera; NaN = not seen."""
    across: Floats
    """(T, 12) root mean square of the two axes across, m."""
    rate: float
    """Hz."""


def errors_of(
    frames: Sequence[Frame], pose: Rigid, truth: Truth, slots: Sequence[int], rate: float
) -> Iterator[Errors]:
    """Yield the errors of a camera's frames: each view is of the person it is nearest to."""
    other = np.arange(len(JOINTS)) ^ 1  # of the other side
    rows = np.clip(
        np.searchsorted(truth.stamps, [f.stamp for f in frames]), 0, len(truth.stamps) - 1
    )
    out = np.full((2, truth.positions.shape[1], len(frames), len(JOINTS)), np.nan)
    for t, (frame, row) in enumerate(zip(frames, rows.tolist(), strict=True)):
        true = truth.positions[row][:, slots]
        for view in pose.moved(frame.positions)[:, slots]:
            off, crossed = (
                np.nanmean(np.linalg.norm(joints - true, axis=2), axis=1)
                for joints in (view, view[other])
            )
            if not np.isfinite(off).any():
                continue
            p = int(np.nanargmin(np.minimum(off, crossed)))
            error = (view[other] if crossed[p] < EXCHANGED * off[p] else view) - true[p]
            ray = true[p] - pose.translation
            ray /= np.linalg.norm(ray, axis=1, keepdims=True)
            along, length = np.sum(error * ray, axis=1), np.linalg.norm(error, axis=1)
            there = length < FARTHEST_M
            out[0, p, t, there] = along[there]
            out[1, p, t, there] = np.sqrt(np.maximum(length**2 - along**2, 0.0) / 2)[there]
    for along, across in zip(*out, strict=True):
        if np.isfinite(along).any():
            yield Errors(frames[0].source, along, across, rate)


def of_film(cache: Path) -> list[Errors]:
    """Return the errors in the film of one person."""
    film = next(load(cache))
    return [
        errors
        for camera, frames in zip(film.cameras, film.views, strict=True)
        for errors in errors_of(frames, camera.pose, film.truth, OF_MODEL, 60.0)
    ]


def simulated(kind: str, *, guesses: bool = False) -> list[Errors]:
    """Return the errors of a simulated detector, which sees depths or ``guesses`` them."""
    found = list[Errors]()
    for seed in SEEDS:
        scene = published(seed, **{**REALISTIC, "seconds": 10.0, "detector": {"kind": kind}})
        scene = guessing(scene, seed) if guesses else scene
        names = [split_side(name) for name in scene.model.marker_names]
        slots = [names.index(split_side(name)) for name in JOINTS]
        truth = Truth.of(scene.truth)
        for source, pose in scene.poses.items():
            frames = [frame for frame in scene.frames if frame.source == source]
            found += errors_of(frames, pose, truth, slots, 30.0)
    return found


def of_recordings(logs: Sequence[Path]) -> tuple[Floats, Floats]:
    """Return what cameras err by along and across their rays, m, of each camera of each log."""
    found = list[tuple[float, float]]()
    for path in logs:
        with open_log(path) as log:
            cameras = sorted(fixed_cameras(log, camera_faults(log)))
            mirror = symmetry_of(log.model).mirror
            views = views_of(cameras, Survey(log).sightings({}), [0.0] * len(cameras), mirror)
            rig = Rig.of([camera.pose for camera in cameras])
            found += [
                (float(np.hypot(e.along, e.across / np.sqrt(2))), e.across / np.sqrt(2))
                for e in depth_errors(views, rig, mirror)
            ]
    along, across = np.array(found).reshape(-1, 2).T
    return along, across


def rms(values: Floats) -> str:
    """Root mean square, mm."""
    return f"{1000 * np.sqrt(np.nanmean(values**2)):.0f}"


def correlation(one: Floats, other: Floats) -> float:
    """Of two courses with the same mean of 0 in the long run."""
    both = np.isfinite(one + other)
    product = np.mean(one[both] * other[both])
    return float(product / np.sqrt(np.mean(one[both] ** 2) * np.mean(other[both] ** 2)))


def rows(errors: Sequence[Errors]) -> Iterator[tuple[str, str]]:
    """Yield what a column says."""
    along = np.concatenate([e.along for e in errors])
    across = np.concatenate([e.across for e in errors])
    joints = {part: [k for k, name in enumerate(JOINTS) if name.endswith(part)] for part in PARTS}
    for part, k in {**joints, "all joints": [*range(len(JOINTS))]}.items():
        yield f"{part}: along, across", f"{rms(along[:, k])}, {rms(across[:, k])}"
    means = np.array([np.nanmean(e.along, axis=0) for e in errors])
    yield "along, the mean of each joint over time", rms(means)
    whole = [np.nanmean(e.along, axis=1) for e in errors]
    yield "along, whole body", rms(np.concatenate(whole))
    beside = np.concatenate([e.along - w[:, None] for e, w in zip(errors, whole, strict=True)])
    yield "along, beside the body", rms(beside)
    for one, other in LIMBS:
        r = correlation(beside[:, joints[one]], beside[:, joints[other]])
        yield f"correlation of {one} and {other}, beside the body", f"{r:.2f}"
    for lag in LAGS_S:
        steps = [(e.along, round(lag * e.rate)) for e in errors]
        pairs = [(course[:-n], course[n:]) for course, n in steps if n < len(course)]
        courses = [np.concatenate(ends) for ends in zip(*pairs, strict=True)]
        yield f"correlation after {lag:g} s", f"{correlation(*courses):.2f}" if courses else ""


def main() -> None:
    cache = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "hiros-film"
    parser = argparse.ArgumentParser()
    parser.add_argument("--cache", type=Path, default=cache, metavar="FOLDER")
    parser.add_argument("logs", type=Path, nargs="*", metavar="LOG", help="of real depth cameras")
    given = parser.parse_args()
    columns = {
        "MediaPipe on film": of_film(given.cache),
        "simulated Kinect": simulated("kinect"),
        "simulated, ideal": simulated("ideal"),
        "simulated, depth guessed": simulated("kinect", guesses=True),
    }
    table = {name: dict(rows(errors)) for name, errors in columns.items()}
    print(f"| mm | {' | '.join(table)} |\n|{'---|' * (1 + len(table))}")
    for text in next(iter(table.values())):
        print(f"| {text} | {' | '.join(column[text] for column in table.values())} |")
    for camera in columns["MediaPipe on film"]:
        print(f"\n{camera.camera}: {1000 * np.nanmean(camera.along):+.0f} mm along in the mean")
    if given.logs:
        found = zip(("along", "across"), of_recordings(given.logs), strict=True)
        numbers = [f"{way} {1000 * np.nanmedian(e):.0f} mm" for way, e in found]
        print(f"\nreal depth cameras, {len(given.logs)} logs: {', '.join(numbers)}")


if __name__ == "__main__":
    main()
