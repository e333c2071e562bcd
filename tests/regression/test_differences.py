"""Differences between two results, in the words of the field; cases made by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from stick_figures import MODEL, at, person, seen

from hiros_mcap.regression.differences import compare_frames
from hiros_mcap.regression.quantities import Tolerances


def frames():
    """Two people, 20 frames."""
    return [seen([person(0.01 * k), person(2)], at(k), ids=[0, 1], turns=True) for k in range(20)]


def compared(new, tolerances=None):
    return compare_frames(new, frames(), MODEL, tolerances, "/hiros/filtered")


def found(result, tolerances=None):
    """The differences before and after, without details."""
    differences = result.differences(tolerances or Tolerances())
    return [f"{d.what}: was {d.was}, is {d.now}" for d in differences]


def faults(new):
    return found(compared(new))


def test_the_same_is_equal():
    result = compared(frames())
    assert found(result) == []
    assert result.first is None
    assert result.ids == {0: 0, 1: 1}


def test_other_ids_for_the_same_people_are_equal():
    new = [f.replace(ids=np.array([7, 3], np.int32)) for f in frames()]
    assert compared(new).ids == {0: 7, 1: 3}
    assert faults(new) == []
    assert faults([f.select([1, 0]) for f in frames()]) == []


def test_rounding_is_forgiven_and_a_micrometre_more_is_not():
    for offset, equal in ((9e-7, True), (1.1e-6, False)):
        new = frames()
        new[5].positions[1, 3, 2] += offset
        assert (faults(new) == []) == equal


def test_one_joint_that_moved_is_named_with_its_frame():
    new = frames()
    new[5].positions[1, 6] += [0, 0, 0.02]
    new[9].positions[0, 7] += [0, 0, 0.01]
    result = compared(new)
    (difference,) = result.differences(Tolerances())
    assert difference.what == "positions"
    assert (difference.was, difference.now) == ("2.1, 0.4, 1 m", "2.1, 0.4, 1.02 m")
    assert difference.detail == (
        "WRIST_LEFT of person 1 at 0.167 s; up to 20 mm, RMS 1.25 mm; worst WRIST_LEFT 20 mm, "
        "WRIST_RIGHT 10 mm"
    )
    rms = math.sqrt((0.02**2 + 0.01**2) / (20 * 2 * 8))
    assert result.quantities["positions"].rms == pytest.approx(rms)
    assert result.first is not None
    assert result.first.frame == 5
    assert result.first.seconds == pytest.approx(5 / 30, abs=1e-6)
    assert result.first.what == "WRIST_LEFT of person 1 is off by 20 mm"


def test_a_small_difference_is_shown_with_all_its_digits():
    new = frames()
    new[5].positions[1, 6] += [0, 0, 2e-6]
    (difference,) = compared(new).differences(Tolerances())
    assert (difference.was, difference.now) == ("2.1, 0.4, 1 m", "2.1, 0.4, 1.000002 m")


def test_a_turned_link():
    new = frames()
    half = math.radians(0.5) / 2
    new[3].links[0, 2, 3:7] = [0, 0, math.sin(half), math.cos(half)]
    result = compared(new)
    assert result.quantities["orientations"].largest == pytest.approx(0.5)
    (difference,) = result.differences(Tolerances())
    assert difference.was == "0, 0, 0, 1 (x y z w)"
    assert "link SHOULDER_RIGHT of person 0 at 0.100 s; up to 0.5 deg" in difference.detail
    assert result.first is not None
    assert "link SHOULDER_RIGHT (orientations) of person 0 is off by 0.5 deg" in result.first.what


@pytest.mark.parametrize(("degrees", "equal"), [(9e-5, True), (1.1e-4, False)])
def test_orientations_are_equal_up_to_a_ten_thousandth_of_a_degree(degrees, equal):
    new, half = frames(), math.radians(degrees) / 2
    new[3].links[0, 2, 3:7] = [0, 0, math.sin(half), math.cos(half)]
    assert (faults(new) == []) == equal
    assert (compared(new).first is None) == equal


def test_a_quaternion_of_the_other_sign_is_the_same_orientation():
    new = frames()
    new[3].links[0, 2, 3:7] *= -1
    assert faults(new) == []


def test_orientations_that_vanish_and_appear():
    new, golden = frames(), frames()
    new[2].links[0, 1] = np.nan
    golden[3].links[1, 2] = np.nan
    result = compare_frames(new, golden, MODEL)
    assert [str(d) for d in result.differences(Tolerances())] == [
        ": orientations: was there, is absent (skeletons: link SHOULDER_LEFT (1))",
        ": orientations: was absent, is there (skeletons: link SHOULDER_RIGHT (1))",
    ]
    assert result.first is not None
    assert result.first.frame == 2


def test_missing_and_extra_frames():
    new = frames()
    late = new.pop(4)
    new.append(late.replace(stamp=at(30)))
    result = compared(new)
    assert (result.missing_frames, result.extra_frames) == (1, 1)
    assert faults(new) == ["frames: was 20, is 20"]
    assert result.first is not None
    assert (result.first.frame, result.first.what) == (4, "the frame is missing")


@pytest.mark.parametrize(
    ("late", "equal"), [(1, True), (-1000, True), (1001, False), (-1001, False)]
)
def test_a_frame_within_a_microsecond_is_the_same_frame(late, equal):
    new = frames()
    new[4] = new[4].replace(stamp=new[4].stamp + late)
    assert faults(new) == ([] if equal else ["frames: was 20, is 20"])


def test_an_extra_frame_diverges_at_its_own_time():
    golden = frames()
    extra = golden.pop(6)
    result = compare_frames(frames(), golden, MODEL)
    assert found(result) == ["frames: was 19, is 20"]
    first = result.first
    assert first is not None
    assert (first.frame, first.stamp, first.what) == (5, extra.stamp, "an extra frame")
    assert first.seconds == pytest.approx(6 / 30, abs=1e-6)


def test_a_missing_and_an_extra_person():
    new = frames()
    new[8] = new[8].select([0])
    new[9] = seen([person(0.09), person(2), person(5)], at(9), ids=[0, 1, 4], turns=True)
    assert faults(new) == [
        "person 1: was in 20 frames, is missing in 1 of them",
        "id 4: was not there, is in 1 frames",
    ]


def test_a_switch_of_ids_is_told_from_somebody_missing():
    new = [
        f if k < 12 else f.replace(ids=np.array([1, 0], np.int32)) for k, f in enumerate(frames())
    ]
    assert faults(new) == [
        "identity of person 0: was id 0, is id 1",
        "identity of person 1: was id 1, is id 0",
    ]
    assert compared(new).first is not None
    assert compared(new).first.what == "person 0 is now id 1"  # type: ignore[union-attr]


def test_somebody_30_cm_off_is_somebody_else():
    for offset, what in (
        (0.29, "positions: was 2, 0, 1 m, is 2, 0.29"),
        (0.31, "person 1: was in 20 frames"),
    ):
        new = frames()
        new[8].positions[1] += [0, offset, 0]
        assert faults(new)[0].startswith(what)


def test_the_share_of_wrong_people_is_of_all_skeletons():
    """One of 40 skeletons is missing, one extra in another frame: 5 % are wrong."""
    new = frames()
    new[8] = new[8].select([0])
    new[9] = seen([person(0.09), person(2), person(5)], at(9), ids=[0, 1, 4], turns=True)
    assert found(compared(new), Tolerances(people=0.05)) == []
    assert len(found(compared(new), Tolerances(people=0.049))) == 2


def test_tolerated_shares():
    new = frames()[1:]
    new[8] = new[8].select([0])
    loose = Tolerances(frames=0.05, people=0.05)
    assert found(compared(new, loose), loose) == []
    assert len(faults(new)) == 2


def test_empty_channels():
    assert found(compare_frames([], [], MODEL)) == []
    assert compare_frames([], frames(), MODEL).missing_frames == 20
    assert compare_frames(frames(), [], MODEL).extra_frames == 20
