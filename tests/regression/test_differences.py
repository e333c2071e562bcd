"""What differs between two results, in the words of the field; cases made by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from stick_figures import MODEL, at, person, seen

from hiros_mcap.body.limb_table import Limb, LimbTable
from hiros_mcap.regression.differences import (
    ChannelComparison,
    Comparison,
    compare_frames,
    compare_limbs,
)
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


@pytest.mark.parametrize(("degrees", "equal"), [(9e-5, True), (1.1e-4, False)])
def test_orientations_are_equal_up_to_a_ten_thousandth_of_a_degree(
    degrees: float, equal: bool
) -> None:
    new, half = frames(), math.radians(degrees) / 2
    new[3].links[0, 2, 3:7] = [0, 0, math.sin(half), math.cos(half)]
    assert (faults(new) == []) == equal
    assert (compared(new).first is None) == equal


def test_a_quaternion_of_the_other_sign_is_the_same_orientation() -> None:
    new = frames()
    new[3].links[0, 2, 3:7] *= -1
    assert faults(new) == []


def test_orientations_that_vanish_and_appear() -> None:
    new, golden = frames(), frames()
    new[2].links[0, 1] = np.nan
    golden[3].links[1, 2] = np.nan
    result = compare_frames(new, golden, MODEL)
    assert result.faults(Tolerances()) == [
        "joints: absent in some frames: link SHOULDER_LEFT (1)",
        "joints: new in some frames: link SHOULDER_RIGHT (1)",
    ]
    assert result.first is not None
    assert result.first.frame == 2


def limbs(**lengths: float) -> LimbTable:
    """Limb lengths of person 0."""
    return LimbTable({0: {name: Limb(length, 0.0) for name, length in lengths.items()}})


@pytest.mark.parametrize(
    ("now", "fault"),
    [
        (limbs(arm=0.3, leg=0.4), ""),
        (limbs(arm=0.3 + 9e-7, leg=0.4), ""),
        (limbs(arm=0.3, leg=0.4 + 2e-6), "leg of person 0: off by 0.002 mm"),
        (limbs(arm=0.3), "leg of person 0: calibrated in one log only"),
        (limbs(arm=0.3, leg=0.4, foot=0.2), "foot of person 0: calibrated in one log only"),
        (LimbTable(), "lengths: 2 limbs differ"),
    ],
)
def test_limb_lengths(now: LimbTable, fault: str) -> None:
    lengths = compare_limbs(now, limbs(arm=0.3, leg=0.4), {})
    found = Comparison([], lengths=lengths).faults(Tolerances())
    assert bool(found) == bool(fault)
    assert fault in found.get("calibration", [""])[0]


def test_limb_lengths_belong_to_people_not_to_ids() -> None:
    now = LimbTable({7: limbs(arm=0.3).people[0], 0: limbs(arm=0.5).people[0]})
    assert compare_limbs(now, limbs(arm=0.3), {0: 7}) == {(0, "arm"): 0.0}


def test_missing_and_extra_frames() -> None:
    new = frames()
    late = new.pop(4)
    new.append(late.replace(stamp=at(30)))
    result = compared(new)
    assert (result.missing_frames, result.extra_frames) == (1, 1)
    assert faults(new) == ["frames: 1 missing, 1 extra of 20"]
    assert result.first is not None
    assert (result.first.frame, result.first.what) == (4, "the frame is missing")


@pytest.mark.parametrize(
    ("late", "equal"), [(1, True), (-1000, True), (1001, False), (-1001, False)]
)
def test_a_frame_within_a_microsecond_is_the_same_frame(late: int, equal: bool) -> None:
    new = frames()
    new[4] = new[4].replace(stamp=new[4].stamp + late)
    assert faults(new) == ([] if equal else ["frames: 1 missing, 1 extra of 20"])


def test_an_extra_frame_diverges_at_its_own_time() -> None:
    golden = frames()
    extra = golden.pop(6)
    result = compare_frames(frames(), golden, MODEL)
    assert result.faults(Tolerances()) == ["frames: 0 missing, 1 extra of 19"]
    first = result.first
    assert first is not None
    assert (first.frame, first.stamp, first.what) == (5, extra.stamp, "an extra frame")
    assert first.seconds == pytest.approx(6 / 30, abs=1e-6)


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


def test_somebody_30_cm_off_is_somebody_else() -> None:
    for offset, what in ((0.29, "positions: up to 290 mm"), (0.31, "people: person 1 is missing")):
        new = frames()
        new[8].positions[1] += [0, offset, 0]
        assert faults(new)[0].startswith(what)


def test_the_share_of_wrong_people_is_of_all_skeletons() -> None:
    """One of 40 skeletons is missing, one extra in another frame: 5 % are wrong."""
    new = frames()
    new[8] = new[8].select([0])
    new[9] = seen([person(0.09), person(2), person(5)], at(9), ids=[0, 1, 4], turns=True)
    assert compared(new).faults(Tolerances(people=0.05)) == []
    assert len(compared(new).faults(Tolerances(people=0.049))) == 2


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
