"""Poses and clocks of RGB cameras from the people whom they film, against the true ones.

PYTHONPATH=.:cli:schemas:viewer:tests python benchmarks/rgb_rig.py demo FOLDER
    keypoints of OpenPose (FOLDER/openpose/*_json) and FOLDER/Calib_qualisys.toml: px by camera
python benchmarks/rgb_rig.py given [SEED ...]
    poses given 1 degree off, and lags of up to 1.9 s: what refine_rig finds, and its time
python benchmarks/rgb_rig.py nothing [SEED ...]
    no poses, and the same lags: what rig_from_people finds in 30 s, after the size
python benchmarks/rgb_rig.py solvers
    the same bundle adjustment by our own steps, by scipy and by pyceres: time, robust loss
"""

from __future__ import annotations

import json
import sys
import time
import tomllib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rays.filmed import around, film, turned, walking

from hiros_mcap.body.intrinsics import Intrinsics
from hiros_mcap.body.rotations import Rigid, from_vector, to_matrix
from hiros_mcap.kernels.ray_equations import CAUCHY, UNKNOWNS, RayCameras, RayPoints, ray_loss
from hiros_mcap.rays.bundle import (
    Bundle,
    _descend,
    adjust,
    cameras_at,
    placed,
    poses_of,
    standard_errors,
    triangulated,
)
from hiros_mcap.rays.image_tracks import instants_of, sample_images, views_of
from hiros_mcap.rays.keypoints import KeypointFrame
from hiros_mcap.rays.matching import joints_of, match
from hiros_mcap.rays.relative_pose import rig_from_people
from hiros_mcap.rays.rig_refinement import refine_rig
from hiros_mcap.skeletons import Floats, Stamps

NOISE_PX = 5.0
Frames = dict[str, list[KeypointFrame]]
Lenses = dict[str, Intrinsics]
Poses = dict[str, Rigid]


class Problem(NamedTuple):
    """Rays of people, and cameras about right."""

    points: RayPoints
    rows: Stamps
    instants: Floats
    cameras: RayCameras
    focals: Floats

    @property
    def free(self) -> np.ndarray:
        free = np.ones((len(self.focals), UNKNOWNS), np.bool_)
        free[:, 6] = False
        return free


def problem_of(frames: Frames, lenses: Lenses, given: Poses, instants: int = 100) -> Problem:
    views, none = views_of(frames, lenses), np.zeros(len(given))
    cameras = cameras_at([given[name] for name in frames])
    at = instants_of(views, instants, none)
    samples = sample_images(views, at, none)
    points, rows = joints_of(samples, match(samples, cameras, 0.08), len(given))
    return Problem(points, rows, at, cameras, np.array([view.focal for view in views]))


def openpose(folder: Path) -> tuple[Frames, Lenses, Poses]:
    tables = tomllib.loads((folder / "Calib_qualisys.toml").read_text())
    frames, lenses, poses = {}, {}, {}
    for c, path in enumerate(sorted(folder.glob("openpose/*_json"))):
        table, name = tables[f"cam_0{c + 1}"], path.name.removesuffix("_json")
        size = int(table["size"][0]), int(table["size"][1])
        lenses[name] = Intrinsics(size, np.array(table["matrix"]), np.array(table["distortions"]))
        turn, shift = (np.array(table[key]) for key in ("rotation", "translation"))
        poses[name] = Rigid(from_vector(turn), shift).inverse()
        frames[name] = []
        for k, file in enumerate(sorted(path.glob("*.json"))):
            people = json.loads(file.read_text())["people"]
            numbers = np.array([p["pose_keypoints_2d"] for p in people]).reshape(len(people), -1, 3)
            numbers[numbers[..., 2] <= 0.0] = np.nan
            stamp = round(1e9 * k / 60)
            scores = np.nan_to_num(numbers[..., 2])
            frames[name].append(KeypointFrame(name, stamp, stamp, numbers[..., :2], scores))
    return frames, lenses, poses


def pixels(bundle: Bundle) -> str:
    """Median and 95 % by camera, px, of joints that three cameras see."""
    some = bundle.distances[np.count_nonzero(bundle.points.weights > 0.0, axis=1) > 2]
    return "  ".join(f"{a:.1f}/{b:.1f}" for a, b in np.nanpercentile(some, [50, 95], axis=0).T)


def demo(folder: str) -> None:
    frames, lenses, given = openpose(Path(folder))
    problem = problem_of(frames, lenses, given, instants=50)
    still = np.zeros_like(problem.free)
    before = adjust(problem.points, problem.cameras, problem.focals, still)
    begin = time.perf_counter()
    found = adjust(problem.points, problem.cameras, problem.focals, problem.free)
    seconds = time.perf_counter() - begin
    found = placed(found, problem.cameras, ~problem.free.any(axis=1))
    print(f"median/95 % px by camera, given poses: {pixels(before)}")
    print(f"refined in {seconds:.2f} s:            {pixels(found)}")
    blocks = problem.instants[problem.rows[:, 0]] // 0.5
    errors = np.linalg.norm(standard_errors(found, blocks, problem.rows[:, 2])[:, :3], axis=1)
    for pose, error, (name, old) in zip(
        poses_of(found.cameras), errors, given.items(), strict=True
    ):
        metres, degrees = pose.apart(old)
        print(f"{name}: moved by {degrees:.2f} degrees (+- {np.degrees(error):.2f}) {metres:.3f} m")


LAGS = (0.0, 1.0, -0.7, 1.9)
SCENES = (("walk", 1), ("walk", 2), ("cross", 2), ("cross", 4), ("roam", 3), ("free_dynamic", 2))
SPOTS = (("lunge", 1), ("wave", 1), ("jump", 1))


def errors_of(found: list[Rigid], true: list[Rigid], lags: Floats, late: Floats) -> str:
    """Largest errors of poses, when the rig has the right place and size, and of lags."""
    none = np.zeros(len(true), np.bool_)
    cameras, places = cameras_at(found), np.zeros((1, 3))
    fit = Bundle(RayPoints(*(np.zeros(0),) * 3), cameras, places, lags, places, none)
    there = poses_of(placed(fit, cameras_at(true), none).cameras)
    off = np.array([one.apart(other) for one, other in zip(there, true, strict=True)])
    wrong = lags - late - np.median(lags - late)
    return (
        f"{off[:, 1].max():6.2f} degrees {1e3 * off[:, 0].max():6.0f} mm "
        f"{1e3 * np.abs(wrong).max():7.1f} ms"
    )


def scenes(seeds: tuple[str, ...], seconds: float, actions: tuple[tuple[str, int], ...]):
    """Yield films of people before four cameras at 60 Hz, with their names."""
    rig = around()
    for action, people in actions:
        for seed in map(int, seeds or ("1",)):
            truth = walking(people, seconds, seed=seed, action=action)
            yield (
                f"{action} {people}, seed {seed}",
                seed,
                film(truth, rig, rate=60.0, seed=seed, lags=dict(zip(rig, LAGS, strict=True))),
            )


def given(*seeds: str) -> None:
    for name, seed, scene in scenes(seeds, 20.0, (*SCENES, *SPOTS)):
        begin = time.perf_counter()
        found = refine_rig(scene.frames, scene.lenses, turned(scene.poses, 1.0, seed))
        seconds = time.perf_counter() - begin
        late = np.array([found.lags[camera] for camera in scene.poses])
        true = list(scene.poses.values())
        text = errors_of(list(found.poses.values()), true, late, np.array(LAGS))
        said = ", ".join(filter(None, [found.regular and "regular", found.reason]))
        print(f"{name:22}{text} {seconds:5.1f} s  {said}", flush=True)


def nothing(*seeds: str) -> None:
    for name, _, scene in scenes(seeds, 30.0, (*SCENES, ("circle", 2))):
        begin = time.perf_counter()
        found = rig_from_people(views_of(scene.frames, scene.lenses))
        seconds = time.perf_counter() - begin
        if found is None:
            print(f"{name:22}nothing")
            continue
        true = [[*scene.poses.values()][c] for c in found.cameras]
        late = np.array(LAGS)[found.cameras]
        text = errors_of(poses_of(found.fit.bundle.cameras), true, found.fit.lags, late)
        rivalry = f"rivalry {found.rivalry:.2f}"
        print(f"{name:22}{text} {seconds:5.1f} s  {len(true)} cameras, {rivalry}", flush=True)


class Residuals:
    """What scipy and pyceres need: residuals and Jacobians of rays, by numpy."""

    def __init__(self, problem: Problem, rows: Stamps, columns: Stamps) -> None:
        points, cameras = problem.points, problem.cameras
        self.turns, self.shifts = cameras.rotations[columns], cameras.shifts[columns]
        self.rays, self.columns = points.rays[rows, columns], columns
        self.scale = problem.focals[columns] / NOISE_PX
        self.share = np.sqrt(points.weights[rows, columns])

    def __call__(self, steps: Floats, places: Floats) -> tuple[Floats, Floats, Floats]:
        """Residuals (N, 2), Jacobians by step (N, 2, 6) and by place (N, 2, 3)."""
        turn = to_matrix(from_vector(steps[:, :3]))[self.columns]
        rotations = turn @ self.turns
        arms = np.einsum("nij,nj->ni", rotations, places)
        arms += np.einsum("nij,nj->ni", turn, self.shifts)
        x, y, z = (arms + steps[self.columns, 3:]).T
        factor, outer = self.scale * self.share, np.zeros((len(x), 2, 3))
        outer[:, 0, 0] = outer[:, 1, 1] = factor / z
        outer[:, 0, 2], outer[:, 1, 2] = -factor * x / z**2, -factor * y / z**2
        crossed = np.cross(arms[:, None], outer)
        away = factor[:, None] * (np.stack([x, y], axis=1) / z[:, None] - self.rays)
        return away, np.concatenate([crossed, outer], axis=2), outer @ rotations

    def loss(self, away: Floats) -> float:
        squares = (away**2).sum(axis=1) / self.share**2
        return float((self.share**2 * 0.5 * CAUCHY**2 * np.log1p(squares / CAUCHY**2)).sum())


def by_scipy(problem: Problem, start: Floats, whole: Residuals) -> tuple[Floats, Floats]:
    """Least squares with a sparse Jacobian."""
    from scipy.optimize import least_squares
    from scipy.sparse import csr_matrix

    rows, cameras = np.nonzero(problem.points.weights > 0.0)
    n, poses = len(rows), 6 * len(problem.focals)
    columns = np.concatenate(
        [6 * cameras[:, None] + np.arange(6), poses + 3 * rows[:, None] + np.arange(3)], axis=1
    )
    at = np.repeat(np.arange(2 * n), 9), np.repeat(columns, 2, axis=0).ravel()

    def parts(x: Floats) -> tuple[Floats, Floats, Floats]:
        return whole(x[:poses].reshape(-1, 6), x[poses:].reshape(-1, 3)[rows])

    def jacobian(x: Floats) -> Any:
        _, outer, inner = parts(x)
        return csr_matrix((np.concatenate([outer, inner], axis=2).ravel(), at))

    x = np.concatenate([np.zeros(poses), start.ravel()])
    found = least_squares(
        lambda x: parts(x)[0].ravel(), x, jacobian, loss="cauchy", f_scale=CAUCHY, ftol=1e-4
    ).x
    return found[:poses].reshape(-1, 6), found[poses:].reshape(-1, 3)


def by_pyceres(problem: Problem, start: Floats, whole: Residuals) -> tuple[Floats, Floats]:
    """One cost per camera and person at an instant, written with numpy; the loss is within it."""
    import pyceres

    groups = np.unique(problem.rows[:, :2], axis=0, return_inverse=True)[1].ravel()
    steps = np.zeros((len(problem.focals), 6))
    blocks = [np.ascontiguousarray(start[groups == g].ravel()) for g in range(groups.max() + 1)]

    class Person(pyceres.CostFunction):  # type: ignore[misc]
        def __init__(self, camera: int, rows: Stamps) -> None:
            super().__init__()
            self.seen = np.flatnonzero(problem.points.weights[rows, camera] > 0.0)
            self.part = Residuals(problem, rows[self.seen], np.full(len(self.seen), camera))
            self.camera, self.dense = camera, np.zeros((len(self.seen), 2, len(rows), 3))
            self.set_num_residuals(2 * len(self.seen))
            self.set_parameter_block_sizes([6, 3 * len(rows)])

        def Evaluate(self, parameters: Any, residuals: Any, jacobians: Any) -> bool:  # noqa: N802
            moves = np.zeros_like(steps)
            moves[self.camera] = parameters[0]
            places = parameters[1].reshape(-1, 3)[self.seen]
            away, outer, inner = self.part(moves, places)
            squares = (away**2).sum(axis=1) / self.part.share**2
            share = np.sqrt(CAUCHY**2 * np.log1p(squares / CAUCHY**2) / np.maximum(squares, 1e-12))
            residuals[:] = (away * share[:, None]).ravel()
            slope = (1.0 / (1.0 + squares / CAUCHY**2) / share)[:, None, None]
            if jacobians is not None and jacobians[0] is not None:
                jacobians[0][:] = (slope * outer).ravel()
            if jacobians is not None and jacobians[1] is not None:
                self.dense[np.arange(len(self.seen)), :, self.seen] = slope * inner
                jacobians[1][:] = self.dense.ravel()
            return True

    adjustment, costs = pyceres.Problem(), []
    for group, block in enumerate(blocks):
        rows = np.flatnonzero(groups == group)
        for camera in np.flatnonzero((problem.points.weights[rows] > 0.0).any(axis=0)):
            costs.append(Person(int(camera), rows))
            adjustment.add_residual_block(costs[-1], None, [steps[camera], block])
    options, summary = pyceres.SolverOptions(), pyceres.SolverSummary()
    options.linear_solver_type = pyceres.LinearSolverType.SPARSE_SCHUR
    options.logging_type = pyceres.LoggingType.SILENT
    options.function_tolerance, options.num_threads = 1e-4, 1
    pyceres.solve(options, adjustment, summary)
    places = np.empty_like(start)
    places[np.argsort(groups, kind="stable")] = np.concatenate(blocks).reshape(-1, 3)
    return steps, places


def solvers() -> None:
    rig = around()
    scene = film(walking(2, 15.0), rig, rate=60.0)
    problem = problem_of(scene.frames, scene.lenses, turned(rig, 1.5))
    points, start = problem.points, triangulated(problem.points, problem.cameras)
    rows, columns = np.nonzero(points.weights > 0.0)
    whole = Residuals(problem, rows, columns)
    print(f"{len(points.rays)} joints, {len(rows)} rays")

    scaled = problem.cameras._replace(scales=problem.focals / NOISE_PX)
    begin = time.perf_counter()
    cameras, places = _descend(points, scaled, start, problem.free)
    seconds = time.perf_counter() - begin
    loss = ray_loss(points, cameras, places, np.zeros(points.weights.shape))
    print(f"ours        {seconds:.2f} s, loss {loss:.0f}")
    for method in by_scipy, by_pyceres:
        begin = time.perf_counter()
        steps, places = method(problem, start, whole)
        seconds = time.perf_counter() - begin
        loss = whole.loss(whole(steps, places[rows])[0])
        print(f"{method.__name__:12}{seconds:.2f} s, loss {loss:.0f}")


if __name__ == "__main__":
    modes = {"demo": demo, "given": given, "nothing": nothing, "solvers": solvers}
    modes[sys.argv[1]](*sys.argv[2:])
