"""Two cameras: what a perfect choice between their views would reach, and what fuse reaches.

    PYTHONPATH=.:cli:schemas:viewer python benchmarks/best_view.py [SEEDS] [SECONDS]

Two people who cross, or turn, before two cameras at right angles; detector "kinect". At each
instant of the result, both cameras' detections of a person are brought to it in time, with their
sides as the truth has them. Prints Markdown rows, mean and 99th percentile, mm, of the joints that
two cameras show: each view alone (the mean of both), their mean, the better view of a person, the
better view of each joint, the same through a Butterworth filter at 6 Hz, and the filtered result of
fuse.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterator
from itertools import product
from pathlib import Path

import numpy as np
from rgb import smoothed

from hiros_mcap.body.symmetry import symmetry_of
from hiros_mcap.config import load_config
from hiros_mcap.evaluate.logs import Channel, read_results
from hiros_mcap.evaluate.logs import find_truth as truth_of
from hiros_mcap.evaluate.truth import Truth
from hiros_mcap.running.pipeline import process
from hiros_mcap.simulate import SimulateParams
from hiros_mcap.simulate.simulation import write_log
from hiros_mcap.skeletons import Floats, Ints, Stamps

SCENES = ("cross", "roam")
NEAR_NS = 60_000_000
"""Two detections this near in time, before and after an instant, are interpolated."""
PERSON_M = 0.6
"""Distance of the middle of a detection from the person whom it shows, at most."""

Views = dict[str, tuple[Stamps, Floats]]
"""Camera -> (T,) ns and (T, M, 3) m, NaN where it does not show a person."""


def views_of(channel: Channel, truth: Truth, person: int, mirror: Ints) -> Views:
    """Return what each camera shows of a true person, with the sides that fit better."""
    seen: dict[str, list[tuple[int, Floats]]] = {}
    for frame in channel.frames:
        true = truth.at(np.array([frame.stamp]))[0][0, person]
        if not np.isfinite(true).any() or not len(frame.markers):
            continue
        points = frame.markers[:, :, :3]
        away = np.linalg.norm(np.nanmean(points - true, axis=1), axis=1)
        if np.nanmin(away) < PERSON_M:
            nearest = points[int(np.nanargmin(away))]
            both = nearest, nearest[mirror]
            best = min(both, key=lambda p: float(np.nanmean((p - true) ** 2)))
            seen.setdefault(frame.source, []).append((frame.stamp, best))
    return {
        camera: (np.array([s for s, _ in rows]), np.array([p for _, p in rows]))
        for camera, rows in seen.items()
    }


def at(views: Views, stamp: int) -> Floats:
    """(C, M, 3) the views at an instant; NaN where a camera shows nothing near in time."""
    rows = []
    for stamps, points in views.values():
        k = int(np.searchsorted(stamps, stamp))
        out = np.full(points.shape[1:], np.nan)
        if 0 < k < len(stamps) and stamps[k] - stamps[k - 1] < NEAR_NS:
            share = (stamp - stamps[k - 1]) / (stamps[k] - stamps[k - 1])
            out = points[k - 1] + share * (points[k] - points[k - 1])
        rows.append(out)
    return np.array(rows)


def errors_of(results: dict[str, Channel], truth: Truth, mirror: Ints) -> Iterator[Floats]:
    """Yield (6, N) errors, m, of the joints of a person: see the module."""
    frames = results["/hiros/filtered"].frames
    stamps = np.array([frame.stamp for frame in frames])
    rate = 1e9 / float(np.median(np.diff(stamps)))
    for person, true in enumerate(np.moveaxis(truth.at(stamps)[0], 1, 0)):
        views = views_of(results["/hiros/tracked"], truth, person, mirror)
        if len(views) < 2:
            continue
        seen = np.stack([at(views, stamp) for stamp in stamps.tolist()], axis=1)  # (C, T, M, 3)
        off = np.linalg.norm(seen - true, axis=3)
        off[:, ~np.isfinite(off).all(axis=0)] = np.nan
        whole = np.argmin(np.nan_to_num(np.nanmean(off, axis=2), nan=np.inf), axis=0)
        best = np.argmin(np.nan_to_num(off, nan=np.inf), axis=0)
        chosen = np.take_along_axis(seen, best[None, ..., None], axis=0)[0]
        result = np.full_like(true, np.nan)
        for t, frame in enumerate(frames):
            points = frame.markers[:, :, :3]
            away = np.linalg.norm(np.nanmean(points - true[t], axis=1), axis=1)
            if len(away) and np.nanmin(away) < PERSON_M:
                result[t] = points[int(np.nanargmin(away))]
        rows = np.array([
            off.mean(axis=0),
            np.linalg.norm(seen.mean(axis=0) - true, axis=2),
            off[whole, np.arange(len(stamps))],
            off.min(axis=0),
            np.linalg.norm(smoothed(chosen, rate) - true, axis=2),
            np.linalg.norm(result - true, axis=2),
        ])  # fmt: skip
        yield rows[:, np.isfinite(rows).all(axis=0)]


def main() -> None:
    """Print a row per log."""
    seeds, seconds = (int(n) for n in [*sys.argv[1:], "3", "20"][:2])
    print("| scene | seed | a view | mean | better view | better joints | filtered | fuse |")
    print("|---|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        log, out = Path(folder, "a.mcap"), Path(folder, "b.mcap")
        for action, seed in product(SCENES, range(1, seeds + 1)):
            settings = {
                "people": 2, "cameras": 2, "action": action, "seconds": float(seconds),
                "seed": seed, "detector": {"kind": "kinect"},
            }  # fmt: skip
            write_log(log, SimulateParams.model_validate(settings))
            truth = truth_of(log)
            assert truth is not None
            process(log, out, config=load_config(None, [], system="fuse"))
            results = read_results(out)
            model = results["/hiros/filtered"].model
            rows = list(errors_of(results, truth, symmetry_of(model).mirror))
            both = 1000 * np.concatenate(rows, axis=1)
            cells = (f"{row.mean():.1f} / {np.percentile(row, 99):.0f}" for row in both)
            print(f"| {action} | {seed} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
