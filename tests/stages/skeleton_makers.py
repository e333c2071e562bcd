"""Random skeletons for the optimizer's tests: trees and graphs with loops, markers missing."""

import numpy as np

from hiros_mcap.body.limb_table import Limb, LimbTable
from hiros_mcap.skeletons import Frame, SkeletonModel
from hiros_mcap.stages.optimize.energy import (
    Energy,
    SolverScratch,
    exact_weights,
    minimize,
    paper_weights,
)
from hiros_mcap.stages.optimize.normal_equations import topology_of


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
    ways = truth[:, model.links[:, 0]] - truth[:, model.links[:, 1]]
    start = truth + rng.normal(size=truth.shape) * sd
    start[rng.random(start.shape[:2]) < missing] = np.nan
    return start, np.ascontiguousarray(np.linalg.norm(ways, axis=2))


def lengths_of(model, points):
    """(..., L) lengths of the links."""
    p, d = model.links.T
    return np.linalg.norm(points[..., d, :] - points[..., p, :], axis=-1)


def scene_of(model, points, nominal):
    """A frame of everybody in ``points`` (P, M, 3), and the table of their lengths (P, L)."""
    frame, limbs = Frame.empty(len(points), model), LimbTable()
    frame.ids[:], frame.markers[:, :, :3] = range(len(points)), points
    for person, lengths in enumerate(nominal.tolist()):
        limbs.people[person] = dict(zip(model.link_names, map(Limb, lengths), strict=True))
    return frame, limbs


def energy_of(model, start, nominal, exact=False, max_error=0.1):
    """The energy of poses, with weights as the stage gives them to its solver."""
    energy = Energy(start, nominal, np.empty((*nominal.shape, 4)))
    topology, outlier = topology_of(model), np.zeros(start.shape[:2], np.int32)
    if exact:
        exact_weights(energy, topology, outlier, np.full(outlier.shape, np.nan))
    else:
        paper_weights(energy, topology, outlier, max_error)
    return energy


def minimized(model, energy, tolerance):
    """The poses of least energy, and how many did not converge."""
    topology, solved = topology_of(model), np.empty_like(energy.start)
    failed = minimize(energy, topology, tolerance, SolverScratch.of(topology), solved)
    return solved, failed


def energies(model, poses, energy):
    """(P,) eq 14 to 19 of ``poses``, written down once more."""
    (p, d), w = model.links.T, np.moveaxis(energy.weights, -1, 0)
    moved = np.sum((poses - energy.start) ** 2, axis=-1)
    ways = poses[:, d] - poses[:, p], energy.start[:, d] - energy.start[:, p]
    lengths = [np.linalg.norm(way, axis=-1) for way in ways]
    sine = np.linalg.norm(np.cross(*ways), axis=-1)
    phi = np.arctan2(sine, np.sum(ways[0] * ways[1], axis=-1))
    terms = (lengths[0] - energy.nominal) ** 2, moved[:, p], moved[:, d], phi**2
    return np.nansum([weight * term for weight, term in zip(w, terms, strict=True)], axis=(0, 2))
