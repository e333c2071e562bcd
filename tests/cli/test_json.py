"""``--json`` against docs/json.md: every field that is printed is documented, and the reverse."""

from __future__ import annotations

import json
import re
from fnmatch import fnmatchcase
from pathlib import Path

import pytest
from rendered_ball import ball_path, camera_at, centres_of, write_messages

from hiros_cli.app import run
from hiros_cli.output import SCHEMA_VERSIONS
from hiros_mcap.evaluate import comparison

ROOT = Path(__file__).parents[2]
COMMON = {"schema", "version", "warnings"}


def documented():
    """Schema -> its fields; a field that holds others counts with them."""
    fields: dict[str, set[str]] = {}
    schema = ""
    for line in (ROOT / "docs/json.md").read_text().splitlines():
        if line.startswith("## "):
            schema = line[4:-1]
        elif schema and line.startswith("| `"):
            fields.setdefault(schema, set()).update(re.findall(r"`([^`]+)`", line.split(" | ")[0]))
    return fields


def paths(value, path=""):
    """Yield the path of every field of some JSON."""
    if isinstance(value, dict):
        for name, part in value.items():
            here = f"{path}.{name}" if path else name
            yield here
            yield from paths(part, here)
    elif isinstance(value, list):
        for part in value:
            yield from paths(part, f"{path}[]")


def fits(path, field):
    """Whether a path is what a row of the page describes; ``*`` is a key, ``**`` any path."""
    if field.endswith(".**"):
        return any(fnmatchcase(path, glob) for glob in (_glob(field[:-3]), _glob(field[:-3]) + "*"))
    return fnmatchcase(path, _glob(field))


def _glob(field):
    return field.replace("[]", "[[]]")


def is_inside(path, field):
    """Whether a path is a container of what a row describes."""
    parts = [m.end() for m in re.finditer(r"\[\]|[^.\[]+", field)]
    return any(fnmatchcase(path, _glob(field[:end])) for end in parts)


def printed(command, capsys):
    assert run([*command, "--json"]) in (0, 1), command
    data: dict[str, object] = json.loads(capsys.readouterr().out)
    return data


def assert_as_documented(data):
    """Compare the fields of some outputs of one schema with the page."""
    (schema,) = {str(each["schema"]) for each in data}
    assert {each["version"] for each in data} == {SCHEMA_VERSIONS[schema.removeprefix("hiros.")]}
    assert all(isinstance(each["warnings"], list) for each in data)
    real = {path for each in data for path in paths(each)} - COMMON
    fields = documented()[schema]
    unknown = [p for p in real if not any(fits(p, f) or is_inside(p, f) for f in fields)]
    assert not sorted(unknown), f"{schema}: docs/json.md lacks these fields"
    missing = [f for f in fields if "*" not in f and not any(fits(p, f) for p in real)]
    assert not sorted(missing), f"{schema}: docs/json.md has fields that are not printed"


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    out = tmp_path_factory.mktemp("json") / "out.mcap"
    source = ROOT / "sample_data/one_person_walking.mcap"
    assert run(["process", str(source), "-o", str(out), "-q", "--set", "filter.cutoff=3"]) == 0
    return out


def test_process_and_info(walking, result, tmp_path, capsys):
    out = str(tmp_path / "out.mcap")
    assert_as_documented([printed(["process", str(walking), "-o", out], capsys)])
    assert_as_documented([printed(["info", str(log)], capsys) for log in (walking, result)])


def test_eval(walking, result, capsys):
    assert_as_documented([printed(["eval", str(result)], capsys)])
    assert_as_documented([printed(["eval", str(walking), "--leave-one-out"], capsys)])


def test_check(result, capsys):
    golden = ROOT / "sample_data/golden/one_person_walking.mcap"
    assert_as_documented([printed(["check", str(result), "--golden", str(golden)], capsys)])


def test_calibrate(walking, capsys):
    data = printed(["calibrate", "noise", str(walking)], capsys)
    assert_as_documented([data])
    (warning,) = data["warnings"]  # type: ignore[misc]
    assert "somebody moved" in str(warning)


def test_calibrate_people(tmp_path, capsys):
    log = str(tmp_path / "walk.mcap")
    command = ["simulate", log, "--people", "1", "--cameras", "2", "--seconds", "12", "--quiet"]
    assert run(command) == 0
    assert_as_documented([printed(["calibrate", "people", log], capsys)])


@pytest.mark.usefixtures("coarse_plans")
def test_plan(capsys):
    command = ["plan", "--room", "2x1.5", "--cameras", "2"]
    assert_as_documented([printed(command, capsys)])


def test_calibrate_ball(tmp_path, capsys):
    cameras = [camera_at(0.0), camera_at(1.5)]
    log = write_messages(tmp_path / "ball.mcap", centres_of(cameras, ball_path(60)))
    assert_as_documented([printed(["calibrate", "ball", str(log)], capsys)])


def test_recover(walking, tmp_path, capsys):
    damaged = tmp_path / "cut.mcap"
    damaged.write_bytes(walking.read_bytes()[:-30_000])
    assert run(["recover", str(damaged), "--json"]) == 3
    assert_as_documented([json.loads(capsys.readouterr().out)])


def test_compare(walking, capsys, monkeypatch):
    monkeypatch.setattr(  # a process of its own takes seconds to start
        comparison, "run_tasks", lambda do, tasks, _: enumerate(do(*task) for task in tasks)
    )
    systems = ["--system", "raw", "--system", "average"]
    command = ["compare", str(walking), *systems, "--jobs", "1"]
    assert_as_documented([printed(command, capsys)])


def test_export_and_many_logs(result, tmp_path, capsys):
    out = str(tmp_path / "out.csv")
    assert_as_documented([printed(["export", str(result), "-o", out], capsys)])
    command = ["export", str(result), "-o", str(tmp_path / "tables"), "--jobs", "1"]
    assert_as_documented([printed(command, capsys)])


def test_every_schema_is_documented():
    assert set(documented()) == {f"hiros.{name}" for name in SCHEMA_VERSIONS}
