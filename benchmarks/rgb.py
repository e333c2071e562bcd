"""Simulated RGB cameras against a truth, beside triangulation and a Butterworth filter.

    PYTHONPATH=.:cli:schemas:viewer python benchmarks/rgb.py [SEEDS] [SECONDS]

Two people who cross, and four who roam; detectors "ideal" and "kinect". Four RGB cameras film them:
with a usual calibration, with poses that are off by 1 degree and 35 mm, and with clocks that are
off by about a second; a truth has no right time then, so it is aligned with each result. The peer
is the triangulation at instants with the given poses, with the ids of the tracker, and a
Butterworth filter at 6 Hz of each coordinate. Two or one of the cameras are depth cameras in the
last scenes; there the peer is hiros without the RGB cameras.

Each log is processed with the given poses, and with those that the people mend. Prints Markdown
rows: mean and 99th percentile, mm, by the peer, with given poses and as it is; their quotients;
changes of id and skeletons of nobody, by the peer and as it is.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from hiros_mcap.config import load_config
from hiros_mcap.evaluate.alignment import aligned
from hiros_mcap.evaluate.logs import Channel, ChannelResult, evaluate_channels, read_results
from hiros_mcap.evaluate.logs import find_truth as truth_of
from hiros_mcap.evaluate.truth import Truth
from hiros_mcap.running.pipeline import process
from hiros_mcap.simulate import SimulateParams
from hiros_mcap.simulate.simulation import write_log
from hiros_mcap.skeletons import Floats

POSES_OFF = {"orientation_error": 0.6, "position_error": 0.02}
MIXED, LONE = ("depth", "rgb", "depth", "rgb"), ("depth", "rgb", "rgb")
SCENES: tuple[tuple[int, str, str, dict[str, Any]], ...] = (
    (2, "cross", "", {}),
    (2, "cross", "poses off", POSES_OFF),
    (2, "cross", "clocks off", {"clock_offset": 0.7}),
    (4, "roam", "", {}),
    (2, "cross", "2 depth, 2 RGB", {"kinds": MIXED}),
    (4, "roam", "2 depth, 2 RGB", {"kinds": MIXED}),
    (2, "cross", "1 depth, 2 RGB", {"kinds": LONE}),
    (4, "roam", "1 depth, 2 RGB", {"kinds": LONE}),
)
DETECTORS = ("ideal", "kinect")
CUTOFF_HZ, LEAST = 6.0, 20


def smoothed(places: Floats, rate: float) -> Floats:
    """Filter (T, M, 3) at 6 Hz; what is missing is interpolated, and missing again afterwards."""
    from scipy.signal import butter, filtfilt

    b, a = butter(2, CUTOFF_HZ / (rate / 2))
    out, instants = places.copy(), np.arange(len(places))
    for m, c in product(range(places.shape[1]), range(3)):
        column = places[:, m, c]
        known = np.isfinite(column)
        if known.sum() > LEAST:
            whole = np.interp(instants, instants[known], column[known])
            out[known, m, c] = filtfilt(b, a, whole)[known]
    return out


def butterworth(channel: Channel) -> Channel:
    """Filter the coordinates of a channel in place, person by person."""
    frames = channel.frames
    rate = 1e9 / float(np.median(np.diff([frame.stamp for frame in frames])))
    for person in {int(i) for frame in frames for i in frame.ids}:
        rows = [(f, p) for f in frames for p in np.flatnonzero(f.ids == person).tolist()]
        values = smoothed(np.array([frame.markers[p, :, :3] for frame, p in rows]), rate)
        for (frame, p), filtered in zip(rows, values, strict=True):
            frame.markers[p, :, :3] = filtered
    return channel


def result_of(channel: Channel, truth: Truth, parts: Sequence[str]) -> ChannelResult:
    """Return the errors of a channel."""
    (result,) = evaluate_channels({"/x": channel}, aligned(truth, {"/x": channel}, parts)).values()
    return result


def row_of(log: Path, settings: dict[str, Any], parts: Sequence[str]) -> str:
    """Process a simulated log; return the errors."""
    out = log.with_suffix(".out.mcap")
    write_log(log, SimulateParams.model_validate(settings))
    truth = truth_of(log)
    assert truth is not None

    def processed(poses: str, topics: Sequence[str] = ()) -> dict[str, Channel]:
        config = load_config(None, [f"input.poses={poses}"], system="fuse")
        process(log, out, topics=topics, config=config)
        return read_results(out)

    given, refined = processed("given"), processed("refined")
    if set(settings["rig"]["kinds"]) == {"rgb"}:
        peer = butterworth(given["/hiros/tracked"])
    else:
        peer = processed("refined", ["/camera_*/skeletons"])["/hiros/filtered"]
    channels = peer, given["/hiros/filtered"], refined["/hiros/filtered"]
    s = [result_of(channel, truth, parts).scores for channel in channels]
    errors = " | ".join(f"{x.mean:.1f} / {x.percentile_99:.0f}" for x in s)
    shares = f"{s[2].mean / s[0].mean:.2f}, {s[2].percentile_99 / s[0].percentile_99:.2f}"
    counts = f"{s[0].switches}, {s[2].switches} | {s[0].false}, {s[2].false}"
    return f"{errors} | {shares} | {counts}"


def main() -> None:
    """Print a row per log."""
    seeds, seconds = (int(n) for n in [*sys.argv[1:], "6", "20"][:2])
    print("| people | detector | seed | peer | given poses | hiros | of it | ids | false |")
    print("|---|---|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for (people, action, name, rig), detector, seed in product(
            SCENES, DETECTORS, range(1, seeds + 1)
        ):
            rig = {"kinds": ("rgb",) * 4, **rig}
            settings = {
                "people": people, "cameras": len(rig["kinds"]), "action": action,
                "seconds": float(seconds), "seed": seed, "rig": rig,
                "detector": {"kind": detector},
            }  # fmt: skip
            row = row_of(Path(folder, "log.mcap"), settings, ["time"] * ("clock_offset" in rig))
            print(f"| {people} {name} | {detector} | {seed} | {row} |", flush=True)


if __name__ == "__main__":
    main()
