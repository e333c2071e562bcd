"""Commands print the same numbers of the sample logs as before.

As with golden logs, a difference that is meant is accepted: run the tests with HIROS_BLESS=1, and
look at what changed in the folder ``numbers``.
"""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from hiros_cli.app import run

SAMPLES = Path(__file__).parents[2] / "sample_data"
CROSSING, WALKING = "golden/two_people_crossing.fuse.mcap", "golden/one_person_walking.fuse.mcap"
COMMANDS = {
    "eval": f"eval {CROSSING} --truth two_people_crossing.mcap",
    "eval-aligned": (
        f"eval {WALKING} --truth one_person_walking.mcap --channel /hiros/filtered --align-time"
    ),
    "calibrate-people": "calibrate people two_people_crossing.mcap",
    "calibrate-noise": "calibrate noise one_person_walking.mcap",
    "info": "info two_people_crossing.mcap",
    "info-result": f"info {CROSSING}",
    "plan": "plan --room 4x3 --cameras 3 --people 2",
}


def leaves(value, place=""):
    """Yield what is within JSON, each with its place."""
    if isinstance(value, dict | list):
        items = value.items() if isinstance(value, dict) else enumerate(value)
        for name, each in items:
            yield from leaves(each, f"{place}/{name}")
    else:
        yield place, value


@pytest.mark.usefixtures("coarse_plans")
@pytest.mark.parametrize("name", COMMANDS)
def test_the_numbers_of_the_sample_logs_are_what_they_were(name, capsys, monkeypatch):
    monkeypatch.chdir(SAMPLES)
    run([*COMMANDS[name].split(), "--json"])
    printed, path = capsys.readouterr().out, Path(__file__).parent / "numbers" / f"{name}.json"
    if os.environ.get("HIROS_BLESS"):
        path.write_text(json.dumps(json.loads(printed), indent=1) + "\n", encoding="utf-8")
    found, expected = (
        dict(leaves(json.loads(text))) for text in (printed, path.read_text("utf-8"))
    )
    numbers = {at: value for at, value in expected.items() if isinstance(value, float)}
    assert {at: found.pop(at, None) for at in numbers} == pytest.approx(numbers, rel=1e-3, abs=1e-4)
    assert found == {at: value for at, value in expected.items() if at not in numbers}
