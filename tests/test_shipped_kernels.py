"""Compiled kernels in a wheel: what uses them, and what does without.

With ``HIROS_WHEEL`` set, the ``python`` on the path is that of an environment with the wheel.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from hiros_mcap import kernels
from hiros_mcap.kernels import shipped
from hiros_mcap.systems import SYSTEMS

ROOT = Path(__file__).parent.parent
LOG = ROOT / "sample_data" / "one_person_walking.mcap"
WHEEL = os.environ.get("HIROS_WHEEL", "")
PYTHON = str(shutil.which("python")) if WHEEL else sys.executable
FITTING = {"sources": "a", "python": "cpython-311", "platform": "linux-x86_64"}

COUNT = """
import sys
from hiros_cli.app import run
log, folder, *systems = sys.argv[1:]
for system in systems:
    assert run(["process", log, "-o", f"{folder}/{system}.mcap", "--system", system, "-q"]) == 0
result = f"{folder}/fuse.mcap"
for command in (
    ["warmup"], ["simulate", f"{folder}/s.mcap", "--seconds", "2"], ["info", result],
    ["plot", result], ["recover", log, "-o", f"{folder}/r.mcap"],
    ["compare", log, "--system", "raw"],
    ["export", result, "-o", f"{folder}/o.csv"], ["export", result, "-o", f"{folder}/o.bvh"],
    ["check", result], ["eval", result, "--truth", log], ["calibrate", "people", log],
    ["view", result, "--save", f"{folder}/o.rrd"],
):
    run(command)
print("numba" in sys.modules)
"""


def is_shipped(python):
    code = "from hiros_mcap.kernels import shipped; print(shipped.usable())"
    done = subprocess.run([python, "-c", code], capture_output=True, text=True, check=True)
    return done.stdout == "True\n"


def files(folder):
    """Return when each file was written, but for what Python compiles of any test at any time."""
    found = [path for path in folder.rglob("*") if "__pycache__" not in path.parts]
    # A folder is written when its first __pycache__ is.
    return {path: path.stat().st_mtime_ns for path in found if path.is_file()}


@pytest.fixture(autouse=True)
def _decided_anew():
    shipped.usable.cache_clear()
    yield
    shipped.usable.cache_clear()


@pytest.fixture
def manifest(tmp_path, monkeypatch):
    """The manifest of kernels that fit, as far as one says."""
    path = tmp_path / "manifest.json"
    path.write_text(json.dumps(FITTING))
    monkeypatch.delenv(shipped.CHOICE, raising=False)
    monkeypatch.setattr(shipped, "MANIFEST", path)
    monkeypatch.setattr(shipped, "identity", lambda: dict(FITTING))
    monkeypatch.setattr(shipped, "_features", lambda: dict.fromkeys(shipped.NEEDS, True))
    return path


@pytest.mark.skipif(
    not (WHEEL or is_shipped(PYTHON)), reason="no compiled kernels; .ci/run has a wheel"
)
def test_no_system_and_no_command_compiles_or_writes_beside_its_results(tmp_path):
    assert is_shipped(PYTHON)
    code = "import hiros_mcap; print(hiros_mcap.__file__)"
    where = subprocess.run([PYTHON, "-c", code], capture_output=True, text=True, check=True)
    package, home = Path(where.stdout.strip()).parent, tmp_path / "home"
    home.mkdir()
    before = files(package)
    environment = {k: v for k, v in os.environ.items() if k not in ("NUMBA_CACHE_DIR", "HOME")}
    done = subprocess.run(
        [PYTHON, "-c", COUNT, LOG, tmp_path, *SYSTEMS],
        env={**environment, "HOME": str(home), "MPLCONFIGDIR": str(tmp_path)},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.splitlines()[-1] == "False", "numba compiles, and costs time"
    assert "compiling kernels" not in done.stderr
    assert files(package) == before
    assert [path.name for path in home.rglob("*") if "hiros" in str(path.relative_to(home))] == []


@pytest.mark.skipif(not shipped.usable(), reason="no compiled kernels; .ci/run has a wheel")
def test_kernels_of_another_source_are_compiled_again(tmp_path):
    package = tmp_path / "hiros_mcap"
    shutil.copytree(ROOT / "hiros_mcap", package)
    manifest = package / shipped.FOLDER.name / shipped.MANIFEST.name
    manifest.write_text(json.dumps({**json.loads(manifest.read_text()), "sources": "other"}))
    code = (
        "from hiros_mcap.kernels import local_line, folder_of; "
        "print(folder_of('hiros_mcap.kernels.local_line'))"
    )
    environment = {**os.environ, "PYTHONPATH": str(tmp_path), "NUMBA_CACHE_DIR": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=environment,
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
    )
    assert list(Path(done.stdout.strip()).glob("*.local_line.*"))


def test_kernels_that_fit_are_used(manifest):
    assert shipped.usable()


@pytest.mark.parametrize("what", FITTING)
def test_kernels_of_another_kind_are_not_used(what, manifest):
    manifest.write_text(json.dumps({**FITTING, what: "other"}))
    assert not shipped.usable()


@pytest.mark.parametrize(
    ("numba", "runs"),
    [
        ("0.59.1", False), ("0.60.0", True), ("0.65.0rc1", True), ("0.68.1", True),
        ("0.69.0", False), ("1.0", False),
    ],
)  # fmt: skip
def test_kernels_run_with_the_versions_of_numba_that_were_tried(numba, runs, manifest, monkeypatch):
    monkeypatch.setattr(shipped, "version", lambda _: numba)
    assert shipped.usable() == runs


@pytest.mark.parametrize("text", ["", "{}", "[]"])
def test_a_damaged_manifest_is_none(text, manifest):
    manifest.write_text(text)
    assert not shipped.usable()


def test_a_processor_without_avx2_compiles(manifest, monkeypatch):
    features = {**dict.fromkeys(shipped.NEEDS, True), "avx2": False}
    monkeypatch.setattr(shipped, "_features", lambda: features)
    assert not shipped.usable()


def test_who_wants_to_compile_does(manifest, monkeypatch):
    monkeypatch.setenv(shipped.CHOICE, "compile")
    assert not shipped.usable()


def test_an_edited_source_is_another_one(tmp_path, monkeypatch):
    package = tmp_path / "hiros_mcap"
    shutil.copytree(ROOT / "hiros_mcap", package)
    monkeypatch.setattr(kernels, "_PACKAGE", package)
    digests = []
    for changed in ("skeletons.py", "stages/track/tracking.py", "stages/track/track.py", ""):
        kernels.digest.cache_clear()
        digests.append(shipped.digest())
        if changed:
            with (package / changed).open("a") as source:
                source.write("# edited\n")
    kernels.digest.cache_clear()
    assert len(set(digests[:3])) == 3
    assert digests[2] == digests[3], "a page has no kernels"


def test_the_library_leaves_the_settings_of_the_process_alone():
    code = (
        "import gc, os, sys, signal, numba\n"
        "def settings():\n"
        "    numbas = {k: v for k, v in vars(numba.config).items() if k.isupper()}\n"
        "    stop = signal.getsignal(signal.SIGTERM), sys.modules.get('scipy', 0)\n"
        "    return numbas, dict(os.environ), gc.isenabled(), gc.get_threshold(), stop\n"
        "before = settings()\n"
        "from hiros_mcap import process\n"
        "from hiros_mcap.kernels import local_line\n"
        "assert settings() == before\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
