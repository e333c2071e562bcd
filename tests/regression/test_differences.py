"""What differs between two results, in the words of the field; cases made by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from stick_figures import MODEL, at, person, seen

from hiros_mcap.regression.differences import ChannelComparison, compare_frames
from hiros_mcap.regression.tolerances import Tolerances
from hiros_mcap.skeletons import Frame


def frames() -> list[Frame]:
    """Two people, 20 frames."""
    return [seen([person(0.01 * k), person(2)], at(k), ids=[0, 1], turns=True) for k in range(20)]


def compared(new: list[Frame], tolerances: Tolerances | None = None) -> ChannelComparison:
    return compare_frames(new, frames(), MODEL, tolerances, "/hiros/filtered")


def faults(new: list[Frame]) -> list[str]:
    return compared(new).faults(Tolerances())


def test_the_same_is_equal() -> None:
    result = compared(frames())
    assert result.faults(Tolerances()) == []
    assert result.first is None
    assert result.ids == {0: 0, 1: 1}


def test_other_ids_for_the_same_people_are_equal() -> None:
    new = [f.replace(ids=np.array([7, 3], np.int32)) for f in frames()]
    assert compared(new).ids == {0: 7, 1: 3}
    assert faults(new) == []
    assert faults([f.select([1, 0]) for f in frames()]) == []


def test_rounding_is_forgiven_and_a_micrometre_more_is_not() -> None:
    for offset, equal in ((9e-7, True), (1.1e-6, False)):
        new = frames()
        new[5].positions[1, 3, 2] += offset
        assert (faults(new) == []) == equal


def test_one_joint_that_moved_is_named_with_its_frame() -> None:
    new = frames()
    new[5].positions[1, 6] += [0, 0, 0.02]
    new[9].positions[0, 7] += [0, 0, 0.01]
    result = compared(new)
    assert result.faults(Tolerances()) == [
        "positions: up to 20 mm, RMS 1.25 mm; worst WRIST_LEFT 20 mm, WRIST_RIGHT 10 mm, "
        "PELVIS 0 mm, NECK 0 mm, SHOULDER_LEFT 0 mm"
    ]
    assert result.position_rms == pytest.approx(math.sqrt((0.02**2 + 0.01**2) / (20 * 2 * 8)))
    assert result.first is not None
    assert result.first.frame == 5
    assert result.first.seconds == pytest.approx(5 / 30, abs=1e-6)
    assert result.first.what == "WRIST_LEFT of person 1 is off by 20 mm"


def test_a_turned_link() -> None:
    new = frames()
    half = math.radians(0.5) / 2
    new[3].links[0, 2, 3:7] = [0, 0, math.sin(half), math.cos(half)]
    result = compared(new)
    assert result.orientation_max == pytest.approx(0.5)
    assert faults(new)[0].startswith("orientations: up to 0.5 deg; worst SHOULDER_RIGHT 0.5 deg")
    assert result.first is not None
    assert "link SHOULDER_RIGHT of person 0 is off by 0.5 deg" in result.first.what


def test_missing_and_extra_frames() -> None:
    new = frames()
    late = new.pop(4)
    new.append(late.replace(stamp=at(30)))
    result = compared(new)
    assert (result.missing_frames, result.extra_frames) == (1, 1)
    assert faults(new) == ["frames: 1 missing, 1 extra of 20"]
    assert result.first is not None
    assert (result.first.frame, result.first.what) == (4, "the frame is missing")


def test_a_frame_a_nanosecond_late_is_the_same_frame() -> None:
    assert faults([f.replace(stamp=f.stamp + 1) for f in frames()]) == []


def test_a_missing_and_an_extra_person() -> None:
    new = frames()
    new[8] = new[8].select([0])
    new[9] = seen([person(0.09), person(2), person(5)], at(9), ids=[0, 1, 4], turns=True)
    assert faults(new) == [
        "people: person 1 is missing in 1 frames",
        "people: id 4 is extra in 1 frames",
    ]


def test_a_switch_of_ids_is_told_from_somebody_missing() -> None:
    new = [
        f if k < 12 else f.replace(ids=np.array([1, 0], np.int32)) for k, f in enumerate(frames())
    ]
    assert faults(new) == [
        "identity: person 0, otherwise id 0, is id 1 in 8 frames",
        "identity: person 1, otherwise id 1, is id 0 in 8 frames",
    ]
    assert compared(new).first is not None
    assert compared(new).first.what == "person 0 is now id 1"  # type: ignore[union-attr]


def test_joints_that_vanish_and_appear() -> None:
    new, golden = frames(), frames()
    new[2].markers[0, 6] = np.nan
    golden[3].markers[1, 7] = np.nan
    result = compare_frames(new, golden, MODEL)
    assert result.faults(Tolerances()) == [
        "joints: absent in some frames: WRIST_LEFT (1)",
        "joints: new in some frames: WRIST_RIGHT (1)",
    ]


def test_tolerated_shares() -> None:
    new = frames()[1:]
    new[8] = new[8].select([0])
    loose = Tolerances(frames=0.05, people=0.05)
    assert compared(new, loose).faults(loose) == []
    assert len(compared(new).faults(Tolerances())) == 2


def test_empty_channels() -> None:
    assert compare_frames([], [], MODEL).faults(Tolerances()) == []
    assert compare_frames([], frames(), MODEL).missing_frames == 20
    assert compare_frames(frames(), [], MODEL).extra_frames == 20
