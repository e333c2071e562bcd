"""Systems that packages bring to the command line."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
import zipfile
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest

from hiros_cli.app import run
from hiros_mcap import open_result, plugins, systems
from hiros_mcap.errors import ConfigError

PAGE = Path(__file__).parent.parent / "docs" / "own-system.md"
PROGRAM = [sys.executable, "-m", "hiros_cli"]


def wheel(folder):
    """Build the package of the docs, as a build backend does; return its file."""
    text = PAGE.read_text(encoding="utf-8")
    (code,) = re.findall(r"```python\n# hiros_calm.py\n(.*?)```", text, re.DOTALL)
    (project,) = re.findall(r"```toml\n# pyproject.toml\n(.*?)```", text, re.DOTALL)
    facts = tomllib.loads(project)["project"]
    ((group, points),) = facts["entry-points"].items()
    name, version = facts["name"].replace("-", "_"), facts["version"]
    info = f"{name}-{version}.dist-info"
    files = {
        f"{name}.py": code,
        f"{info}/METADATA": f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n",
        f"{info}/WHEEL": "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
        f"{info}/entry_points.txt": "\n".join([f"[{group}]", *map("=".join, points.items())]),
    }
    files[f"{info}/RECORD"] = "".join(f"{file},,\n" for file in [*files, f"{info}/RECORD"])
    path = folder / f"{name}-{version}-py3-none-any.whl"
    with zipfile.ZipFile(path, "w") as archive:
        for file, content in files.items():
            archive.writestr(file, content)
    return path


@pytest.fixture(scope="module")
def calm(tmp_path_factory):
    """Install the package of the docs into a folder; return the environment that sees it."""
    folder = tmp_path_factory.mktemp("site")
    pip = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--no-index", "--target"]
    subprocess.run([*pip, folder, wheel(tmp_path_factory.mktemp("wheel"))], check=True)
    paths = filter(None, [str(folder), os.environ.get("PYTHONPATH")])
    return {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}


def output(arguments, environment):
    """Run the program in a process of its own."""
    done = subprocess.run(
        [*PROGRAM, *arguments], env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_system_of_the_docs_runs(calm, walking, tmp_path):
    ours, theirs = tmp_path / "ours.mcap", tmp_path / "theirs.mcap"
    output(["process", walking, "-q", "-o", ours], calm)
    output(["process", walking, "-q", "--system", "calm", "-o", theirs], calm)
    optimized = open_result(ours, "/hiros/optimized").motions[0].positions
    smooth, known = open_result(theirs).motions[0].positions, optimized[0]
    for k, measured in enumerate(optimized):
        mean = known + 0.3 * (measured - known)
        known = np.where(np.isnan(mean), measured, mean)
        np.testing.assert_allclose(smooth[k], known, atol=5e-6)


def test_lists_help_and_facts_name_it(calm, walking, tmp_path):
    out = tmp_path / "out.mcap"
    assert re.search(r"calm +fuse, then exponential smoothing +T, TM", output(["systems"], calm))
    assert "Packages bring calm." in " ".join(output(["process", "--help"], calm).split())
    assert "[sides]" in output(["config", "calm"], calm)
    setting = ["--system", "calm", "--set", "track.max_gap=3"]
    output(["process", walking, "-q", "-o", out, *setting], calm)
    assert "changed: track.max_gap = 3" in output(["info", out], calm)


def brought(monkeypatch, *values, name="calm"):
    """Let packages bring systems."""
    points = [EntryPoint(name, value, plugins.SYSTEMS) for value in values]
    monkeypatch.setattr(plugins, "entry_points", lambda group: points * (group == plugins.SYSTEMS))
    plugins.installed.cache_clear()
    systems._installed.cache_clear()


@pytest.fixture(autouse=True)
def _forgotten():
    yield
    plugins.installed.cache_clear()
    systems._installed.cache_clear()


@pytest.mark.parametrize(
    ("value", "fault"),
    [
        ("nowhere:CALM", "cannot be loaded: No module named 'nowhere'"),
        ("sys:exit", "is no hiros_mcap.systems.System"),
        (f"{__name__}:NO_SECTION", "reads 'wind', which is no section of parameters"),
        (f"{__name__}:RAISES", "failed: KeyError: 'hands'"),
        (f"{__name__}:NO_CHAIN", "has the chains T, FT; T, M, O and F are right, in this order"),
    ],
)
def test_a_package_that_fails_is_named_with_the_remedy(value, fault, monkeypatch, walking, capsys):
    brought(monkeypatch, value)
    assert run(["process", str(walking), "--system", "calm", "-q"]) == 2
    line = capsys.readouterr().err
    assert f"the system calm ({value}) of a package without a name {fault}; install a" in line
    assert line.endswith("or uninstall it\n")


RAISES = systems.System("", lambda run: {}["hands"], ("T",), ())
NO_SECTION = systems.System("", dict, ("T",), ("wind",))
NO_CHAIN = systems.System("", dict, ("T", "FT"), ())
NO_CHANNEL = systems.System("", lambda run: {}, ("T",), ())


def test_a_channel_that_is_never_filled_is_an_error(monkeypatch, walking, tmp_path, capsys):
    brought(monkeypatch, f"{__name__}:NO_CHANNEL")
    out = str(tmp_path / "out.mcap")
    assert run(["process", str(walking), "--system", "calm", "-q", "-o", out]) == 2
    assert "system calm fills no channel 'tracked'" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["fuse", "realtime"])
def test_a_name_of_ours_is_refused(name, monkeypatch):
    brought(monkeypatch, f"{__name__}:NO_CHANNEL", name=name)
    with pytest.raises(ConfigError, match="has the name of a system or preset of hiros"):
        systems.system(name)


def test_two_packages_with_one_name_are_refused(monkeypatch):
    brought(monkeypatch, "a:A", "b:B")
    with pytest.raises(ConfigError, match="bring a system called calm; uninstall all but one"):
        systems.system("calm")
    assert run(["process", "--help"]) == 0


def test_a_score_does_not_take_another_system(calm, walking, tmp_path, capsys):
    out = tmp_path / "out.mcap"
    output(["process", walking, "-q", "--system", "calm", "-o", out], calm)
    assert run(["eval", str(out), "--leave-one-out"]) == 2
    assert "its system calm is not installed here" in capsys.readouterr().err
