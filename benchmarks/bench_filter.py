"""Error, lag, smoothness and time of the filter, by method, order, cut-off and look-ahead.

python benchmarks/bench_filter.py

Simulated people walk, jog, throw and gesture; to their true joints is added what a merger of five
depth cameras leaves: first-order noise of 11 mm an axis (correlation .85 over 1/30 s) and white
noise of 4 mm. A row's lag is the time shift that explains most of the difference from the truth,
jitter the mean norm of the second difference, limb CV the coefficient of variation of the limbs'
lengths, angle the mean rotation from the true orientation of the links.

A filter takes noise away; so this noise is known and clean, and there is no detector.
"""

from __future__ import annotations

import time
from itertools import product

import numpy as np

from hiros_mcap.frames import by_frame
from hiros_mcap.simulate import SimulateParams, simulate
from hiros_mcap.skeletons import ORIENTATION, POSITION, Floats, Frame, SkeletonModel
from hiros_mcap.stages.filter.filter import filter_blocks
from hiros_mcap.stages.filter.filter_params import FilterParams

filter_frames = by_frame(filter_blocks)

ACTIONS = ("walk", "jog", "throw", "free_dynamic")
SECONDS, PEOPLE = 8.0, 4
COLOURED, CORRELATION, WHITE = 0.011, 0.85, 0.004  # m, per 1/30 s, m
ROTATION = 0.06  # rad, of the links' coloured noise


def coloured(shape: tuple[int, ...], rng: np.random.Generator) -> Floats:
    """First-order noise of unit variance along the first axis."""
    noise = rng.normal(size=shape)
    for k in range(1, len(noise)):
        noise[k] = CORRELATION * noise[k - 1] + np.sqrt(1 - CORRELATION**2) * noise[k]
    return noise


def scene(action: str) -> tuple[SkeletonModel, list[Frame], list[Frame]]:
    """Model, truth, and truth with noise."""
    from scipy.spatial.transform import Rotation

    simulation = simulate(SimulateParams(people=PEOPLE, action=action, seconds=SECONDS, seed=1))
    truth = [f for f in simulation.truth if f.n_people == PEOPLE]
    rng = np.random.default_rng(2)
    markers, links = (np.stack([getattr(f, a) for f in truth]) for a in ("markers", "links"))
    shape = markers[..., POSITION].shape
    markers[..., POSITION] += COLOURED * coloured(shape, rng) + WHITE * rng.normal(size=shape)
    noise = Rotation.from_rotvec(ROTATION * coloured(links[..., :3].shape, rng).reshape(-1, 3))
    noisy_links = noise * Rotation.from_quat(links[..., ORIENTATION].reshape(-1, 4))
    links[..., ORIENTATION] = noisy_links.as_quat().reshape(*links.shape[:-1], 4)
    noisy = [f.replace(markers=m, links=n) for f, m, n in zip(truth, markers, links, strict=True)]
    return simulation.model, truth, noisy


def limb_variation(points: Floats, limbs: Floats) -> float:
    """Mean over people and limbs of SD / mean of the length."""
    lengths = np.linalg.norm(points[:, :, limbs[:, 0]] - points[:, :, limbs[:, 1]], axis=-1)
    return float(np.mean(lengths.std(axis=0) / lengths.mean(axis=0)))


def row_of(model: SkeletonModel, truth: list[Frame], frames: list[Frame]) -> list[float]:
    """The figures of one scene, in the order of the table."""
    x, v, y = (
        np.stack(a)
        for a in (
            [f.positions for f in truth],
            [f.velocities for f in truth],
            [f.positions for f in frames],
        )
    )
    error = np.linalg.norm(y - x, axis=-1) * 1e3
    lag = -np.sum((y - x) * v) / np.sum(v * v) * 1e3
    jitter = np.linalg.norm(np.diff(y, 2, axis=0), axis=-1).mean() * 1e3
    q, p = (np.stack([f.orientations for f in fs]) for fs in (truth, frames))
    cosine = np.minimum(np.abs(np.sum(q * p, axis=-1)), 1.0)
    angle = np.degrees(2 * np.arccos(cosine)).mean()
    rms = float(np.sqrt(np.mean(error**2)))
    limbs = limb_variation(y, np.asarray(model.links))
    return [rms, error.mean(), error.std(), lag, jitter, limbs, angle]


def variants() -> list[FilterParams]:
    """The variants to compare: the default first."""
    grid: list[tuple[str, int, bool]] = [
        ("state_space", 2, True),
        ("state_space", 2, False),
        ("state_space", 3, True),
        ("butterworth", 2, True),
        ("butterworth", 4, True),
    ]
    return [FilterParams()] + [
        FilterParams.model_validate(
            {
                "method": method,
                "order": order,
                "keep_lengths": keep,
                "lookahead": ahead,
                "cutoff": cutoff,
            }
        )
        for (method, order, keep), ahead, cutoff in product(
            grid, (0.0, 0.1, 0.3), (3.0, 4.5, 6.0, 8.0)
        )
    ]


def main() -> None:
    """Print the table."""
    scenes = [scene(action) for action in ACTIONS]
    n_frames = sum(len(truth) for _, truth, _ in scenes)
    head = "  cutoff  ahead |   RMS  mean    SD mm   |  lag ms | jitter mm | limb CV | angle | ms"
    print(f"{'method':<14}order lengths{head}")

    def show(label: str, rows: list[list[float]], seconds: float) -> None:
        a = np.mean(rows, axis=0)
        print(
            f"{label} | {a[0]:5.1f} {a[1]:5.1f} {a[2]:5.1f}      | {a[3]:7.1f} | {a[4]:9.1f} |"
            f" {a[5]:7.4f} | {a[6]:5.2f} | {1e3 * seconds / n_frames:.3f}"
        )

    show(f"{'truth':<42}", [row_of(m, t, t) for m, t, _ in scenes], 0.0)
    show(f"{'input':<42}", [row_of(m, t, n) for m, t, n in scenes], 0.0)
    for p in variants():
        start = time.process_time()
        outputs = [list(filter_frames(noisy, model, p)) for model, _, noisy in scenes]
        seconds = time.process_time() - start
        rows = [row_of(m, t, o) for (m, t, _), o in zip(scenes, outputs, strict=True)]
        kept = "kept" if p.keep_lengths else "free"
        show(
            f"{p.method:<14}{p.order:>5} {kept:>7} {p.cutoff:>7.1f} {p.lookahead:>6.2f}",
            rows,
            seconds,
        )


if __name__ == "__main__":
    main()
