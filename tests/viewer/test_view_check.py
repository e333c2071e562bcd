"""Verdicts on a camera's view, by comparison with the result."""

from __future__ import annotations

import numpy as np

from hiros_viewer.poses import Poses
from hiros_viewer.view_check import FAR_OFF, MIRRORED, ViewCheck

FRAME_NS = 33_000_000
MIRROR = np.array([0, 2, 1, 4, 3], np.int32)
PERSON = np.array(
    [[0, 0, 1.7], [-0.25, 0, 1.4], [0.25, 0, 1.4], [-0.15, 0, 0.9], [0.15, 0, 0.9]], float
)[None]
"""(1, 5, 3) head, shoulders, hips."""
AWAY = np.array([0, 0.3, 0])


def detections(*messages, first=0):
    """Messages of a camera, FRAME_NS apart."""
    counts = np.array([len(message) for message in messages])
    stamps = FRAME_NS * np.arange(first, first + len(messages))
    positions = np.concatenate(messages)
    ids = np.full(len(positions), -1)
    return Poses(
        np.stack([stamps, stamps + 5], axis=1), counts, ids, positions, np.ones(positions.shape[:2])
    )


def compared(check, seen, people=PERSON):
    """Compare with the same people at all times."""
    rows = np.tile([0, len(people)], (len(seen), 1))
    return dict(check.compare(seen, people, rows)[1])


def faults_of(detection):
    found = compared(ViewCheck(MIRROR), detections(detection))
    return {kind: bool(rows.any()) for kind, rows in found.items()}


def test_a_mirrored_detection_is_told_from_one_that_is_far_off():
    assert faults_of(PERSON + 0.03) == {MIRRORED: False, FAR_OFF: False}
    assert faults_of(PERSON[:, MIRROR]) == {MIRRORED: True, FAR_OFF: False}
    assert faults_of(PERSON + AWAY) == {MIRRORED: False, FAR_OFF: True}


def test_somebody_else_is_no_fault_and_not_covered():
    check = ViewCheck(MIRROR)
    found = compared(check, detections(PERSON + 3.0))
    assert not any(rows.any() for rows in found.values())
    assert (check.seen, check.people, check.row()[1]) == (0, 1, "-")


def test_coverage_counts_people_of_the_result():
    check = ViewCheck(MIRROR)
    compared(check, detections(PERSON), np.concatenate([PERSON, PERSON + 3.0]))
    compared(check, detections(PERSON[:0]))
    assert check.row()[:2] == ("33%", "0 mm")


def test_each_message_is_compared_with_its_own_instant():
    check, people = ViewCheck(MIRROR), np.concatenate([PERSON, PERSON + 3.0, PERSON + 6.0])
    seen = detections(PERSON + 3.1, PERSON[:0], np.concatenate([PERSON, PERSON + 0.1]))
    distances, _ = check.compare(seen, people, np.array([[1, 3], [0, 3], [0, 1]]))
    np.testing.assert_allclose(distances, [100 * 3**0.5, np.nan, 50 * 3**0.5])
    assert (check.seen, check.people) == (2, 6)


def test_a_fault_lasts_until_it_is_not_seen_any_more():
    """One frame without it is bridged; a single faulty frame later is noise."""
    wrong = [True, True, False, True, True, True, *[False] * 20, True, *[False] * 20]
    messages = [PERSON[:, MIRROR] if is_wrong else PERSON for is_wrong in wrong]
    for size in (1, 3, 50):
        check, spans = ViewCheck(MIRROR), []
        for first in range(0, len(messages), size):
            seen = detections(*messages[first : first + size], first=first)
            spans += check.spans(seen, compared(check, seen))
        spans += check.finish()
        ((kind, start, end),) = spans
        assert (kind, start.tolist()) == (MIRRORED, [0, 5])
        assert end.tolist() == [5 * FRAME_NS, 5 * FRAME_NS + 5]
        assert check.row()[2:] == ("0.2 s", "0.0 s")


def test_a_fault_at_the_end_is_told():
    check = ViewCheck(MIRROR)
    seen = detections(*[PERSON + AWAY] * 6)
    assert list(check.spans(seen, compared(check, seen))) == []
    ((kind, start, end),) = check.finish()
    assert (kind, end[0] - start[0]) == (FAR_OFF, 5 * FRAME_NS)
