"""A real detector on real film, against a near-truth: every system, with 2, 3 and 4 cameras.

    PYTHONPATH=.:cli:schemas:viewer python benchmarks/film.py [--cache FOLDER] [--system NAME ...]
    ... benchmarks/film.py --write FOLDER       the logs, for hiros process and hiros eval

The first run fetches two packages by pip into a folder of its own, by default below the user's
cache: films of four calibrated cameras, and a detector with its models. It needs Python 3.11 or
3.12 for the detector, which runs in an environment of its own (``film_detector.py``).

- The films (pose2sim 0.10.49, BSD-3-Clause): four cameras, 100 frames at 60 Hz; somebody walks on
  a beam and balances. The second film is the same with another person, who was put into it.
  Two longer ones of 6 Hz, test sessions of mprib/caliscope (BSD-2-Clause), cannot be had by pip.
- The detector: MediaPipe Pose 0.10.14, full. Its world landmarks are put into each camera by PnP:
  a real detector's 3D skeletons, whose depth is a guess. Runs of files take them as rays.
- The poses: those of the package are off by two degrees. One bundle adjustment mends them, of the
  keypoints of the first film by OpenPose (pose2sim 0.4.15; soft L1, the scale as given).
- The near-truth: these keypoints of four cameras, triangulated, Butterworth 6 Hz. Its own error is
  the jackknife standard error over the cameras. It is another detector's: 20 to 30 mm of each
  number are that two detectors put hips, shoulders and ankles at different places. So columns also
  stand there by the near-truth of the tested detector itself, "own": it says nothing of
  triangulated keypoints, which it is made of. The second person has no other near-truth.

Prints Markdown rows: mean, SD, 99th percentile, jitter, mm; variation of limbs, %; ids, false and
missing people, changes of id; frames in which somebody's sides are exchanged; share of the joints
within the 68 and 95 % ellipsoids, by both near-truths.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import json
import subprocess
import sys
import tempfile
import xml.etree.ElementTree as Xml
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scenes import Scene

from hiros_mcap.body.intrinsics import Intrinsics
from hiros_mcap.body.rotations import Rigid, from_matrix, nearest_rotation
from hiros_mcap.config import load_config
from hiros_mcap.evaluate.logs import Channel, ChannelResult, evaluate_channels, evaluate_log
from hiros_mcap.evaluate.truth import Truth
from hiros_mcap.io.detectors.body_models import body_model
from hiros_mcap.running.pipeline import process
from hiros_mcap.running.process_options import ProcessOptions
from hiros_mcap.skeletons import Flags, Floats, Frame
from hiros_mcap.systems import chain_of

FILMS = ("pose2sim==0.10.49", "Pose2Sim/Demo_{}Person/videos/cam0{}.mp4")
CALIBRATION = "Pose2Sim/Demo_SinglePerson/calibration/Calib.qca.txt"
KEYPOINTS = ("pose2sim==0.4.15", "Pose2Sim/Demo/pose")
DETECTOR = "mediapipe==0.10.14"
PEOPLE = {"Single": 1, "Multi": 2}
"""Film -> how many people it is of."""
CAMERAS = ("cam1", "cam2", "cam3", "cam4")
RIGS = ((0, 1, 2, 3), (0, 2, 3), (0, 3), (1, 2))
"""Cameras 1 and 2 see from nearly one side."""
SYSTEMS = ("fuse", "hiros", "malaguti", "lee", "fuse-realtime")
MODEL = body_model("mediapipe-33")
SLOTS = {name: slot for slot, name in enumerate(MODEL.marker_names)}
PARTS = ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
JOINTS = [f"{side}_{part}" for part in PARTS for side in ("left", "right")]
"""Of the near-truth, as OpenPose's BODY_25B has them from 5 on."""
TRUNK = [k for k, name in enumerate(JOINTS) if name.endswith(("shoulder", "hip"))]
OF_OPENPOSE, OF_MODEL = [*range(5, 17)], [SLOTS[name] for name in JOINTS]
SEEN = 0.3  # confidence of OpenPose
RATE, CORNER = 60.0, 6.0  # Hz
UNSEEN_PX = 40.0  # what a camera that does not see somebody counts in the search for people
FAR_PX = 30.0
"""A camera is left out of a joint at an instant if its keypoint is farther off, and two remain."""


class Camera(NamedTuple):
    """A calibrated camera."""

    lens: Intrinsics
    rotation: Floats
    """(3, 3) from the world to the camera's optical frame."""
    translation: Floats
    """(3,) m."""

    @property
    def projection(self) -> Floats:
        """(3, 4) for normalized coordinates."""
        return np.column_stack([self.rotation, self.translation])

    @property
    def pose(self) -> Rigid:
        """Of the camera in the world."""
        inverse = self.rotation.T
        return Rigid(from_matrix(inverse[None])[0], -inverse @ self.translation)


def fetched(cache: Path) -> tuple[Path, Path, Path]:
    """Return the detector's Python, and the folders of the films and of the keypoints."""
    python = cache / "detector" / "bin" / "python"
    if not python.exists():
        subprocess.run([sys.executable, "-m", "venv", cache / "detector"], check=True)
        subprocess.run([python, "-m", "pip", "install", "-q", DETECTOR], check=True)
    folders = []
    for requirement, _ in (FILMS, KEYPOINTS):
        folder = cache / requirement.replace("==", "-")
        if not folder.exists():
            download = ("-m", "pip", "download", "-q", "--no-deps", "-d", cache, requirement)
            subprocess.run([python, *download], check=True)
            (wheel,) = cache.glob(f"{folder.name}*.whl")
            with zipfile.ZipFile(wheel) as archive:
                archive.extractall(folder)
        folders.append(folder)
    return python, folders[0], folders[1]


def detected(python: Path, films: Path, film: str, cache: Path) -> Mapping[str, Floats]:
    """Return what the detector makes of a film, as ``film_detector.py`` describes it."""
    out = cache / f"{film}.npz"
    if not out.exists():
        videos = [films / FILMS[1].format(film, k + 1) for k in range(len(CAMERAS))]
        script = Path(__file__).with_name("film_detector.py")
        print(f"detecting people in four films ({film})", file=sys.stderr)
        subprocess.run([python, script, str(PEOPLE[film]), out, *videos], check=True)
    with np.load(out) as arrays:
        return dict(arrays)


def calibrated(path: Path) -> list[Camera]:
    """Read the cameras of a Qualisys calibration."""
    cameras = []
    for node in Xml.parse(path).getroot().iter("camera"):
        place, lens = (
            {key: float(value) for key, value in node.find(name).attrib.items()}  # type: ignore[union-attr]
            for name in ("transform", "intrinsic")
        )
        own = np.array([[place[f"r{row}{column}"] for column in (1, 2, 3)] for row in (1, 2, 3)])
        rotation = np.diag([1.0, -1.0, -1.0]) @ own  # y up and z backwards
        # Sixty-fourths of a pixel.
        fx, fy, cx, cy = (
            lens[f"{name}{axis}"] / 64 for name in ("focalLength", "centerPoint") for axis in "UV"
        )
        names = (
            "radialDistortion1",
            "radialDistortion2",
            "tangentalDistortion1",
            "tangentalDistortion2",
        )
        matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        intrinsics = Intrinsics((1088, 1920), matrix, np.array([lens[name] for name in names]) / 64)
        centre = np.array([place[axis] for axis in "xyz"]) / 1000
        cameras.append(Camera(intrinsics, rotation, -rotation @ centre))
    return cameras


def openpose(folder: Path) -> list[list[Floats]]:
    """Return the keypoints (P, 12, 2) of each camera and frame, px; NaN = not seen."""
    videos = []
    for path in sorted(folder.glob("cam*_json")):
        frames = list[Floats]()
        for file in sorted(path.glob("*.json")):
            people = json.loads(file.read_text())["people"]
            found = [p["pose_keypoints_2d"] for p in people]  # somebody may have none
            points = np.array([p for p in found if p]).reshape(-1, 25, 3)
            points = points[:, OF_OPENPOSE]
            frames.append(np.where(points[..., 2:] > SEEN, points[..., :2], np.nan))
        videos.append(frames)
    return videos


def in_space(cameras: Sequence[Camera], pixels: Floats) -> Floats:
    """(..., 3) points, m, of pixels (..., C, 2): linear triangulation; NaN of fewer than two."""
    flat = pixels.reshape(-1, len(cameras), 2)
    there: Flags = np.asarray(np.isfinite(flat).all(axis=2))
    rows = np.zeros((len(flat), 2 * len(cameras), 4))
    for k, camera in enumerate(cameras):
        xy, p = camera.lens.normalized(flat[:, k]), camera.projection
        for axis in range(2):
            row = xy[:, axis, None] * p[2] - p[axis]
            rows[:, 2 * k + axis] = np.where(there[:, k, None], row, 0.0)
    homogeneous = np.linalg.svd(rows)[2][:, 3]
    points = homogeneous[:, :3] / homogeneous[:, 3:]
    points[there.sum(axis=1) < 2] = np.nan
    return np.asarray(points.reshape(*pixels.shape[:-2], 3))


def off_by(cameras: Sequence[Camera], points: Floats, pixels: Floats) -> Floats:
    """(..., C) px between pixels (..., C, 2) and the points (..., 3), m."""
    seen = [
        camera.lens.pixels(points @ camera.rotation.T + camera.translation) for camera in cameras
    ]
    return np.asarray(np.linalg.norm(np.stack(seen, axis=-2) - pixels, axis=-1))


def robust(cameras: Sequence[Camera], pixels: Floats) -> Floats:
    """(..., 3) points, m; the worst camera of more than two is left out where it is far off."""
    pixels = pixels.copy()
    for _ in range(len(cameras) - 2):
        points = in_space(cameras, pixels)
        off = off_by(cameras, points, pixels)
        worst = np.nanargmax(np.where(np.isnan(off), -1.0, off), axis=-1)[..., None]
        far = np.take_along_axis(np.nan_to_num(off), worst, -1) > FAR_PX
        far &= (~np.isnan(off)).sum(axis=-1, keepdims=True) > 2
        out = far & (np.arange(len(cameras)) == worst)
        pixels[out] = np.nan
    return in_space(cameras, pixels)


def people_of(cameras: Sequence[Camera], videos: Sequence[Sequence[Floats]], people: int) -> Floats:
    """(T, N, C, J, 2) pixels of the same people in all cameras, by the least reprojection error.

    Frames of videos are (P, J, 2). People are ordered by place, as in the frame before.
    """
    from scipy.optimize import linear_sum_assignment

    n, joints = len(videos[0]), videos[0][0].shape[1]
    out = np.full((n, people, len(cameras), joints, 2), np.nan)
    before: Floats | None = None
    nobody = np.full((1, joints, 2), np.nan)
    for t in range(n):
        seen = [np.concatenate([nobody, video[t]]) for video in videos]
        choices = np.array(list(product(*(range(len(found)) for found in seen))))
        choices = choices[(choices > 0).sum(axis=1) > 1]
        sets = np.stack([found[k] for found, k in zip(seen, choices.T, strict=True)], axis=2)
        points = in_space(cameras, sets[:, TRUNK])
        off = np.nanmedian(off_by(cameras, points, sets[:, TRUNK]), axis=1)
        order = np.where(np.isnan(off), UNSEEN_PX, off).mean(axis=1).argsort()
        chosen = list[int]()
        for k in order.tolist():
            same = (choices[chosen] == choices[k]) & (choices[k] > 0)
            if len(chosen) < people and not same.any() and np.isfinite(points[k]).any():
                chosen.append(k)
        places = np.nanmean(points[chosen], axis=1)
        rows = np.arange(len(chosen))
        if before is not None:
            apart = np.linalg.norm(before[:, None] - places, axis=2)
            rows, columns = linear_sum_assignment(np.nan_to_num(apart, nan=10.0))
            chosen, places = [chosen[k] for k in columns], places[columns]
        else:
            before = np.full((people, 3), np.nan)
        before[rows] = places
        out[t, rows] = sets[chosen].swapaxes(1, 2)
    return out


def bundled(cameras: Sequence[Camera], pixels: Floats) -> list[Camera]:
    """Return cameras whose poses fit pixels (T, N, C, J, 2) best; placed and scaled as given."""
    from scipy.optimize import least_squares
    from scipy.sparse import lil_matrix
    from scipy.spatial.transform import Rotation

    seen = pixels[::2].swapaxes(2, 3).reshape(-1, len(cameras), 2)
    seen = seen[np.isfinite(seen[..., 0]).sum(axis=1) > 2]
    which, point = np.nonzero(np.isfinite(seen[..., 0]).T)
    wanted = seen[point, which]
    start = np.concatenate([
        *((Rotation.from_matrix(c.rotation).as_rotvec(), c.translation) for c in cameras),
    ], axis=None)  # fmt: skip
    n = len(start)
    start = np.concatenate([start, robust(cameras, seen).ravel()])

    def posed(values: Floats) -> list[Camera]:
        return [
            camera._replace(rotation=Rotation.from_rotvec(v[:3]).as_matrix(), translation=v[3:])
            for camera, v in zip(cameras, values[:n].reshape(-1, 6), strict=True)
        ]

    def residuals(values: Floats) -> Floats:
        points, out = values[n:].reshape(-1, 3), np.empty(wanted.shape)
        for k, camera in enumerate(posed(values)):
            own = which == k
            at = points[point[own]] @ camera.rotation.T + camera.translation
            out[own] = camera.lens.pixels(at) - wanted[own]
        return out.ravel()

    sparse = lil_matrix((2 * len(which), len(start)), dtype=int)
    for axis in range(2):
        rows = 2 * np.arange(len(which)) + axis
        for i in range(6):
            sparse[rows, 6 * which + i] = 1
        for i in range(3):
            sparse[rows, n + 3 * point + i] = 1
    fit = least_squares(
        residuals, start, jac_sparsity=sparse, loss="soft_l1", f_scale=5.0, x_scale="jac"
    )
    found = posed(fit.x)
    # The people do not tell place and scale of the rig.
    old, new = (np.array([c.pose.translation for c in some]) for some in (cameras, found))
    scale = np.linalg.norm(old - old.mean(axis=0)) / np.linalg.norm(new - new.mean(axis=0))
    turn = nearest_rotation(((new - new.mean(axis=0)).T @ (old - old.mean(axis=0)))[None])[0]
    mended = []
    for camera, centre in zip(found, new, strict=True):
        rotation = camera.rotation @ turn
        place = scale * (centre - new.mean(axis=0)) @ turn + old.mean(axis=0)
        mended.append(camera._replace(rotation=rotation, translation=-rotation @ place))
    return mended


def smooth(points: Floats) -> Floats:
    """Butterworth of order 4 at 6 Hz without lag along the first axis; gaps are interpolated."""
    from scipy.signal import butter, sosfiltfilt

    flat, out = points.reshape(len(points), -1), np.full((len(points), points[0].size), np.nan)
    times, sections = np.arange(len(points)), butter(2, CORNER, fs=RATE, output="sos")
    for k, course in enumerate(flat.T):
        there = np.isfinite(course)
        if there.sum() > 20:
            out[:, k] = sosfiltfilt(sections, np.interp(times, times[there], course[there]))
    return out.reshape(points.shape)


def jackknife(cameras: Sequence[Camera], pixels: Floats) -> Floats:
    """(...) Standard error, m, of triangulated points by leaving each camera out: all axes."""
    n = len(cameras)
    parts = np.stack([
        smooth(robust([c for i, c in enumerate(cameras) if i != k], np.delete(pixels, k, -2)))
        for k in range(n)
    ])  # fmt: skip
    squares = ((parts - parts.mean(axis=0)) ** 2).sum(axis=-1)
    return np.asarray(np.sqrt((n - 1) / n * squares.sum(axis=0)))


def in_model(points: Floats) -> Floats:
    """(T, N, 33, 3) points of all joints of the model from those of the near-truth."""
    out = np.full((*points.shape[:2], MODEL.n_markers, 3), np.nan)
    out[:, :, OF_MODEL] = points
    return out


def frames_of(points: Floats, source: str, ids: bool = True) -> list[Frame]:
    """Return frames of people (T, N, M, 3), m, in the frame ``source``."""
    frames = []
    for t, people in enumerate(points):
        there = np.flatnonzero(np.isfinite(people[..., 0]).any(axis=1))
        frame = Frame.empty(len(there), MODEL, stamp=stamp_of(t), source=source, frame_id=source)
        frame.markers[:, :, :3] = people[there]
        frame.marker_confidences[:] = frame.link_confidences[:] = 1.0
        frame.confidences[:] = 1.0
        if ids:
            frame.ids[:] = there
        frames.append(frame)
    return frames


def stamp_of(t: int) -> int:
    return 1_000_000_000 + round(t * 1e9 / RATE)


def skeletons(camera: Camera, source: str, pixels: Floats, world: Floats) -> list[Frame]:
    """Put world landmarks (T, P, 33, 3), m, before a camera: PnP with their pixels."""
    import cv2

    points = np.full(world.shape, np.nan)
    for t, p in np.argwhere(np.isfinite(world[:, :, 0, 0])).tolist():
        body, seen = world[t, p], np.ascontiguousarray(pixels[t, p, :, :2])
        lens = camera.lens
        found, turn, move = cv2.solvePnP(
            body, seen, lens.matrix, lens.distortion, flags=cv2.SOLVEPNP_SQPNP
        )
        if found:
            points[t, p] = body @ cv2.Rodrigues(turn)[0].T + move.ravel()
    frames = frames_of(points, source, ids=False)
    for frame, seen, people in zip(frames, pixels, points, strict=True):
        frame.marker_confidences[:] = seen[np.isfinite(people[:, 0, 0]), :, 2]
        frame.confidences[:] = frame.marker_confidences.mean(axis=1)
    return frames


class Film(NamedTuple):
    """A film with what is known of it."""

    name: str
    cameras: list[Camera]
    views: list[list[Frame]]
    """The detector's skeletons by camera, in its optical frame."""
    keypoints: list[list[Floats]]
    """Its keypoints (P, 12, 2) by camera and frame, px."""
    truth: Truth
    """By OpenPose."""
    own: Truth
    """By the tested detector."""


def truth_of(points: Floats) -> Truth:
    return Truth.of(frames_of(in_model(points), "world"), MODEL)


def load(cache: Path) -> Iterator[Film]:
    """Yield the films; print how good the poses and the near-truth are."""
    python, films, keypoints = fetched(cache)
    given = calibrated(films / CALIBRATION)
    seen = people_of(given, openpose(keypoints / KEYPOINTS[1]), 1)
    cameras = bundled(given, seen)
    pixels = seen.swapaxes(2, 3)
    points = smooth(robust(cameras, pixels))
    for title, rig in (("given", given), ("bundle's", cameras)):
        off = off_by(rig, robust(rig, pixels), pixels).reshape(-1, len(rig))
        print(
            f"reprojection with the {title} poses, px: median by camera "
            f"{np.nanmedian(off, axis=0).round(1)}, 95 % {np.nanpercentile(off, 95):.1f}"
        )
    error = 1000 * jackknife(cameras, pixels)
    print(
        f"standard error of the near-truth, mm: median {np.nanmedian(error):.0f}, "
        f"95 % {np.nanpercentile(error, 95):.0f}\n"
    )
    for name, people in PEOPLE.items():
        arrays = detected(python, films, name, cache)
        found = [[some[:, OF_MODEL, :2] for some in arrays[f"pixels_{k}"]] for k in range(4)]
        own = smooth(robust(cameras, people_of(cameras, found, people).swapaxes(2, 3)))
        near = own.copy()
        who = np.nanmean(np.linalg.norm(own - points, axis=-1), axis=(0, 2)).argmin()
        near[:, who] = points[:, 0]
        views = [
            skeletons(camera, source, arrays[f"pixels_{k}"], arrays[f"world_{k}"])
            for k, (camera, source) in enumerate(zip(cameras, CAMERAS, strict=True))
        ]
        yield Film(name, cameras, views, found, truth_of(near), truth_of(own))


def written(film: Film, rig: Sequence[int], path: Path) -> None:
    """Write a log of the 3D skeletons of some cameras, with their poses and the near-truth."""
    frames = [frame for k in rig for frame in film.views[k]]
    poses = {CAMERAS[k]: film.cameras[k].pose for k in rig}
    truth = frames_of(film.truth.positions, "world")
    Scene(MODEL, frames, poses, dict.fromkeys(poses, 0.0), truth).write(path, transforms=True)


def systems_of(
    film: Film, rig: Sequence[int], names: Sequence[str], folder: Path
) -> Iterator[tuple[str, ChannelResult, ChannelResult]]:
    """Yield what each system makes of some cameras, by the near-truth and by the own one."""
    log, out = folder / "film.mcap", folder / "out.mcap"
    written(film, rig, log)
    for system in names:
        options = ProcessOptions(system=system, keep=())
        # A run that does not wait cannot find out that depths are guessed.
        live = {"input": {"rays": [CAMERAS[k] for k in rig]}} if system.endswith("realtime") else {}
        config = load_config(system=system, named={"live": live})
        process(log, out, config=config, options=options)
        topic = f"/hiros/{chain_of(system, options.stages)[-1]}"
        (result,), (own,) = (
            evaluate_log(out, truth, [topic]).values() for truth in (film.truth, film.own)
        )
        yield system, result, own


def triangulation(film: Film, rig: Sequence[int]) -> ChannelResult:
    """Return what triangulation at instants and a Butterworth filter make of the keypoints."""
    cameras, people = [film.cameras[k] for k in rig], len(film.truth.people)
    seen = people_of(cameras, [film.keypoints[k] for k in rig], people)
    points = smooth(robust(cameras, seen.swapaxes(2, 3)))
    frames = frames_of(in_model(points), "world")
    (result,) = evaluate_channels({"/x": Channel("film", frames, MODEL)}, film.truth).values()
    return result


COLUMNS = (
    "mean", "SD", "99 %", "jitter", "limb CV %", "ids", "false", "missing", "switches", "sides",
    "in 68 %", "in 95 %", "own: mean", "99 %", "in 68 %", "in 95 %",
)  # fmt: skip


def exchanged(result: ChannelResult) -> int:
    """Count the poses that fit the truth better with hips and shoulders exchanged."""
    slots = {name: slot for slot, name in enumerate(result.model.marker_names)}
    left, right = (
        [slots[f"{side}_{part}"] for part in ("shoulder", "hip")] for side in ("left", "right")
    )
    poses, truth = result.matches.poses, result.matches.true_poses
    ordered, swapped = poses[:, left + right], poses[:, right + left]
    off, mirrored = (np.linalg.norm(p - truth[:, left + right], axis=2) for p in (ordered, swapped))
    return int((np.nanmean(mirrored, axis=1) < np.nanmean(off, axis=1)).sum())


def cells(result: ChannelResult, own: ChannelResult | None) -> Iterator[str]:
    """Yield the cells of a row, in the order of COLUMNS."""
    s = result.scores
    values = (s.mean, s.deviation, s.percentile_99, s.jitter, 100 * s.limb_variation)
    yield from (f"{value:.1f}" for value in values)
    counts = (len(result.matches.tracks), s.false, s.missing, s.switches, exchanged(result))
    yield from (str(count) for count in counts)
    yield from held(result)
    if own is not None:
        yield from (f"{own.scores.mean:.1f}", f"{own.scores.percentile_99:.1f}", *held(own))


def held(result: ChannelResult) -> tuple[str, str]:
    """Return the shares of the joints within the ellipsoids."""
    c = result.coverage
    return (f"{c.within_68:.2f}", f"{c.within_95:.2f}") if c else ("", "")


def main() -> None:
    cache = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "hiros-film"
    parser = argparse.ArgumentParser()
    parser.add_argument("--cache", type=Path, default=cache, metavar="FOLDER")
    parser.add_argument("--system", action="append", metavar="NAME")
    parser.add_argument("--write", type=Path, metavar="FOLDER", help="write the logs; no table")
    given = parser.parse_args()
    given.cache.mkdir(parents=True, exist_ok=True)
    for film in load(given.cache):
        if given.write:
            given.write.mkdir(parents=True, exist_ok=True)
            for rig in RIGS:
                cameras = "".join(str(k + 1) for k in rig)
                written(film, rig, given.write / f"{film.name.lower()}_{cameras}.mcap")
        else:
            table(film, given.system or SYSTEMS)


def table(film: Film, systems: Sequence[str]) -> None:
    """Print a row for each system and rig."""
    header = ["film", "cameras", "system", *COLUMNS]
    print(f"| {' | '.join(header)} |\n|{'---|' * len(header)}")
    for rig in RIGS:
        cameras = " ".join(str(k + 1) for k in rig)
        with tempfile.TemporaryDirectory() as folder:
            for system, *results in systems_of(film, rig, systems, Path(folder)):
                row = (film.name, cameras, system, *cells(*results))
                print(f"| {' | '.join(row)} |", flush=True)
        row = (film.name, cameras, "keypoints, Butterworth", *cells(triangulation(film, rig), None))
        print(f"| {' | '.join(row)} |", flush=True)


if __name__ == "__main__":
    main()
