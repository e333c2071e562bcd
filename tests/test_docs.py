"""The documentation says what is true: pages, links, commands."""

from __future__ import annotations

import importlib.util
import json
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import detector_files
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import hiros_mcap
from hiros_cli.app import run
from hiros_cli.commands import program
from hiros_mcap import open_result
from hiros_mcap.config import Config, settable
from hiros_mcap.io.container import McapReader
from hiros_mcap.io.joints.mapping import DETECTOR_FILES
from hiros_mcap.io.rgb_cameras import placed_cameras, poses_of, read_rgb_cameras

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
PAGES = sorted([ROOT / "README.md", *DOCS.glob("*.md")])

SLOW = {"compare"}
SMALLER = {
    "--seconds 10": "--seconds 1.2",
    "--seconds 30": "--seconds 1.2",
    "--start 2 --end 8": "--start 0.2 --end 0.8",
    "--shift 1.5": "--shift 0.3",
    "demo lab.mcap": "demo demo.mcap",
    "--jobs 4": "--jobs 1",
    "--room 6x5 --cameras 4": "--room 3x3 --cameras 2",
}
WINDOWS = {"--web", "--view", "--connect"}
"""Options that wait for somebody."""


def hook():
    """Return the module with the site's hooks."""
    spec = importlib.util.spec_from_file_location("pages", DOCS / "pages.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def generated():
    """Return the pages that the site's hook makes."""
    pages: dict[str, str] = hook().generated()
    return pages


def test_names_in_docstrings_are_shown_as_code():
    html = "<p>:func:<code>hiros_mcap.process</code>, :class:<code>~a.Frame</code>, :mod:`~b`</p>"
    shown = "<p><code>hiros_mcap.process</code>, <code>a.Frame</code>, b</p>"
    assert hook().on_page_content(html, page=None) == shown


def test_no_two_pages_have_one_title():
    texts = [*generated().values(), *(p.read_text(encoding="utf-8") for p in DOCS.glob("*.md"))]
    titles = [text.removeprefix("# ").splitlines()[0] for text in texts]
    assert len(titles) > 25
    assert len(set(titles)) == len(titles)


def test_the_reference_holds_every_command_parameter_and_public_name():
    pages = generated()
    for name in program().commands:
        assert f"## hiros {name}" in pages["reference/commands.md"]
    assert "Usage: hiros process [OPTIONS] LOG...\n" in pages["reference/commands.md"]
    for section, field in Config.model_fields.items():
        for name in settable(field.default):
            assert f"| `{name}` |" in pages["reference/parameters.md"], section
    for name in set(hiros_mcap.__all__) - {"__version__"}:
        assert f"::: hiros_mcap.{name}\n" in pages["reference/python.md"]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_to_files(page):
    for target in re.findall(r"\]\((?!https?:|#)([^)#]+)", page.read_text(encoding="utf-8")):
        path = page.parent / target
        assert path.exists() or target in generated(), f"{page.name}: {target}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_tables_have_as_many_columns_as_their_heads(page):
    """Another number of them shows as text on the site."""
    text = re.sub(r"`[^`]*`", "", page.read_text(encoding="utf-8"))
    for table in re.findall(r"(?:^\|.*\n)+", text, re.MULTILINE):
        head, rule, *_ = rows = table.splitlines()
        assert set(rule) <= set("|:- "), head
        assert {row.count("|") for row in rows} == {head.count("|")}, head


def commands(page):
    """Return the commands of a page's indented blocks, without `hiros` and remarks."""
    lines = re.findall(r"^    (?:\$ )?hiros (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return [line.split("  #")[0].strip() for line in lines]


def parse(arguments):
    """Take the arguments apart as the program does, and run nothing."""
    command: Any = program()
    while hasattr(command, "commands"):
        command, arguments = command.commands[arguments[0]], arguments[1:]
    command.make_context(command.name, list(arguments))


@pytest.fixture(scope="module")
def laboratory(walking, tmp_path_factory):
    """Return a folder with every file that the pages' commands read."""
    folder = tmp_path_factory.mktemp("laboratory")
    shutil.copytree(ROOT / "sample_data", folder / "sample_data")
    scene = "--people 2 --cameras 3 --action cross --seconds 1.2 --quiet"
    assert run(["simulate", str(folder / "lab.mcap"), *scene.split()]) == 0
    shutil.copy(folder / "lab.mcap", folder / "mocap.mcap")
    result = str(folder / "lab.hiros.mcap")
    assert run(["process", str(folder / "lab.mcap"), "--quiet"]) == 0
    shutil.copy(result, folder / "other.mcap")
    assert run(["export", result, "-o", str(folder / "mocap.trc"), "--person", "0"]) == 0
    assert run(["export", result, "-o", str(folder / "vicon.c3d")]) == 0
    rows = open_result(result).joints()["WRIST_LEFT"].reset_index()
    rows.insert(2, "marker", "WRIST_LEFT")
    rows.columns = ["person", "time", "marker", "x", "y", "z"]
    rows.to_csv(folder / "mocap.csv", index=False)
    write_suite(folder, walking)
    for path in ("recordings/kitchen.mcap", "mocap/kitchen.truth.mcap"):
        (folder / path).parent.mkdir()
        shutil.copy(folder / "kitchen.mcap", folder / path)
    write_import(folder)
    write_films(folder)
    return folder


def write_suite(folder, walking):
    """Write the suite that docs/golden.md shows, with its recordings."""
    page = (DOCS / "golden.md").read_text(encoding="utf-8")
    suite = re.search(r"```toml\n(# suite\.toml.*?)```", page, re.DOTALL)
    assert suite is not None
    (folder / "suite.toml").write_text(suite[1], encoding="utf-8")
    shutil.copy(folder / "lab.mcap", folder / "crossing.mcap")
    shutil.copy(walking, folder / "kitchen.mcap")


def write_import(folder):
    """Write the mapping files that docs/detectors.md shows, and the files that they describe."""
    page = (DOCS / "detectors.md").read_text(encoding="utf-8")
    for name, mapping in re.findall(r"```toml\n# (\w+\.toml)\n(.*?)```", page, re.DOTALL):
        (folder / name).write_text(mapping, encoding="utf-8")
    detector_files.write_all(folder, folder / "lab.mcap")
    head = ",".join(f"{name}_{axis}" for name in ("LSHO", "RSHO", "HEAD") for axis in "xyz")
    rows = [f"{1.7e12 + 33 * i:.0f},1,{i},1400,0,{i + 400},1400,0,200,1700,{i}" for i in range(90)]
    for name in ("left.csv", "right.csv"):
        (folder / name).write_text("\n".join([f"timestamp,id,{head}", *rows]))


def write_films(folder):
    """Write keypoints of four cameras as OpenPose, MMPose and MediaPipe do, and the calibration."""
    log, tables = folder / "filmed.mcap", []
    scene = "--camera rgb --cameras 4 --people 1 --rate 60 --seconds 1.2 --joints halpe-26 --quiet"
    assert run(["simulate", str(log), *scene.split()]) == 0
    with McapReader(log) as reader:
        cameras = read_rgb_cameras(reader)
        tree, _ = placed_cameras(reader, None, cameras)
    for name, pose in poses_of(cameras, tree, tree.common_root([c.name for c in cameras])).items():
        camera = next(c for c in cameras if c.name == name)
        world, number = pose.inverse(), len(tables) + 1
        tables.append(
            f"[cam{number}]\nsize = {list(camera.lens.size)}\n"
            f"matrix = {camera.lens.matrix.tolist()}\n"
            f"distortions = {camera.lens.distortion.tolist()}\n"
            f"rotation = {Rotation.from_quat(world.xyzw).as_rotvec().tolist()}\n"
            f"translation = {world.translation.tolist()}\n"
        )
        write_as_others(folder, number, camera)
        (folder / f"cam{number}_json").mkdir()
        for k, frame in enumerate(camera.frames):
            points = np.nan_to_num(np.dstack([frame.pixels, frame.scores]))
            people = [{"pose_keypoints_2d": person.ravel().tolist()} for person in points]
            text = json.dumps({"people": people})
            (folder / f"cam{number}_json" / f"cam{number}_{k:06}.json").write_text(text)
    (folder / "Calib.toml").write_text("".join(tables))


def write_as_others(folder, number, camera):
    """Write the keypoints of a camera as MMPose and MediaPipe do."""
    mmpose, mediapipe = [], []
    for k, frame in enumerate(camera.frames):
        people = zip(np.nan_to_num(frame.pixels), frame.scores.tolist(), strict=True)
        found = [{"keypoints": p.tolist(), "keypoint_scores": scores} for p, scores in people]
        mmpose.append({"frame_id": k, "instances": found})
        shares = np.zeros((len(frame.pixels), 33, 2))
        shares[:, : camera.model.n_markers] = np.nan_to_num(frame.pixels / camera.lens.size)
        marks = [
            [{"x": x, "y": y, "z": 0.1, "visibility": 0.9} for x, y in p] for p in shares.tolist()
        ]
        mediapipe.append({"timestamp_ms": 1000 * k / 60, "pose_landmarks": marks})
    (folder / f"cam{number}.json").write_text(json.dumps(mmpose))
    (folder / f"cam{number}_landmarks.json").write_text(json.dumps(mediapipe))


def test_every_detector_has_a_recipe():
    (mapping,) = (one for one in program().commands["import"].params if one.name == "mapping")
    recipes = [line for line in commands(DOCS / "detectors.md") if line.startswith("import")]
    for detector in DETECTOR_FILES:
        assert any(f"--mapping {detector}" in line for line in recipes), detector
        assert detector in mapping.help, detector


def test_at_least_one_page_has_commands():
    assert sum(len(commands(page)) for page in PAGES) > 20


@pytest.fixture(scope="module")
def done():
    """Return the commands that ran for another page; once is enough."""
    return set()


@pytest.mark.usefixtures("without_curves", "coarse_plans")
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_run(page, laboratory, done, monkeypatch):
    monkeypatch.chdir(laboratory)
    for line in commands(page):
        if line in done:
            continue
        if " < " in line:
            hiros = f"{shlex.quote(sys.executable)} -m hiros_cli"
            assert subprocess.run(f"{hiros} {line}", shell=True, check=False).returncode == 0, line
            continue
        parse(shlex.split(line))
        smaller = line
        for text, less in SMALLER.items():
            smaller = smaller.replace(text, less)
        arguments = shlex.split(smaller)
        if arguments[0] in SLOW or WINDOWS & set(arguments) or "ws://" in line:
            continue
        if arguments[0] == "view" and "--save" not in arguments:
            arguments += ["--save", "view.rrd"]
        if arguments[0] == "export":
            arguments.append("--force")
        if "suite.toml" in arguments or (page.stem == "many-logs" and "--jobs" not in arguments):
            arguments += ["--jobs", "1"]  # a process of its own takes seconds to start
        assert run(arguments) == 0, line
        done.add(line)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_python_runs(page, laboratory, monkeypatch):
    monkeypatch.chdir(laboratory)
    for code in re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL):
        exec(compile(code, page.name, "exec"), {})
