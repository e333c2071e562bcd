"""Time of the optimizer per merged frame, and what it does to noisy lengths: prints two tables.

python benchmarks/bench_optimizer.py
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from hiros_mcap.body.limb_table import LimbTable
from hiros_mcap.config import load_config
from hiros_mcap.events import Events
from hiros_mcap.frames import by_frame
from hiros_mcap.skeletons import Floats, Frame, SkeletonModel
from hiros_mcap.stages.optimize.limb_calibration import calibrate_limbs
from hiros_mcap.stages.optimize.optimize import optimize_blocks
from hiros_mcap.stages.optimize.optimize_params import OptimizeParams

optimize = by_frame(optimize_blocks)

MARKERS, FRAMES, NOISE = 32, 450, 0.012
PARENTS = [0, 1, 2, 2, 4, 5, 6, 7, 8, 7, 2, 11, 12, 13, 14, 15, 14, 0, 18, 19, 20, 0, 22, 23, 24, 3]
PARENTS += [26] * 5  # nose, eyes, ears


def make(people: int, rng: np.random.Generator) -> tuple[SkeletonModel, Floats, list[Frame]]:
    """People of 32 markers and 31 links that move, and frames of them with coloured noise."""
    links = [(f"link {k}", parent, k + 1) for k, parent in enumerate(PARENTS)]
    model = SkeletonModel.of([f"marker {m}" for m in range(MARKERS)], links)
    lengths = np.concatenate([rng.uniform(0.12, 0.45, 26), rng.uniform(0.07, 0.11, 5)])
    phase = rng.uniform(0, 6.28, (people, len(links), 2))
    truth = np.zeros((FRAMES, people, MARKERS, 3))
    for link, parent in enumerate(PARENTS):
        t = np.arange(FRAMES)[:, None] / 30.0
        a, b = (phase[None, :, link, i] + 0.5 * np.sin(2.0 * t + phase[:, link, i]) for i in (0, 1))
        step = np.stack([np.cos(a) * np.cos(b), np.sin(a) * np.cos(b), np.sin(b)], axis=-1)
        truth[:, :, link + 1] = truth[:, :, parent] + lengths[link] * step
    noise = rng.normal(size=truth.shape) * NOISE
    for k in range(1, FRAMES):
        noise[k] = 0.9 * noise[k - 1] + np.sqrt(1 - 0.81) * noise[k]
    frames = [Frame.empty(people, model, stamp=k * 33_333_333) for k in range(FRAMES)]
    for frame, points in zip(frames, truth + noise, strict=True):
        frame.ids[:] = np.arange(people)
        frame.markers[:, :, :3] = points
    return model, truth, frames


def cpu_per_frame(run: Callable[[], object], repeats: int = 3) -> float:
    """Least CPU time of ``run``, ms per frame."""
    times = []
    for _ in range(repeats):
        start = time.process_time()
        run()
        times.append(time.process_time() - start)
    return 1e3 * min(times) / FRAMES


def main() -> None:
    """Print the tables."""
    paper = load_config(preset="paper", system="hiros").optimize
    rng = np.random.default_rng(0)
    variants = {
        "exact (default)": OptimizeParams(),
        "paper": paper,
    }
    print(f"{'CPU ms per frame':24s}" + "".join(f"{n:3d} people" for n in (1, 4, 10)))
    made = {people: make(people, rng) for people in (1, 4, 10)}
    tables = {people: calibrate_limbs(frames, model) for people, (model, _, frames) in made.items()}
    for name, params in variants.items():
        row = [
            cpu_per_frame(lambda p=params, n=n: run(made[n], p, tables[n]), 1 + 2 * (n < 10))
            for n in made
        ]
        print(f"{name:24s}" + "".join(f"{ms:10.3f}" for ms in row))
    row = [cpu_per_frame(lambda n=n: run(made[n], OptimizeParams(), LimbTable())) for n in made]
    print(f"{'exact, calibrating too':24s}" + "".join(f"{ms:10.3f}" for ms in row))
    effect(made[4], variants)


def run(
    made: tuple[SkeletonModel, Floats, list[Frame]], params: OptimizeParams, limbs: LimbTable
) -> list[Frame]:
    """Optimize with known limbs, or calibrate if ``limbs`` is empty."""
    model, _, frames = made
    return list(optimize(frames, model, params, Events(), limbs))


def effect(
    made: tuple[SkeletonModel, Floats, list[Frame]], variants: dict[str, OptimizeParams]
) -> None:
    """Print error and variation of the lengths before and after."""
    model, truth, frames = made
    print(f"\n{'4 people, calibrating':24s}{'error mm':>10s}{'CV mean':>10s}{'CV max':>10s}")
    results = {"input": frames}
    for name in ("exact (default)", "paper"):
        results[name] = run(made, variants[name], LimbTable())
    for name, result in results.items():
        points = np.array([frame.positions for frame in result])
        ways = points[:, :, model.links[:, 0]] - points[:, :, model.links[:, 1]]
        length = np.linalg.norm(ways, axis=-1)
        variation = np.nanstd(length, axis=0) / np.nanmean(length, axis=0)
        error = 1e3 * np.nanmean(np.linalg.norm(points - truth, axis=-1))
        print(f"{name:24s}{error:10.2f}{variation.mean():10.4f}{variation.max():10.4f}")


if __name__ == "__main__":
    main()
