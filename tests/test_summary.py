"""The summary's numbers, and that they are plain JSON."""

from __future__ import annotations

import json
import math

from hiros_mcap.running.summary import CameraSummary, PersonSummary, StageTime, Summary


def a_summary():
    camera = CameraSummary("k1", "/k1", math.nan, 10, 7, {"not decoded": 2, "no transform": 1})
    person = PersonSummary(4, 1_000_000_000, 3_500_000_000, 60, ("k1",))
    return Summary(
        source="in.mcap",
        target="/home/me/out.mcap",
        log_s=12.0,
        wall_s=0.5,
        cameras=(camera,),
        people=(person,),
        stages=(StageTime("track", 0.2),),
    )


def test_times_real_time_is_log_over_wall():
    assert a_summary().times_real_time == 24.0


def test_skipped_messages_are_added_over_reasons():
    assert a_summary().skipped == 3


def test_json_has_derived_numbers_and_no_nan():
    data = json.loads(json.dumps(a_summary().to_dict(), allow_nan=False))
    assert data["people"][0]["seconds"] == 2.5
    assert data["cameras"][0]["rate_hz"] is None
    assert data["times_real_time"] == 24.0


def test_what_an_output_may_hold_has_no_path_and_no_time_taken():
    text = json.dumps(a_summary().reproducible())
    assert "/home" not in text
    assert "wall_s" not in text
    assert "not decoded" in text
