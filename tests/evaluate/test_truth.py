"""The truth: between its instants, from files, and with other markers than the result."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from stick_figures import MODEL, POSE, START, at, person, seen

from hiros_mcap.body.rotations import rotate
from hiros_mcap.errors import ConfigError, HirosError
from hiros_mcap.evaluate import Truth, evaluate, load_truth
from hiros_mcap.evaluate.logs import Channel, evaluate_channels
from hiros_mcap.evaluate.remarks import notes_of
from hiros_mcap.skeletons import Frame, SkeletonModel

CSV = """time,person,marker,x,y,z
0.0,1,Pelvis,0,0,1
0.0,1,Neck,0,0,1.5
0.5,1,Pelvis,0.1,0,1
0.5,2,Neck,3,0,1.5
"""
TRC = (
    "PathFileType\t4\t(X/Y/Z)\ta.trc\n"
    "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\n"
    "100\t100\t2\t2\tmm\n"
    "Frame#\tTime\tPELVIS\t\t\tLWrist\t\t\n"
    "\t\tX1\tY1\tZ1\tX2\tY2\tZ2\n"
    "1\t0.00\t100\t200\t300\t1\t2\t3\n"
    "2\t0.01\t110\t200\t300\t\t\t\n"
)

TINY = "time,marker,x,y,z\n" + "".join(
    f"{time},{name},0,{y},1\n"
    for time in (0, 0.1)
    for name, y in (("A", 0), ("B", 0.001), ("C", 0.002))
)
LINKS = """time,person,marker,x,y,z,parent,child,qx,qy,qz,qw
0.0,0,Pelvis,0,0,1,,,,,,
0.0,0,Neck,0,0,1.5,,,,,,
0.0,0,,,,,Pelvis,Neck,0,0,0,1
0.1,0,Pelvis,0,0,1,,,,,,
0.1,0,Neck,0,0,1.5,,,,,,
0.1,0,,,,,Pelvis,Neck,0,0,0.6,0.8
"""


def write(folder, name, text):
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def test_linear_between_instants_and_nothing_over_a_pause():
    second = 1_000_000_000
    poses = {0.0: 0.0, 0.1: 1.0, 2.0: 2.0}
    truth = Truth.of(
        seen([person(x)], START + round(t * second), ids=[0]) for t, x in poses.items()
    )
    assert truth.at(START + second // 20)[0][0, 0, 0] == pytest.approx(0.5)
    assert np.isnan(truth.at(START + second)[0]).all()
    assert truth.at(START + 2 * second)[0][0, 0, 0] == pytest.approx(2.0)


def test_sines_at_50_hz_are_within_a_millimetre_at_the_times_of_30_hz():
    """Somebody who moves 60 cm to and fro once a second; motion capture at 50 Hz."""

    def x(stamp):
        return 0.3 * math.sin(2 * math.pi * (stamp - START) * 1e-9)

    capture = [START + k * 20_000_000 for k in range(101)]
    truth = Truth.of(seen([person(x(stamp))], stamp, ids=[0]) for stamp in capture)
    error = [np.abs(truth.at(at(k))[0][0] - person(x(at(k)))).max() for k in range(60)]
    assert 1e-4 < max(error) < 1e-3


def test_csv_of_two_people(tmp_path):
    truth = load_truth(write(tmp_path, "a.csv", CSV))
    assert truth.people == (1, 2)
    assert truth.model is not None
    assert truth.model.marker_names == ("Pelvis", "Neck")
    assert truth.stamps.tolist() == [0, 500_000_000]
    assert truth.positions[1, 0, 0].tolist() == [0.1, 0, 1]
    assert np.isnan(truth.positions[0, 1]).all()


def test_csv_of_joints_and_link_orientations(tmp_path):
    """A suit of inertial sensors; the same motion scores 0, another link convention its angle."""
    truth = load_truth(write(tmp_path, "a.csv", LINKS)).moved(start=START)
    assert truth.model is not None
    assert (truth.model.link_parents, truth.model.link_children) == ((0,), (1,))
    assert truth.orientations[:, 0, 0].tolist() == [[0, 0, 0, 1], [0, 0, 0.6, 0.8]]
    result = [seen([person()], START + k * 50_000_000, ids=[4], turns=True) for k in range(3)]
    scores = evaluate(result, truth, MODEL)
    turn = 2 * math.degrees(math.asin(0.6))
    assert scores.orientation_error == pytest.approx((0 + turn / 2 + turn) / 3)
    assert set(scores.joints) == {"PELVIS", "NECK"}


def test_trc_in_millimetres_with_a_gap(tmp_path):
    truth = load_truth(write(tmp_path, "a.trc", TRC))
    assert truth.positions[0, 0, 0] == pytest.approx([0.1, 0.2, 0.3])
    assert truth.positions[0, 0, 1] == pytest.approx([0.001, 0.002, 0.003])
    assert np.isnan(truth.positions[1, 0, 1]).all()
    assert truth.stamps.tolist() == [0, 10_000_000]


def test_times_of_files_count_from_the_logs_start(tmp_path):
    truth = load_truth(write(tmp_path, "a.csv", CSV))
    assert truth.moved(2.0, start=START).stamps[0] == START + 2_000_000_000


@pytest.mark.parametrize("begin", [0, 52 * 10**9, 10**17, START])
def test_times_of_a_log_are_absolute(begin):
    """A log from a simulator begins at 0, or at 52 s after 1970."""
    truth = Truth.of([seen([person()], begin, ids=[0])])
    assert truth.moved(start=START).stamps[0] == begin


def test_y_up_becomes_z_up(tmp_path):
    truth = load_truth(write(tmp_path, "a.csv", CSV)).moved(up="y")
    assert truth.positions[0, 0, 0].tolist() == [0, -1, 0]
    assert truth.positions[1, 1, 1].tolist() == [3, -1.5, 0]


@pytest.mark.parametrize(
    ("name", "text", "fault"),
    [
        ("a.csv", "time,x,y,z\n0,1,2,3\n", "line 1: no column marker .there are: time, x, y, z"),
        ("a.csv", "time,marker,x,y\n", "line 1: no column z "),
        ("a.csv", CSV.replace("1.5", "high", 1), "line 3: 'high' is not a number"),
        ("a.csv", CSV + "0.5,2,Neck,3,0,1.5\n", "line 6: Neck twice"),
        ("a.csv", "time,marker,x,y,z\n1,A,0,0,0\n", "two increasing times"),
        ("a.csv", CSV.replace("0.5,2", "0.5,nan"), "line 5: time and person must be numbers"),
        ("a.csv", CSV.replace("0.5,2", "0.5,1.5"), "line 5: time and person must be numbers"),
        ("a.csv", CSV.replace("1.5", "inf", 1), "line 3: 'inf' is not a number"),
        ("a.csv", CSV.replace("0.5,", "1e12,"), "times are seconds"),
        ("a.csv", CSV.replace("0.5,", "500,"), "500 s apart, more than 0.. s; times .* neither mi"),
        ("a.csv", CSV.replace("1.5", "1500").replace("0,1\n", "0,1000\n"), "look like millimetres"),
        ("a.csv", CSV.replace("1.5", "150").replace("0,1\n", "0,100\n"), "look like centimetres"),
        ("a.csv", TINY, r"its people measure 0.002 m; is the unit right\?"),
        ("a.csv", LINKS.replace("qw", "w"), "line 1: no column qw"),
        ("a.csv", LINKS.replace("Neck,0,0,0,1", "Neck,0,0,0,2"), "line 4: .* length 2, not 1"),
        ("a.csv", LINKS.replace("Neck,0,0,0,1", "Nose,0,0,0,1"), "without positions: Nose"),
        ("a.csv", LINKS.replace("Pelvis,Neck,0,0,0,1", ",Neck,0,0,0,1"), "line 4: .* parent and"),
        ("a.csv", LINKS + "0.1,0,,,,,Pelvis,Neck,0,0,0,1\n", "link Pelvis to Neck twice"),
        ("a.csv", LINKS.replace("Neck,0,0,0,1", "Neck,,0,0,1"), "line 4: .* length nan"),
        ("a.trc", TRC + "3\n", "line 8: is cut off"),
        ("a.trc", "hello\n" * 7, "not a TRC file"),
        ("a.trc", TRC.replace("mm", "inch"), "unit 'inch'"),
        ("a.trc", TRC.replace("0.01", ""), "line 7: has no time"),
        ("a.trc", TRC.replace("110", "1x0"), "line 7: '1x0' is not a number"),
    ],
)
def test_faulty_files(tmp_path, name, text, fault):
    path = write(tmp_path, name, text)
    with pytest.raises(ConfigError, match=fault) as caught:
        load_truth(path)
    assert str(path) in str(caught.value)


def test_binary_rubbish_is_an_error(tmp_path):
    for name in ("a.csv", "a.trc", "a.mcap"):
        (tmp_path / name).write_bytes(bytes(range(256)) * 4)
        with pytest.raises(HirosError):
            load_truth(tmp_path / name)


def frames(model=MODEL):
    return [seen([person(0.01 * k)], at(k), ids=[3]) for k in range(30)]


def test_other_marker_sets_are_compared_on_what_they_share():
    """A truth that knows the left wrist and a nose, in names of its own."""
    model = SkeletonModel.of(["Nose", "left_wrist"], [])
    stamps = np.array([at(k) for k in range(30)])
    positions = np.zeros((30, 1, 2, 3))
    positions[:, 0, 1] = [person(0.01 * k)[6] + [0, 0.03, 0] for k in range(30)]
    truth = Truth(stamps, positions, np.full((30, 1, 0, 4), np.nan), (0,), model)
    scores = evaluate(frames(), truth, MODEL)
    assert list(scores.joints) == ["WRIST_LEFT"]
    assert scores.mean == pytest.approx(30)


def links(*ends):
    return SkeletonModel.of(MODEL.marker_names, [(f"{p} {c}", p, c) for p, c in ends])


def test_links_are_compared_by_the_joints_that_they_join():
    ends = [(int(p), int(c)) for p, c in MODEL.links]
    turns = np.random.default_rng(0).normal(size=(1, 1, 7, 4))
    stamps, people = np.array([at(0)]), np.zeros((1, 1, 8, 3))
    truth = Truth(stamps, people, turns, (0,), links(*ends[::-1]))
    np.testing.assert_array_equal(truth.seen_by(MODEL).orientations, turns[:, :, ::-1])


def test_links_that_the_result_lacks_are_counted():
    ends = [(0, 1), (1, 6), (1, 7)]
    truth = Truth(
        np.array([at(0), at(1)]), np.tile(POSE, (2, 1, 1, 1)), np.zeros((2, 1, 3, 4)), (0,),
        links(*ends),
    )  # fmt: skip
    results = evaluate_channels({"/x": Channel("x", frames()[:2], MODEL)}, truth)
    (note,) = notes_of(truth, results)
    assert note == "2 links of the truth join no two joints that the result links"


def test_a_truth_whose_joints_are_those_of_the_result_need_not_name_them():
    results = evaluate_channels({"/x": Channel("x", frames(), MODEL)}, Truth.of(frames()))
    with_names, without = (notes_of(Truth.of(frames(), m), results) for m in (MODEL, None))
    assert with_names == without


def test_where_nobody_was_seen_everybody_is_missing():
    """Frames of nobody have no skeleton model; the truth's counts."""
    empty = SkeletonModel.of([], [])
    nobody = [Frame.empty(0, empty, stamp=at(k), log_time=at(k)) for k in range(30)]
    results = evaluate_channels({"/x": Channel("x", nobody, empty)}, Truth.of(frames(), MODEL))
    assert (results["/x"].scores.missing, results["/x"].model) == (30, MODEL)


def test_nothing_in_common_is_an_error():
    model = SkeletonModel.of(["Nose"], [])
    truth = Truth(np.array([at(0)]), np.zeros((1, 1, 1, 3)), np.zeros((1, 1, 0, 4)), (0,), model)
    with pytest.raises(ConfigError, match="share no marker: Nose against PELVIS"):
        evaluate(frames(), truth, MODEL)


coordinates = st.one_of(st.none(), st.integers(-5000, 5000))


@settings(
    deadline=None, max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(st.lists(st.tuples(*[coordinates] * 6), min_size=2, max_size=6))
def test_trc_and_csv_say_the_same(tmp_path, rows):
    """Two markers in millimetres and in metres; an empty cell is a marker that is not there."""
    head = TRC.splitlines()[:5]
    cells = [["" if c is None else str(c) for c in row] for row in rows]
    lines = [f"{k}\t{k / 100}\t" + "\t".join(row) for k, row in enumerate(cells)]
    trc = load_truth(write(tmp_path, "a.trc", "\n".join([*head, *lines])))
    csv = ["time,marker,x,y,z"]
    for k, row in enumerate(rows):
        metres = ["" if c is None else str(c / 1000) for c in row]
        csv += [
            f"{k / 100},PELVIS,{','.join(metres[:3])}",
            f"{k / 100},LWrist,{','.join(metres[3:])}",
        ]
    same = load_truth(write(tmp_path, "a.csv", "\n".join(csv)))
    np.testing.assert_allclose(trc.positions, same.positions, atol=1e-12)
    np.testing.assert_array_equal(trc.stamps, same.stamps)


@given(st.floats(0, 1), st.floats(-3, 3), st.floats(-3, 3))
@settings(deadline=None)
def test_orientations_between_instants_take_the_shorter_way(share, early, late):
    """About the vertical; q and -q mean the same. Linear interpolation is exact in the middle."""
    quaternions = [[0, 0, math.sin(a / 2), math.cos(a / 2)] for a in (early, late)]
    orientations = np.array(quaternions)[:, None, None]
    stamps = np.array([at(0), at(10)])
    for sign in (1, -1):
        turned = orientations * np.array([1, sign])[:, None, None, None]
        truth = Truth(stamps, np.zeros((2, 1, 1, 3)), turned, (0,))
        (x, y, z, w) = truth.at(at(10 * share))[1][0, 0]
        assert math.hypot(x, y, z, w) == pytest.approx(1)
        way = abs(math.remainder(late - early, 2 * math.pi))
        turn = abs(math.remainder(2 * math.atan2(z, w) - early, 2 * math.pi))
        assert turn <= way + 1e-6
        if way < 3:
            assert turn == pytest.approx(share * way, abs=0.12 * way + 1e-6)


def test_orientations_become_z_up_as_positions_do():
    """A link that lies along y of the file lies along z of the log."""
    identity = np.tile([0.0, 0.0, 0.0, 1.0], (2, 1, 1, 1))
    positions = np.tile([0.0, 1.0, 0.0], (2, 1, 1, 1))
    truth = Truth(np.array([at(0), at(1)]), positions, identity, (0,)).moved(up="y")
    assert rotate(truth.orientations[0, 0, 0], positions[0, 0, 0]) == pytest.approx([0, 0, 1])
    assert truth.positions[0, 0, 0] == pytest.approx([0, 0, 1])


def test_many_positions_at_once_are_those_one_by_one():
    """At instants, between them, in a pause of the truth, before it and after it."""
    stamps = START + np.cumsum([0, 30, 30, 700, 30, 30]) * 1_000_000
    positions = np.random.default_rng(0).normal(size=(6, 2, 3, 3))
    truth = Truth(stamps, positions, np.zeros((6, 2, 0, 4)), (0, 1))
    asked = np.concatenate([stamps, np.arange(START - 10**8, START + 10**9, 7_000_000)])
    rows = np.arange(len(asked)) % 2
    single = np.stack([truth.at(s)[0][row] for s, row in zip(asked.tolist(), rows, strict=True)])
    assert np.array_equal(truth.positions_of(rows, asked), single, equal_nan=True)
    assert 0 < np.isnan(single).mean() < 1
