"""What is said about a camera's view by comparing it with the result."""

from __future__ import annotations

import numpy as np

from hiros_viewer.view_check import FAR_OFF, MIRRORED, FaultySpan, ViewCheck

FRAME_NS = 33_000_000
MIRROR = np.array([0, 2, 1, 4, 3], np.int32)
PERSON = np.array(
    [[0, 0, 1.7], [-0.25, 0, 1.4], [0.25, 0, 1.4], [-0.15, 0, 0.9], [0.15, 0, 0.9]], float
)[None]
"""(1, 5, 3) head, shoulders, hips."""
AWAY = np.array([0, 0.3, 0])


def faults_of(detection: np.ndarray) -> dict[str, bool]:
    found = ViewCheck(MIRROR).compare(np.ascontiguousarray(detection), PERSON)
    return {kind: bool(rows.any()) for kind, rows in found.items()}


def test_a_mirrored_detection_is_told_from_one_that_is_far_off() -> None:
    assert faults_of(PERSON + 0.03) == {MIRRORED: False, FAR_OFF: False}
    assert faults_of(PERSON[:, MIRROR]) == {MIRRORED: True, FAR_OFF: False}
    assert faults_of(PERSON + AWAY) == {MIRRORED: False, FAR_OFF: True}


def test_somebody_else_is_no_fault_and_not_covered() -> None:
    check = ViewCheck(MIRROR)
    found = check.compare(PERSON + 3.0, PERSON)
    assert not any(rows.any() for rows in found.values())
    assert (check.seen, check.people, check.distances) == (0, 1, [])


def test_coverage_counts_people_of_the_result() -> None:
    check = ViewCheck(MIRROR)
    check.compare(PERSON, np.concatenate([PERSON, PERSON + 3.0]))
    check.compare(PERSON[:0], PERSON)
    assert check.row()[:2] == ("33%", "0 mm")


def test_a_fault_lasts_until_it_is_not_seen_any_more() -> None:
    """One frame without it is bridged; a single faulty frame later is noise."""
    check = ViewCheck(MIRROR)
    wrong = [True, True, False, True, True, True, *[False] * 20, True, *[False] * 20]
    spans = []
    for k, is_wrong in enumerate(wrong):
        pose = PERSON[:, MIRROR] if is_wrong else PERSON
        faults = check.compare(np.ascontiguousarray(pose), PERSON)
        spans += check.spans(k * FRAME_NS, faults)
    spans += check.finish()
    assert spans == [FaultySpan(MIRRORED, 0, 5 * FRAME_NS)]
    assert check.row()[2:] == ("0.2 s", "0.0 s")


def test_a_fault_at_the_end_is_told() -> None:
    check = ViewCheck(MIRROR)
    for k in range(6):
        faults = check.compare(PERSON + AWAY, PERSON)
        assert list(check.spans(k * FRAME_NS, faults)) == []
    assert list(check.finish()) == [FaultySpan(FAR_OFF, 0, 5 * FRAME_NS)]
