"""Simulated RGB cameras against a truth, beside triangulation and a Butterworth filter.

    PYTHONPATH=.:cli:schemas:viewer python benchmarks/rgb.py [SEEDS] [SECONDS]

Four cameras; two people who cross, and four who roam; detectors "ideal" and "kinect". Two people
are filmed three times: by a usual calibration, with poses that are off by 1 degree and 35 mm, and
with clocks that are off by about a second; a truth has no right time then, so it is aligned with
each result. Each log is processed twice: with poses that the people may mend, and with the given
ones. The peer is the triangulation at instants with the given poses, with the ids of the tracker,
and a Butterworth filter at 6 Hz of each coordinate. Prints Markdown rows: mean and 99th percentile,
mm, by the peer, with given poses and as it is; their quotients; changes of id; skeletons of nobody.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Sequence
from itertools import product
from pathlib import Path

import numpy as np

from hiros_mcap.config import load_config
from hiros_mcap.evaluate.alignment import aligned
from hiros_mcap.evaluate.logs import Channel, ChannelResult, evaluate_channels, read_results
from hiros_mcap.evaluate.logs import find_truth as truth_of
from hiros_mcap.evaluate.truth import Truth
from hiros_mcap.running.pipeline import process
from hiros_mcap.simulate import SimulateParams
from hiros_mcap.simulate.simulation import write_log

POSES_OFF = {"orientation_error": 0.6, "position_error": 0.02}
SCENES: tuple[tuple[int, str, str, dict[str, float]], ...] = (
    (2, "cross", "", {}),
    (2, "cross", "poses off", POSES_OFF),
    (2, "cross", "clocks off", {"clock_offset": 0.7}),
    (4, "roam", "", {}),
)
DETECTORS = ("ideal", "kinect")
CUTOFF_HZ, LEAST = 6.0, 20


def butterworth(channel: Channel) -> Channel:
    """Filter the coordinates of a channel in place, person by person."""
    from scipy.signal import butter, filtfilt

    rate = 1e9 / float(np.median(np.diff([frame.stamp for frame in channel.frames])))
    b, a = butter(2, CUTOFF_HZ / (rate / 2))
    frames = channel.frames
    for person in {int(i) for frame in frames for i in frame.ids}:
        rows = [(f, p) for f in frames for p in np.flatnonzero(f.ids == person).tolist()]
        values = np.array([frame.markers[p, :, :3] for frame, p in rows])
        for column in values.reshape(len(rows), -1).T:
            known = np.flatnonzero(np.isfinite(column))
            if len(known) > LEAST:
                whole = np.interp(np.arange(len(rows)), known, column[known])
                column[known] = filtfilt(b, a, whole)[known]
        for (frame, p), filtered in zip(rows, values, strict=True):
            frame.markers[p, :, :3] = filtered
    return channel


def result_of(channel: Channel, truth: Truth, parts: Sequence[str]) -> ChannelResult:
    """Return the errors of a channel."""
    (result,) = evaluate_channels({"/x": channel}, aligned(truth, {"/x": channel}, parts)).values()
    return result


def main() -> None:
    """Print a row per log."""
    seeds, seconds = (int(n) for n in [*sys.argv[1:], "6", "20"][:2])
    print("| people | detector | seed | Butterworth | given poses | hiros | of it | ids | false |")
    print("|---|---|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        log, out = Path(folder, "a.mcap"), Path(folder, "b.mcap")
        for (people, action, fault, rig), detector, seed in product(
            SCENES, DETECTORS, range(1, seeds + 1)
        ):
            settings = {
                "people": people, "cameras": 4, "action": action, "seconds": float(seconds),
                "seed": seed, "rig": {"kinds": ("rgb",), **rig}, "detector": {"kind": detector},
            }  # fmt: skip
            write_log(log, SimulateParams.model_validate(settings))
            truth, found, parts = truth_of(log), [], ("time",) if "clock_offset" in rig else ()
            assert truth is not None
            for poses in ("given", "refined"):
                config = load_config(None, [f"input.poses={poses}"], system="fuse")
                process(log, out, config=config)
                channels = read_results(out)
                if poses == "given":
                    found.append(result_of(butterworth(channels["/hiros/tracked"]), truth, parts))
                found.append(result_of(channels["/hiros/filtered"], truth, parts))
            s = [result.scores for result in found]
            errors = " | ".join(f"{x.mean:.1f} / {x.percentile_99:.0f}" for x in s)
            shares = f"{s[2].mean / s[0].mean:.2f}, {s[2].percentile_99 / s[0].percentile_99:.2f}"
            counts = f"{s[2].switches} | {s[2].false}"
            print(
                f"| {people} {fault} | {detector} | {seed} | {errors} | {shares} | {counts} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
