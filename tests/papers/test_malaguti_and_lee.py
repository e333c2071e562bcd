"""The tables of Malaguti et al. (2019) and Lee et al. (2022) beside ours."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import lee_2022
import malaguti_2019
import numpy as np
import pytest
from lee_2022_gestures import (
    appendix_tables,
    check_gestures,
    gesture_errors,
    gesture_scenes,
    gesture_table,
)
from published import LEE, LEE_CAMERAS, LEE_COLUMNS, LEE_RADII, MALAGUTI, lee_appendix, lee_mean

from hiros_mcap.evaluate.comparison import Entry, Outcome, Task, comparison
from hiros_mcap.evaluate.statistics import PARTS, part_of
from hiros_mcap.simulate.body_model import MARKERS
from hiros_mcap.stages.lee.cluster import LEE_JOINTS

LEE_MARKERS = tuple(dict.fromkeys(joint for _, joint in lee_appendix()))


@pytest.fixture(scope="module")
def scores():
    walking = Path(__file__).parents[2] / "sample_data" / "one_person_walking.mcap"
    found = comparison([Task(walking, Entry("raw"))])[0].scores
    assert found is not None
    return found


def outcome(scores, name, mean):
    parts = {part: replace(stats, mean=mean) for part, stats in scores.parts.items()}
    return Outcome("log", name, ("a",), 0.1, replace(scores, mean=mean, parts=parts))


def outcomes(scores, names, errors):
    return [outcome(scores, name, error) for name, error in zip(names, errors, strict=True)]


def test_the_published_numbers_agree_with_what_the_papers_say_of_them():
    """Means of Malaguti's Table I; Lee's A5 is the mean over the radii."""
    means = np.array(list(MALAGUTI.values())).mean(axis=0)[:, 0]
    assert means == pytest.approx([9.42, 17.66, 15.45, 7.46], abs=0.006)
    assert 1 - means[3] / means[0] == pytest.approx(0.208, abs=0.001)
    assert 1 - means[3] / means[2] == pytest.approx(0.517, abs=0.001)
    radii = np.array(list(LEE_RADII.values())).mean(axis=0)[:, 0]
    assert radii == pytest.approx([pair[0] for pair in LEE["lee"]], abs=0.11)
    for part in range(3):
        errors = [LEE_CAMERAS[n][part][0] for n in (1, 2, 3, 4)]
        assert errors == sorted(errors, reverse=True)


def test_what_lees_text_says_are_the_means_of_his_appendix_with_digits_cut_off():
    parts = [tuple(j for j in LEE_MARKERS if part_of(j) == part) for part in PARTS]
    said = [(f"A5_{100 * r:.0f}", pairs) for r, pairs in LEE_RADII.items()]
    said += [(f"TNOS_{n}", pairs) for n, pairs in LEE_CAMERAS.items()]
    said += [("A1", LEE["lee-a1"])]
    for column, pairs in said:
        means = np.array([lee_mean(column, part) for part in parts])
        assert ((np.array(pairs) <= means + 1e-9) & (np.array(pairs) > means - 0.1)).all(), column


def test_lees_gains_by_gesture():
    """Section 4: elbow and wrist of all gestures and of the squat, knee and ankle of the lunge."""
    for names, gestures, gains in (
        (("ELBOW",), (), (20.1, 23.4, 27.0)),
        (("WRIST",), (), (29.8, 45.4, 51.6)),
        (("ELBOW",), ("squat",), (34.3, 39.3, 42.7)),
        (("KNEE",), ("lunge",), (25.5, 27.7, 27.6)),
        (("ANKLE",), ("lunge",), (28.4, 32.2, 34.5)),
    ):
        joints = tuple(f"{name}_{side}" for name in names for side in ("LEFT", "RIGHT"))
        first = lee_mean("A1", joints, gestures)[0]
        own = [first - lee_mean(f"A{k}_10", joints, gestures)[0] for k in (3, 4, 5)]
        assert own == pytest.approx(gains, abs=0.11)


def test_the_paper_holds_what_it_claims_of_the_gestures():
    assert [claim.holds for claim in check_gestures(lee_appendix())] == [True, True, True]
    swapped = {
        ({"squat": "jump", "jump": "squat"}.get(gesture, gesture), joint): row
        for (gesture, joint), row in lee_appendix().items()
    }
    assert [claim.holds for claim in check_gestures(swapped)] == [True, False, True]


def test_the_layout_of_lees_appendix():
    assert len(lee_appendix()) == 6 * 16
    errors, deviations = appendix_tables(lee_appendix())
    assert len(errors.rows) == len(deviations.rows) == 2 * 6 * 16
    assert errors.rows[0][:5] == ("hands_up_down", "PELVIS", "30.40", "31.09", "31.09")
    assert errors.rows[1][1:] == ("paper", *errors.rows[0][2:])
    assert gesture_table(lee_appendix()).rows[8] == (
        "squat", "A1", "42.6 (12.1) [42.6 (12.1)]", "113.5 (56.3) [113.5 (56.3)]",
        "38.7 (17.7) [38.7 (17.7)]",
    )  # fmt: skip


def test_six_gestures_in_four_directions_for_real(tmp_path):
    scenes = list(gesture_scenes())
    assert len(scenes) == 24
    logs = lee_2022.simulated(tmp_path, scenes[12:13], seconds=1.0)
    errors = gesture_errors(logs, jobs=1)
    assert set(errors) == {("lunge", joint) for joint in LEE_MARKERS}
    assert all(set(row) == set(LEE_COLUMNS) for row in errors.values())
    assert errors["lunge", "WRIST_LEFT"]["A5_10"][0] > errors["lunge", "PELVIS"]["A5_10"][0] > 0


def test_the_order_of_malagutis_table_1(scores):
    names = ("malaguti", "raw", "openptrack", "maf")
    for errors, holds in (((10, 11, 12, 13), True), ((10, 12, 11, 13), False)):
        (claim,) = malaguti_2019.check_claims(outcomes(scores, names, errors))
        assert claim.holds == holds
    assert list(malaguti_2019.check_claims(outcomes(scores, names[:2], (10, 11)))) == []


def test_the_order_of_lees_variants_is_that_of_the_printed_digits(scores):
    names = ("lee", "lee-a4", "lee-a3", "lee-a1")
    for errors, holds in (((10, 9.96, 12, 13), True), ((10, 9.94, 12, 13), False)):
        (claim,) = lee_2022.check_claims(outcomes(scores, names, errors))
        assert claim.holds == holds


@pytest.mark.parametrize(("errors", "holds"), [((12, 10, 11, 15), True), ((12, 10, 11, 9), False)])
def test_the_best_radius(scores, errors, holds):
    names = [f"lee,cluster.radius={radius:g}" for radius in LEE_RADII]
    (claim,) = lee_2022.check_claims(outcomes(scores, names, errors))
    assert claim.holds == holds


def test_the_error_falls_with_every_camera():
    falling = {"hiros": {1: (30.0, 5.0), 2: (20.0, 4.0), 3: (19.0, 4.0)}}
    rising = {"hiros": {1: (30.0, 5.0), 2: (20.0, 4.0), 3: (20.0, 4.0)}}
    assert [claim.holds for claim in lee_2022.check_cameras(falling)] == [True]
    assert [claim.holds for claim in lee_2022.check_cameras(rising)] == [False]


def test_malagutis_layout(scores):
    names = ("raw", "maf", "openptrack", "malaguti")
    rows = malaguti_2019.error_table(outcomes(scores, names, [50.0] * 4)).rows
    assert rows[0][0] == "log"
    assert rows[0][1].startswith("5.00 +- ")
    assert rows[-1] == (
        "paper: mean", "9.42 +- 8.48", "17.66 +- 9.22", "15.45 +- 7.77", "7.46 +- 4.26",
    )  # fmt: skip
    two = replace(outcome(scores, "malaguti", 20.0), people=2.0)
    times = malaguti_2019.time_table([two]).rows
    assert [row[1] for row in times] == [f"{n * 0.05:.3f}" for n in range(1, 7)]
    assert [row[3] for row in times] == ["13.4", "26.8", "40.2", "53.6", "67.0", "80.4"]
    assert [row[4] for row in times] == ["74.6", "37.3", "24.9", "18.7", "14.9", "12.4"]


def test_lees_layout(scores):
    (row,) = lee_2022.part_table("", [outcome(scores, "lee-a1", 30.0)]).rows
    assert row[0] == "lee-a1"
    assert row[3].startswith("30.0 (")
    assert row[3].endswith("[90.9 (44.9)]")
    for name, published in (
        ("lee", ["60.2 (36.2)]", "51.6 (26.7)]", "53.5 (26.6)]", "58.1 (27.8)]"]),
        ("lee-a4", ["64.8 (40.0)]", "56.5 (31.7)]", "57.6 (31.3)]", "62.1 (32.6)]"]),
    ):
        radii = [outcome(scores, f"{name},cluster.radius={r:g}", 30.0) for r in LEE_RADII]
        upper = [row[3].partition(" [")[2] for row in lee_2022.part_table("", radii).rows]
        assert upper == published
    joints = lee_2022.joint_table([outcome(scores, "lee-a1", 30.0)])
    assert joints.header == ("Joint", "lee-a1")
    assert [row[0] for row in joints.rows] == list(MARKERS)
    cameras = lee_2022.camera_table({"hiros": {1: (30.0, 5.0), 2: (20.0, 4.0)}})
    assert cameras.header == ("System", "1", "2")
    assert cameras.rows[0] == ("hiros", "30.0 (5.0)", "20.0 (4.0)")
    assert cameras.rows[2] == ("paper: upper limbs", "125.6 (64.2)", "103.5 (57.5)")


def test_a_study_for_real_with_lees_sixteen_joints(walking, monkeypatch, capsys):
    entries = tuple(f"lee-a{k},cluster.joints=lee16" for k in (1, 4))
    monkeypatch.setitem(lee_2022.ENTRIES, "variants", entries)
    report = lee_2022.report("variants", [walking], jobs=1)
    names = [row[0] for row in report.tables[1].rows]
    assert sorted(names) == sorted(name.replace("NAVEL", "NAVAL") for name in LEE_JOINTS)
    report.show()
    assert capsys.readouterr().out.count("lee-a1,cluster.joints=lee16") == 2
    assert "Lee et al. 2022: variants" in report.page().html()
