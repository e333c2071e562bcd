"""The system fuse with each of its steps off, against hiros: error and cost.

    python benchmarks/fuse.py [LOG [TRUTH]]
    python benchmarks/fuse.py --detector ideal

LOG needs a truth, in it or in a file of its own. Without a log, one of two people and four cameras
is simulated. Prints mean and SD of the joint error, mm, the RMSE of the bending angles, degrees,
the limbs' coefficient of variation, the jitter, mm, how many true joints the 68 % and 95 %
ellipsoids hold, and the CPU time of each step, s. The first run also loads the compiled kernels.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path

from scenes import use_detector, write_scene

from hiros_mcap.config import Table, load_config
from hiros_mcap.evaluate.logs import evaluate_log, find_truth
from hiros_mcap.evaluate.truth import Truth
from hiros_mcap.running.pipeline import process
from hiros_mcap.running.process_options import ProcessOptions

FUSE: Mapping[str, Table] = {
    "all steps": {},
    "no offsets of cameras": {"fuse": {"offset": 0.0}},
    "a look-ahead of 0.1 s": {"fuse": {"lookahead": 0.1, "window": 0.0}},
    "no rigid groups": {"constrain": {"rigid": False}},
    "no prior": {"constrain": {"prior": False}},
}


def main() -> None:
    given = use_detector(sys.argv[1:])
    with tempfile.TemporaryDirectory() as folder:
        log = Path(given[0]) if given else Path(folder) / "log.mcap"
        if not given:
            write_scene(log, 7, people=2, cameras=4, seconds=15.0, action="cross")
        truth = find_truth(log, given[1] if len(given) > 1 else None)
        if truth is None:
            sys.exit(f"{log} has no truth")
        show("hiros", "hiros", {}, log, truth)
        for name, changes in FUSE.items():
            show(f"fuse, {name}", "fuse", changes, log, truth)


def show(title: str, system: str, changes: Table, log: Path, truth: Truth) -> None:
    """Process a log and print one row."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out.mcap"
        config = load_config(system=system, named={title: changes})
        summary = process(log, out, config=config, options=ProcessOptions(system=system, keep=()))
        (result,) = evaluate_log(out, truth, ["/hiros/filtered"]).values()
    s, held = result.scores, result.coverage
    coverage = f"{held.within_68:5.2f} {held.within_95:5.2f}" if held else f"{'':11}"
    cost = ", ".join(f"{stage.name} {stage.cpu_s:.2f}" for stage in summary.stages)
    print(
        f"{title:28} {s.mean:5.1f} / {s.deviation:4.1f}  {s.angle_rmse:4.2f}  "
        f"{s.limb_variation:.4f}  {s.jitter:4.1f}  {coverage}  {cost}"
    )


if __name__ == "__main__":
    main()
