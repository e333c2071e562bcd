"""The measures, on cases that can be worked out by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from stick_figures import MODEL, at, person, seen

from hiros_mcap.angles import flexions
from hiros_mcap.evaluate import Truth, evaluate
from hiros_mcap.skeletons import Floats, Frame, SkeletonModel

ARM = SkeletonModel.of(["Neck", "Pelvis", "LShoulder", "LElbow", "LWrist"], [])


def moving(k: float) -> Floats:
    return person(0.3 * math.sin(0.2 * k))


def frames(offset: float = 0.0, late: float = 0.0) -> list[Frame]:
    return [
        seen([moving(k - late) + np.array([0, offset, 0]), person(2)], at(k), ids=[5, 7])
        for k in range(60)
    ]


TRUTH = Truth.of(seen([moving(k), person(2)], at(k), ids=[0, 1]) for k in range(60))


def test_a_perfect_result() -> None:
    scores = evaluate(frames(), TRUTH, MODEL)
    assert scores.mean == pytest.approx(0, abs=1e-9)
    assert (scores.missing, scores.false, scores.switches, scores.frames) == (0, 0, 0, 60)
    assert scores.limb_variation == pytest.approx(0, abs=1e-12)
    assert scores.lag == pytest.approx(0, abs=1)


def test_an_offset_of_one_person_in_two() -> None:
    scores = evaluate(frames(offset=0.02), TRUTH, MODEL)
    assert scores.mean == pytest.approx(10)
    assert scores.deviation == pytest.approx(10)
    assert np.isnan(scores.angle_rmse)  # the figure has no elbows and no knees


def test_a_late_result_has_that_lag() -> None:
    late = [f.select([0]) for f in frames(late=1.5)]
    truth = Truth.of(seen([moving(k)], at(k), ids=[0]) for k in range(60))
    assert evaluate(late, truth, MODEL).lag == pytest.approx(50, abs=2)


def test_who_is_missing_false_or_renamed() -> None:
    result = frames()
    result[10] = result[10].select([1])
    result[20] = seen([moving(20), person(2), person(9)], at(20), ids=[5, 7, 8])
    result[30:] = [f.replace(ids=np.array([6, 7], np.int32)) for f in result[30:]]
    scores = evaluate(result, TRUTH, MODEL)
    assert (scores.missing, scores.false, scores.switches) == (1, 1, 1)


def test_untracked_people_do_not_count() -> None:
    result = [f.replace(ids=np.array([-1, 7], np.int32)) for f in frames()]
    assert evaluate(result, TRUTH, MODEL).missing == 60


def test_jitter_is_the_mean_second_difference() -> None:
    zigzag = [seen([person(0.001 * (-1) ** k)], at(k), ids=[0]) for k in range(60)]
    truth = Truth.of(seen([person()], at(k), ids=[0]) for k in range(60))
    assert evaluate(zigzag, truth, MODEL).jitter == pytest.approx(4)


def test_limb_variation_is_that_of_the_lengths() -> None:
    breathing = [seen([person() * (1 + 0.1 * (-1) ** k)], at(k), ids=[0]) for k in range(60)]
    truth = Truth.of(seen([person()], at(k), ids=[0]) for k in range(60))
    assert evaluate(breathing, truth, MODEL).limb_variation == pytest.approx(0.1)


def test_the_truth_is_interpolated() -> None:
    between = [seen([(moving(k) + moving(k + 1)) / 2], at(k + 0.5), ids=[0]) for k in range(59)]
    truth = Truth.of(seen([moving(k)], at(k), ids=[0]) for k in range(60))
    assert evaluate(between, truth, MODEL).mean == pytest.approx(0, abs=1e-4)


def test_a_right_angle_at_the_elbow() -> None:
    pose = np.array([[0, 0, 1.5], [0, 0, 1], [0, 0.2, 1.4], [0, 0.2, 1.1], [0.3, 0.2, 1.1]])
    shoulder, elbow, *rest = np.degrees(flexions(ARM, pose))
    assert (shoulder, elbow) == (pytest.approx(0), pytest.approx(90))
    assert np.isnan(rest).all()


def test_nothing_in_common_is_an_error() -> None:
    with pytest.raises(ValueError, match="no frame"):
        evaluate([seen([person()], at(1000), ids=[0])], TRUTH, MODEL)
