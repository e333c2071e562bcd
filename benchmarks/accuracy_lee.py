"""Error of Lee's system against the truth: A1 to A5, the radius, and the choices left open.

python benchmarks/accuracy_lee.py                       simulated logs, slow gestures too
python benchmarks/accuracy_lee.py LOG TRUTH [LOG TRUTH ...]

Mean and standard deviation of the joint error, mm, by the parts of the paper's section 3.1.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from hiros_mcap.body.transforms import transform_to_fixed
from hiros_mcap.config import load_config
from hiros_mcap.evaluate import Truth, evaluate, load_truth
from hiros_mcap.evaluate.parts import PARTS
from hiros_mcap.frames import by_frame
from hiros_mcap.io.log import open_log
from hiros_mcap.running.pipeline import camera_positions
from hiros_mcap.simulate import SimulateParams
from hiros_mcap.simulate.write_log import write_log
from hiros_mcap.skeletons import Frame, SkeletonModel
from hiros_mcap.systems import SYSTEMS, Run, chain_of

ROWS = (
    *((f"lee-a{k}", ()) for k in range(1, 6)),
    *((system, (f"cluster.radius={r}",)) for system in ("lee-a4", "lee-a5")
      for r in (0.05, 0.1, 0.15, 0.2)),
    ("lee-a2", ("cluster.rearrange=both",)),
    ("lee-a4", ("cluster.rearrange=both",)),
    ("lee-a4", ("cluster.compensate_motion=false",)),
    ("lee-a5", ("predict.output=corrected",)),
    ("lee-a5", ("predict.model=constant_position", "predict.output=corrected")),
    ("lee-a5", ("predict.model=constant_acceleration",)),
    ("lee-a5", ("predict.model=constant_acceleration", "predict.output=corrected")),
)  # fmt: skip


class Scene:
    """A log, tracked once."""

    def __init__(self, log: Path, truth: Truth) -> None:
        self.truth = truth
        with open_log(log) as source:
            self.model: SkeletonModel = source.model
            run = Run(source.model, cameras=camera_positions(source))
            frames = transform_to_fixed(source.frames(), source.transforms, source.fixed_frame)
            self.tracked = list(by_frame(SYSTEMS["lee"].stages(run)["tracked"])(frames))

    def run(self, system: str, overrides: tuple[str, ...]) -> list[Frame]:
        """What the last stage gives."""
        config = load_config(None, list(overrides), system=system)
        stages = SYSTEMS[system].stages(Run(self.model, config))
        frames = self.tracked
        for name in chain_of(system)[1:]:
            frames = list(by_frame(stages[name])(frames))
        return frames

    def table(self) -> None:
        print(
            f"{'':58} {'all':>11} " + " ".join(f"{part:>13}" for part in PARTS) + "  jitter    lag"
        )
        for system, overrides in (("hiros", ()), *ROWS):
            scores = evaluate(self.run(system, overrides), self.truth, self.model)
            name = " ".join((system, *overrides))
            parts = " ".join(
                f"{scores.parts[p].mean:6.1f} {scores.parts[p].deviation:6.1f}" for p in PARTS
            )
            print(
                f"{name:58} {scores.mean:5.1f} {scores.deviation:5.1f} {parts} "
                f"{scores.jitter:6.1f} {scores.lag:6.1f}"
            )


def main() -> None:
    arguments = sys.argv[1:]
    for log, truth in zip(arguments[::2], arguments[1::2], strict=True):
        print(f"\n{Path(log).name}")
        Scene(Path(log), load_truth(Path(truth))).table()
    if arguments:
        return
    with tempfile.TemporaryDirectory() as folder:
        scenes = [{"people": people, "seed": people} for people in (1, 2, 4)]
        gestures = [
            {"people": 1, "seed": 3, "cameras": 4, "action": action}
            for action in ("squat", "bend", "cross_arms")
        ]
        for number, scene in enumerate([*scenes, *gestures]):
            path = Path(folder) / f"{number}.mcap"
            write_log(path, SimulateParams.model_validate({"seconds": 20.0, **scene}))
            print("\nsimulated, 20 s, " + ", ".join(f"{k} {v}" for k, v in scene.items()))
            Scene(path, load_truth(path)).table()


if __name__ == "__main__":
    main()
