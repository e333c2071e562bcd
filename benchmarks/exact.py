"""Exact results: whether a change of the code changed a number.

    python benchmarks/exact.py keep FOLDER LOG...      write every result, at full precision
    python benchmarks/exact.py compare FOLDER LOG...   run again; print what differs

Each system reads each log with its defaults. FOLDER gets one .npz per log and system: times, ids,
positions, orientations and confidences of every skeleton on each output channel.
Exit code 1 if anything differs.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from hiros_mcap.config import load_config
from hiros_mcap.io.log import open_log
from hiros_mcap.running.pipeline import process
from hiros_mcap.running.process_options import ProcessOptions

SYSTEMS = ("fuse", "fuse-realtime", "hiros", "hiros-realtime", "malaguti", "lee", "openptrack")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("task", choices=("keep", "compare"))
    parser.add_argument("folder", type=Path)
    parser.add_argument("logs", type=Path, nargs="+")
    parser.add_argument("--system", action="append", help="may be given several times")
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    differ = False
    for log in given.logs:
        for system in given.system or SYSTEMS:
            former = given.folder / f"{log.stem}.{system}.npz"
            now = results(log, system)
            if given.task == "keep":
                np.savez_compressed(former, allow_pickle=False, **now)
                print(former, flush=True)
                continue
            with np.load(former) as arrays:
                faults = differences(dict(arrays), now)
            differ |= bool(faults)
            print(f"{log.stem:36} {system:16} {'; '.join(faults) or 'equal'}", flush=True)
    sys.exit(int(differ))


def results(log: Path, system: str) -> dict[str, np.ndarray]:
    """Return the arrays of each output channel, by "channel name"."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out.mcap"
        options = ProcessOptions(system=system, keep=())
        summary = process(log, out, config=load_config(system=system), options=options)
        return {
            f"{channel} {name}": array
            for channel, n in summary.written.items()
            if n and channel.startswith("/hiros/")
            for name, array in channel_arrays(out, channel).items()
        }


def channel_arrays(path: Path, channel: str) -> dict[str, np.ndarray]:
    """Return what stands on a channel, people of all times in one row each."""
    with open_log(path, topics=[channel], output_prefix="/none") as log:
        frames = list(log.frames())
    return {
        "stamps": np.repeat([f.stamp for f in frames], [len(f.ids) for f in frames]),
        "ids": np.concatenate([f.ids for f in frames]),
        "markers": np.concatenate([f.markers for f in frames]),
        "links": np.concatenate([f.links for f in frames]),
        "confidences": np.concatenate([f.marker_confidences for f in frames]),
    }


def differences(former: Mapping[str, np.ndarray], now: Mapping[str, np.ndarray]) -> list[str]:
    """Return a phrase per array that differs."""
    faults = [f"{name} is new" for name in sorted(now.keys() - former.keys())]
    faults += [f"{name} is gone" for name in sorted(former.keys() - now.keys())]
    for name in sorted(former.keys() & now.keys()):
        a, b = former[name], now[name]
        if a.shape != b.shape:
            faults.append(f"{name} {len(a)} -> {len(b)}")
        elif not np.array_equal(a, b, equal_nan=a.dtype.kind == "f"):
            if a.dtype.kind != "f":
                faults.append(f"{name} differ in {int((a != b).sum())}")
                continue
            gone = int((np.isnan(a) != np.isnan(b)).sum())
            most = np.nanmax(np.abs(a - b), initial=0.0)
            faults.append(f"{name} differ by up to {most:.2g}, {gone} NaN")
    return faults


if __name__ == "__main__":
    main()
