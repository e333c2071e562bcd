"""The GitHub Action of action.yml, run step by step in a fresh checkout.

Nothing is downloaded: the install step is left out, and ``hiros`` is the code under test. With
``HIROS_WHEEL=FILE`` the install step runs, too, and ``hiros`` is what it installs; .ci/run does so.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
WHEEL = os.environ.get("HIROS_WHEEL", "")
SUITE = """
[[log]]
name = "walk"
input = "walk.mcap"
golden = "golden/walk.mcap"
"""


def read(text):
    from ruamel.yaml import YAML

    return YAML(typ="safe").load(text)


def action():
    """Return the steps of the action, with the defaults of its inputs, and with hiros as WHEEL."""
    text = (ROOT / "action.yml").read_text(encoding="utf-8")
    for name, given in {**read(text)["inputs"], "hiros": {"default": WHEEL}}.items():
        text = re.sub(rf"\$\{{\{{ inputs\.{name}\b.*?\}}\}}", given["default"], text)
    assert "${{" not in text
    return read(text)["runs"]["steps"]


def shell(command, folder, **variables):
    """Run a command as a step of a workflow runs, with ``hiros`` on the path."""
    path = f"{folder.parent / 'bin'}{os.pathsep}{os.environ['PATH']}"
    return subprocess.run(
        ["bash", "-e", "-o", "pipefail", "-c", command],
        cwd=folder,
        env={**os.environ, "PATH": path, **variables},
        capture_output=True,
        text=True,
        check=False,
    )


def run_steps(checkout):
    """Run the action's shell steps until one fails; return its exit code, and the summaries."""
    summaries = ""
    for number, step in enumerate(step for step in action() if "run" in step):
        if step["run"].startswith("pip install") and not WHEEL:
            continue
        summary = checkout.parent / f"summary-{number}.md"
        summary.write_text("")  # GitHub makes an empty file for each step
        done = shell(step["run"], checkout, GITHUB_STEP_SUMMARY=str(summary), **step["env"])
        summaries += summary.read_text(encoding="utf-8")
        if done.returncode:
            return done.returncode, summaries or done.stderr
    return 0, summaries


@pytest.fixture(scope="module")
def checkout(tmp_path_factory):
    """A clone of a repository with a recording, a suite and a golden log."""
    folder = tmp_path_factory.mktemp("workflow")
    (folder / "bin").mkdir()
    if not WHEEL:
        tool = folder / "bin" / "hiros"
        tool.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m hiros_cli "$@"\n')
        tool.chmod(0o755)
    origin = folder / "origin"
    (origin / "golden").mkdir(parents=True)
    shutil.copy(ROOT / "sample_data" / "one_person_walking.mcap", origin / "walk.mcap")
    (origin / "suite.toml").write_text(SUITE)
    git = "git -c user.name=a -c user.email=a@b.invalid -c init.defaultBranch=main"
    for command in (
        "hiros check suite.toml --bless",
        f"{git} init --quiet && git add . && {git} commit --quiet --message recordings",
        "git clone --quiet . ../checkout",
    ):
        done = shell(command, origin)
        assert done.returncode == 0, done.stderr
    return folder / "checkout"


def test_the_action_runs_as_written(checkout):
    code, summary = run_steps(checkout)
    assert code == 0, summary
    assert "1 of 1 logs as expected" in summary
    assert "| walk | ✅ equal |" in summary
    (artifact,) = (s["with"]["path"] for s in action() if "if" in s)
    assert (checkout / artifact).stat().st_size > 0


def test_a_changed_parameter_fails_the_job_and_is_named_first(checkout):
    (checkout / "suite.toml").write_text(SUITE + 'set = ["fuse.acceleration=300"]\n')
    code, summary = run_steps(checkout)
    assert code == 1
    rows = summary[summary.index("| where | what | was | is |") :].splitlines()
    assert rows[2] == "| configuration | fuse.acceleration | 3.0 | 300.0 |"
    assert rows[3].startswith("| /hiros/filtered | ")


def test_the_documented_workflow_names_inputs_of_the_action():
    page = (ROOT / "docs" / "golden.md").read_text(encoding="utf-8")
    (job,) = read(re.findall(r"```yaml\n(.*?)```", page, re.DOTALL)[0])["jobs"].values()
    (step,) = (step for step in job["steps"] if "hiros" in step.get("uses", ""))
    inputs = read((ROOT / "action.yml").read_text(encoding="utf-8"))["inputs"]
    assert set(step["with"]) <= set(inputs)
