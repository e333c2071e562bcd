"""Random skeletons for the optimizer's tests: trees and graphs with loops, markers missing."""

import numpy as np

from hiros_mcap.kernels import optimizing as kernels
from hiros_mcap.skeletons import SkeletonModel


def random_model(rng, markers=20, loops=0):
    """A random tree with ``loops`` further links."""
    links = [(f"link {c}", int(rng.integers(0, c)), c) for c in range(1, markers)]
    for k in range(loops):
        a, b = (int(m) for m in rng.choice(markers, 2, replace=False))
        links.append((f"loop {k}", a, b))
    return SkeletonModel.of([f"marker {m}" for m in range(markers)], links)


def random_poses(model, count, rng, sd=0.02, missing=0.12):
    """(start, nominal): noisy poses with markers missing, lengths of the poses without noise."""
    truth = rng.normal(size=(count, model.n_markers, 3)) * 0.4
    bones = truth[:, model.links[:, 0]] - truth[:, model.links[:, 1]]
    start = truth + rng.normal(size=truth.shape) * sd
    start[rng.random(start.shape[:2]) < missing] = np.nan
    return start, np.ascontiguousarray(np.linalg.norm(bones, axis=2))


def weights_of(model, start, nominal, stiffness=0.0, max_error=0.1):
    """(P, L, 4) weights as the stage gives them to its solver."""
    links = np.ascontiguousarray(model.links)
    degree = np.bincount(links.ravel(), minlength=model.n_markers).astype(np.int32)
    confidences = np.full(start.shape[:2], np.nan)
    outlier = np.zeros(start.shape[:2], np.int32)
    weights = np.empty((*nominal.shape, 4))
    kernels.weigh(
        start, nominal, confidences, links, degree, outlier, max_error, stiffness, 1e-3, weights
    )
    return weights


def energies(model, solved, start, nominal, weights):
    """(P,) energy of each skeleton."""
    links = np.ascontiguousarray(model.links)
    rows = zip(solved, start, nominal, weights, strict=True)
    return np.array([kernels.energy(x, x0, n, links, w) for x, x0, n, w in rows])
