"""hiros beside Pose2Sim: the same keypoints of real films, one table.

    PYTHONPATH=.:cli:schemas:viewer python benchmarks/rgb_peer.py [--cache FOLDER]
        [--demo FOLDER]

The first run installs Pose2Sim 0.10.49 by pip into an environment of its own below the cache, and
fetches what ``film.py`` does. It needs no screen, and no network but pip's. Three recordings of
four cameras, 100 frames at 60 Hz, with the poses that Pose2Sim's own demo has:

- openpose: the keypoints of its demo in 0.4.15 (BODY_25B), or those of ``--demo FOLDER`` with
  ``openpose/cam*_json`` and ``Calib_qualisys.toml``. Cameras 1 and 2 see somebody else far behind.
- Single, Multi: its films of one person and of two, by MediaPipe Pose (``film_detector.py``).

Pose2Sim runs personAssociation, triangulation and filtering with its own parameters. Nothing is
synchronized, as the films are. What it could not triangulate stays a gap; by itself it would repeat
the last value. hiros runs import, process and export. Both are read from their TRC files, and
scored by ``hiros eval``'s measures on twelve joints, each with the poses that it used.

Prints Markdown rows: people found; px between keypoints and result, median of each camera and 95 %
of the worst; variation of the limbs, %; mean second difference, mm; share of the joints of all
frames that are missing, %; CPU s of all commands, compiled kernels and imports included.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from film import JOINTS, KEYPOINTS, PEOPLE, RATE, detected, fetched

from hiros_mcap.body.rotations import Y_UP
from hiros_mcap.evaluate.match import tracks_of
from hiros_mcap.evaluate.reprojection import image_scores
from hiros_mcap.evaluate.smoothness import jitter, limb_variations
from hiros_mcap.io.detectors.body_models import joints_of
from hiros_mcap.io.log import reading
from hiros_mcap.io.rgb_cameras import placed_cameras, poses_of, read_rgb_cameras
from hiros_mcap.skeletons import Floats, Frame, SkeletonModel

PEER = "pose2sim==0.10.49"
PARTS = ("shoulder-elbow", "elbow-wrist", "hip-knee", "knee-ankle")
MODEL = SkeletonModel.of(
    JOINTS,
    [
        (f"{side}_{limb}", *(JOINTS.index(f"{side}_{part}") for part in limb.split("-")))
        for limb in PARTS
        for side in ("left", "right")
    ],
)
PEER_Y_UP = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
"""Of its TRC files: y, z and x of the room."""
FIRST = 1_000_000_000  # ns
RUN_PEER = """
import json, os, sys
from Pose2Sim import Pose2Sim
settings = json.loads(sys.argv[1])
os.chdir(settings["project"]["project_dir"])
for step in (Pose2Sim.personAssociation, Pose2Sim.triangulation, Pose2Sim.filtering):
    step(settings)
"""


class Case(NamedTuple):
    """A recording: folders of keypoints, a calibration, and what Pose2Sim has to be told."""

    name: str
    keypoints: list[Path]
    calibration: Path
    model: str
    people: int


class Result(NamedTuple):
    """What a program made of it."""

    log: Path
    """Of the keypoints, with the poses that it used."""
    people: list[Path]
    """TRC files."""
    y_up: Floats
    cpu: float


def run(*command: object) -> float:
    """Run a command; return its CPU time, s."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    quiet = {**os.environ, "MPLBACKEND": "Agg", "QT_QPA_PLATFORM": "offscreen"}
    done = subprocess.run(
        list(map(str, command)), env=quiet, capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise SystemExit(f"{command[:4]}: {done.stdout[-2000:]}{done.stderr[-2000:]}")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def peer(cache: Path) -> Path:
    """Return the Python that has Pose2Sim."""
    python = cache / "peer" / "bin" / "python"
    if not python.exists():
        subprocess.run([sys.executable, "-m", "venv", cache / "peer"], check=True)
        subprocess.run([python, "-m", "pip", "install", "-q", PEER], check=True)
    return python


def written(pixels: Mapping[str, Floats], folder: Path) -> list[Path]:
    """Write a detector's keypoints as OpenPose does: a folder of each camera."""
    folders = []
    for camera in range(4):
        path = folder / f"cam0{camera + 1}_json"
        path.mkdir(parents=True)
        for t, people in enumerate(pixels[f"pixels_{camera}"]):
            seen = [p.ravel().tolist() for p in people if np.isfinite(p).any()]
            found = [{"pose_keypoints_2d": p} for p in seen]
            (path / f"cam0{camera + 1}_{t:06d}.json").write_text(json.dumps({"people": found}))
        folders.append(path)
    return folders


def cases(cache: Path, demo: Path | None, folder: Path) -> Iterator[Case]:
    """Yield the recordings."""
    python, films, keypoints = fetched(cache)
    pose = demo / "openpose" if demo else keypoints / KEYPOINTS[1]
    calibration = demo or keypoints / KEYPOINTS[1] / ".." / "calibration"
    calibration = calibration / "Calib_qualisys.toml"
    yield Case("openpose", sorted(pose.glob("*_json")), calibration, "BODY_25B", 1)
    for film, people in PEOPLE.items():
        folders = written(detected(python, films, film, cache), folder / film)
        yield Case(film, folders, calibration, "BLAZEPOSE", people)


def by_hiros(case: Case, folder: Path) -> Result:
    """Import, process and export."""
    log, out, trc = (folder / name for name in ("lab.mcap", "lab.hiros.mcap", "lab.trc"))
    hiros = (sys.executable, "-m", "hiros_mcap")
    lenses = ("--calibration", case.calibration, "--rate", RATE)
    cpu = run(*hiros, "import", *case.keypoints, *lenses, "-o", log)
    cpu += run(*hiros, "process", log, "-o", out)
    cpu += run(*hiros, "export", out, "-o", trc, "--rate", RATE)
    return Result(out, sorted(folder.glob("*.trc")), Y_UP, cpu)


def by_peer(case: Case, folder: Path, python: Path, log: Path) -> Result:
    """Run Pose2Sim in a folder of the form that it wants."""
    (folder / "calibration").mkdir(parents=True)
    (folder / "calibration" / "Calib.toml").write_bytes(case.calibration.read_bytes())
    for path in case.keypoints:
        (folder / "pose").mkdir(exist_ok=True)
        (folder / "pose" / path.name).symlink_to(path.resolve())
    settings = {
        "project": {
            "project_dir": str(folder),
            "multi_person": case.people > 1,
            "frame_rate": int(RATE),
        },
        "pose": {"pose_model": case.model},
        "triangulation": {"make_c3d": False, "fill_large_gaps_with": "nan"},
        "filtering": {"display_figures": False, "save_filt_plots": False, "make_c3d": False},
    }
    cpu = run(python, "-c", RUN_PEER, json.dumps(settings))
    return Result(log, sorted(folder.glob("pose-3d/*filt*.trc")), PEER_Y_UP, cpu)


def read_trc(path: Path, y_up: Floats) -> tuple[Floats, Floats]:
    """Return times (T,), s, and the twelve joints (T, 12, 3), m, of the room; NaN = missing."""
    lines = path.read_text().splitlines()
    unit = {"m": 1.0, "mm": 0.001}[lines[2].split("\t")[4]]
    names = [name for name in lines[3].split("\t")[2:] if name]
    cells = [line.split("\t") for line in lines[5:] if line.strip()]
    width = 2 + 3 * len(names)
    rows = np.array([
        [float(cell) if cell.strip() else np.nan for cell in (*row, *[""] * width)[:width]]
        for row in cells
    ])  # fmt: skip
    points = unit * rows[:, 2:].reshape(len(rows), -1, 3) @ y_up
    found = joints_of(names)
    return rows[:, 1], points[:, [found.index(joint) for joint in joints_of(JOINTS)]]


def frames_of(result: Result, first: int) -> list[Frame]:
    """Return all people of a result at its instants; ``first`` is the stamp of the time 0, ns."""
    tracks = [read_trc(path, result.y_up) for path in result.people]
    times, where = np.unique(np.concatenate([times for times, _ in tracks]), return_inverse=True)
    ids = np.repeat(np.arange(len(tracks)), [len(times) for times, _ in tracks])
    points = np.concatenate([points for _, points in tracks])
    frames = []
    for t, time in enumerate(times):
        there = where == t
        stamp = first + round(1e9 * time)
        frame = Frame.empty(int(there.sum()), MODEL, stamp=stamp, frame_id="world")
        frame.ids[:], frame.markers[:, :, :3] = ids[there], points[there]
        frames.append(frame)
    return frames


def cells(case: Case, result: Result) -> Iterator[str]:
    """Yield the cells of a row, in the order of COLUMNS."""
    with reading(result.log) as reader:
        cameras = read_rgb_cameras(reader)
        poses = poses_of(cameras, placed_cameras(reader, None, cameras)[0], "world")
    frames = frames_of(result, min(camera.frames[0].stamp for camera in cameras))
    images = image_scores(cameras, poses, frames, MODEL)
    tracks = tracks_of(frames)
    yield str(len(tracks))
    yield " ".join(f"{image.result.distance.median:.1f}" for image in images)
    yield f"{max(image.result.distance.percentile_95 for image in images):.0f}"
    yield f"{100 * np.nanmean(limb_variations(tracks.values(), MODEL)):.1f}"
    yield f"{np.nanmean(jitter(tracks.values())):.1f}"
    there = sum(int(np.isfinite(f.positions[..., 0]).sum()) for f in frames)
    wanted = len(list(case.keypoints[0].glob("*.json"))) * case.people * len(JOINTS)
    yield f"{100 * (1 - there / wanted):.1f}"
    yield f"{result.cpu:.1f}"


COLUMNS = (
    "people", "px, median by camera", "95 %", "limb CV %", "jitter mm", "missing %", "CPU s"
)  # fmt: skip


def main() -> None:
    cache = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "hiros-film"
    parser = argparse.ArgumentParser()
    parser.add_argument("--cache", type=Path, default=cache, metavar="FOLDER")
    parser.add_argument("--demo", type=Path, metavar="FOLDER")
    given = parser.parse_args()
    given.cache.mkdir(parents=True, exist_ok=True)
    python = peer(given.cache)
    header = ("recording", "program", *COLUMNS)
    print(f"| {' | '.join(header)} |\n|{'---|' * len(header)}")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for case in cases(given.cache, given.demo, folder / "keypoints"):
            own, other = folder / case.name / "hiros", folder / case.name / "peer"
            own.mkdir(parents=True)
            result = by_hiros(case, own)
            results = {
                "hiros": result,
                "Pose2Sim": by_peer(case, other, python, own / "lab.mcap"),
            }
            for program, result in results.items():
                print(f"| {' | '.join((case.name, program, *cells(case, result)))} |", flush=True)


if __name__ == "__main__":
    main()
