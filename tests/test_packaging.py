"""The contents of the packages: for an index, an installation and a release."""

from __future__ import annotations

import re
import sys
import tomllib
from pathlib import Path

from ruamel.yaml import YAML

from hiros_cli.app import run
from readme_links import absolute

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
VIEWER = {"matplotlib", "rerun-sdk"}


def test_links_of_the_readme_lead_to_the_repository():
    source = "https://example.org/somebody/hiros"
    text = absolute((ROOT / "README.md").read_text(encoding="utf-8"), source)
    assert f"![Two people crossing, three cameras, in the Rerun viewer]({source}/raw/main/" in text
    targets = re.findall(r"\]\(([^)]+)\)", text)
    assert len(targets) > 20
    assert [target for target in targets if not target.startswith("https://")] == []
    assert absolute("[a](https://b.c) [d](#e)", source) == "[a](https://b.c) [d](#e)"
    assert absolute("[a](b.md)", "") == "[a](b.md)"  # no address yet


def test_no_address_is_a_placeholder():
    paths = [ROOT / "pyproject.toml", *ROOT.glob("*.md"), *ROOT.glob("*.cff")]
    paths += [*(ROOT / "docs").glob("*.md"), *(ROOT / ".github").rglob("*.yml")]
    assert [p.name for p in paths if "OWNER" in p.read_text(encoding="utf-8")] == []


def test_the_classifiers_name_what_was_tried():
    """CI runs these versions of Python; nobody ran hiros on other systems."""
    listed = [line for line in PROJECT["classifiers"] if re.search(r":: 3\.\d|Operating", line)]
    path = ROOT / ".github" / "workflows" / "ci.yml"
    jobs = YAML(typ="safe").load(path.read_text(encoding="utf-8"))["jobs"]
    versions = jobs["run"]["strategy"]["matrix"]["python"]
    assert listed == [
        "Operating System :: POSIX :: Linux",
        *(f"Programming Language :: Python :: {version}" for version in versions),
    ]


def test_wheels_of_all_systems_are_built_and_not_published():
    path = ROOT / ".github" / "workflows" / "wheels.yml"
    text = path.read_text(encoding="utf-8")
    (job,) = YAML(typ="safe").load(text)["jobs"].values()
    assert [name.split("-")[0] for name in job["strategy"]["matrix"]["os"]] == [
        "ubuntu", "windows", "macos",
    ]  # fmt: skip
    assert any("cibuildwheel" in step["uses"] for step in job["steps"])
    assert not re.search("gh-action-pypi|twine upload|gh release", text)
    assert "It has not run anywhere yet" in text


def test_the_small_installation_is_all_but_viewer_and_plots():
    lines = (ROOT / "requirements-small.txt").read_text(encoding="utf-8").splitlines()
    small = [line for line in lines if not line.startswith("#")]
    left_out = [line for line in PROJECT["dependencies"] if re.split("[><=]", line)[0] in VIEWER]
    assert len(left_out) == len(VIEWER)
    assert small == [line for line in PROJECT["dependencies"] if line not in left_out]


def test_the_small_installation_names_what_it_lacks(crossing, tmp_path, monkeypatch, capsys):
    for name in [*sys.modules]:
        if name.partition(".")[0] in ("rerun", "matplotlib", "hiros_viewer"):
            monkeypatch.delitem(sys.modules, name)
    for name in ("rerun", "matplotlib"):
        monkeypatch.setitem(sys.modules, name, None)
    out = tmp_path / "out.mcap"
    assert run(["process", str(crossing), "-o", str(out), "-q"]) == 0
    assert run(["eval", str(out), "-q"]) == 0
    assert run(["export", str(out), "-o", str(tmp_path / "out.csv"), "-q"]) == 0
    assert run(["view", str(out), "--save", str(tmp_path / "out.rrd")]) == 2
    assert "needs the package rerun-sdk, which this installation lacks" in capsys.readouterr().err
    assert run(["plot", str(out), "-o", str(tmp_path / "out.png")]) == 2
    assert capsys.readouterr().err.endswith("lacks: pip install matplotlib\n")


def test_a_release_is_built_checked_and_not_published():
    path = ROOT / ".github" / "workflows" / "release.yml"
    workflow = YAML(typ="safe").load(path.read_text(encoding="utf-8"))
    assert workflow["permissions"] == {"contents": "read"}
    (job,) = workflow["jobs"].values()
    steps = "\n".join(str(step.get("run", step.get("uses"))) for step in job["steps"])
    assert "python -m build" in steps
    assert "twine check --strict" in steps
    assert not re.search("upload .*pypi|gh-action-pypi|twine upload|gh release", steps)
