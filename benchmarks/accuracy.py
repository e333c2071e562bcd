"""Error against the truth after every stage: T, TM, TMF, TMO, TMOF.

python benchmarks/accuracy.py [--detector ideal]    simulated logs, 1 to 4 people
python benchmarks/accuracy.py LOG TRUTH [LOG TRUTH ...]
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from scenes import use_detector, write_scene

from hiros_mcap.config import load_config
from hiros_mcap.evaluate import Scores, Truth, load_truth
from hiros_mcap.evaluate.logs import evaluate_log
from hiros_mcap.running.pipeline import ProcessOptions, process

COLUMNS = "mean  sd    p95   angle  angSD orient  limbCV  jitter  lag    miss false switch"


def row(name: str, s: Scores) -> str:
    return (
        f"{name:9} {s.mean:5.1f} {s.deviation:5.1f} {s.percentile_95:5.1f} {s.angle_rmse:6.2f} "
        f"{s.angle_deviation:6.2f} {s.orientation_error:6.2f} {s.limb_variation:7.4f} "
        f"{s.jitter:6.1f} {s.lag:6.1f} "
        f"{s.missing:5d} {s.false:5d} {s.switches:5d}"
    )


def table(log: Path, truth: Truth, overrides: Sequence[str]) -> None:
    print(f"{'':9} {COLUMNS}")
    config = load_config(None, list(overrides), system="hiros")
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out.mcap"
        process(log, out, config=config, options=ProcessOptions("hiros"))
        chains = ("T", "TM", "TMO", "TMOF")
        for chain, result in zip(chains, evaluate_log(out, truth).values(), strict=True):
            print(row(chain, result.scores))
        process(log, out, config=config, options=ProcessOptions("hiros", stages="TMF"))
        print(row("TMF", evaluate_log(out, truth, ["/hiros/filtered"])["/hiros/filtered"].scores))


def main() -> None:
    given = use_detector(sys.argv[1:])
    arguments = [a for a in given if "=" not in a]
    overrides = [a for a in given if "=" in a]
    if arguments:
        for log, truth in zip(arguments[::2], arguments[1::2], strict=True):
            print(f"\n{Path(log).name}")
            table(Path(log), load_truth(Path(truth)), overrides)
        return
    with tempfile.TemporaryDirectory() as folder:
        for people in range(1, 5):
            path = Path(folder) / f"{people}.mcap"
            write_scene(path, people, people=people, seconds=20.0)
            print(f"\n{people} people, 5 cameras, 20 s, simulated")
            table(path, load_truth(path), overrides)


if __name__ == "__main__":
    main()
