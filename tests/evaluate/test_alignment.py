"""A truth in another frame and at other times: found from the people, and told."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from stick_figures import MODEL, SECOND, START, at, person, seen

from hiros_cli.app import run
from hiros_mcap.body.rotations import Rigid, from_vector
from hiros_mcap.errors import ConfigError
from hiros_mcap.evaluate import Truth, load_truth
from hiros_mcap.evaluate.alignment import align
from hiros_mcap.evaluate.logs import Channel, evaluate_channels, find_truth
from hiros_mcap.evaluate.remarks import notes_of
from hiros_mcap.evaluate.truth import Alignment
from hiros_mcap.running.pipeline import process

ELSEWHERE = Alignment(Rigid(from_vector(np.array([0.4, -1.1, 2.0])), np.array([3.0, -1.0, 0.6])))
RNG = np.random.default_rng(7)


def walk(t, who=0):
    """Markers of somebody who wanders about without repeating it, and swings the arms."""
    wander = sum(np.sin(w * t + np.array([who, 1 + who])) / (1 + w) for w in (0.31, 0.83, 1.7))
    markers = person(3.0 * who + wander[0], wander[1])
    markers[6:, 0] += np.array([0.2, -0.2]) * np.sin(6.1 * t)
    return markers


def result(people=(0,), frames=300, noise=0.01, still=False):
    """Channels of a result that tracks some people with noise."""
    found = []
    for k in range(frames):
        poses = [walk(0.0 if still else k / 30, who) for who in people]
        noisy = [pose + noise * RNG.standard_normal(pose.shape) for pose in poses]
        found.append(seen(noisy, at(k), ids=[10 + who for who in people]))
    return {"/hiros/filtered": Channel("r.mcap", found, MODEL)}


def truth(people=(0,), frames=600, still=False):
    """The same people at 60 Hz."""
    times = [k / 60 for k in range(frames)]
    poses = [[walk(0.0 if still else t, who) for who in people] for t in times]
    some = [
        seen(p, START + round(t * SECOND), ids=people) for p, t in zip(poses, times, strict=True)
    ]
    return Truth.of(some, MODEL)


def far(one, other):
    """Largest distance, mm, between two truths."""
    return 1000 * np.nanmax(np.linalg.norm(one.positions - other.positions, axis=-1))


@pytest.mark.parametrize("people", [(0,), (0, 1, 2)])
def test_a_truth_in_another_frame_comes_back(people):
    moved = truth(people).aligned(ELSEWHERE)
    found = align(moved, result(people))
    assert far(moved.aligned(found), truth(people)) < 3
    assert found.seconds == 0.0


def test_a_truth_of_one_of_three_finds_that_person():
    moved = truth((1,)).aligned(ELSEWHERE)
    assert far(moved.aligned(align(moved, result((0, 1, 2)))), truth((1,))) < 3


def test_the_time_comes_back_too():
    moved = truth().aligned(ELSEWHERE._replace(seconds=-3.217))
    found = align(moved, result(), time=True)
    assert found.seconds == pytest.approx(3.217, abs=0.004)
    assert far(moved.aligned(found), truth()) < 5


def test_a_short_truth_on_a_clock_of_its_own_is_found():
    moved = truth(frames=600)
    moved = Truth(moved.stamps[180:480], moved.positions[180:480], moved.orientations[180:480])
    moved = moved.aligned(ELSEWHERE._replace(seconds=-86_400.0))
    assert align(moved, result(), time=True).seconds == pytest.approx(86_400.0, abs=0.004)


def test_of_shifts_that_fit_alike_the_one_that_covers_more_is_taken():
    """Somebody walks in a circle of 2.5 s: a round later, the truth fits as well."""

    def around(k, rate):
        turn = 2 * np.pi * k / rate / 2.5
        return person(np.sin(turn), np.cos(turn))

    frames = [seen([around(k, 30)], at(k), ids=[3]) for k in range(300)]
    channels = {"/hiros/filtered": Channel("r.mcap", frames, MODEL)}
    capture = ([around(k, 60)] for k in range(600))
    step = SECOND / 60
    true = Truth.of(
        (seen(p, START + round(k * step), ids=[0]) for k, p in enumerate(capture)), MODEL
    )
    assert align(true.moved(0.4), channels, time=True).seconds == pytest.approx(-0.4, abs=0.01)


def test_outliers_do_not_move_the_truth():
    channels = result()
    for frame in channels["/hiros/filtered"].frames[::7]:
        frame.positions[:, 7] += [0.8, 0.5, 0.0]
    moved = truth().aligned(ELSEWHERE)
    assert far(moved.aligned(align(moved, channels)), truth()) < 3


@pytest.mark.parametrize(
    ("true", "channels", "time", "fault"),
    [
        (truth(still=True), result(still=True), True, "nobody moves so that the time shows"),
        (truth().moved(99), result(), False, "they have no person at one time; --align-time"),
        (truth((0, 2, 3)), result((0, 1)), False, r"at best its joints are \S+ m .*-time"),
        (
            truth((2,)).moved(5),
            {"/x": Channel("r.mcap", [], MODEL)},
            False,
            "no person at one time",
        ),
    ],
)
def test_what_cannot_be_aligned_is_refused(true, channels, time, fault):
    with pytest.raises(ConfigError, match=f"r.mcap: /.*: the truth cannot be aligned: .*{fault}"):
        align(true, channels, time=time)


def test_notes_say_what_was_done():
    channels, moved = result(), truth().aligned(ELSEWHERE)
    back = moved.aligned(align(moved, channels))
    (note,) = [n for n in notes_of(back, evaluate_channels(channels, back)) if "turned" in n]
    assert note.startswith("the truth was turned by 132.8 degrees (xyzw ")
    assert note.endswith("what is constant in the error does not show")


def c3d(path, true, rate):
    """Write a truth as a laboratory does: mm, a person before each marker, gaps, an angle."""
    import ezc3d

    file, n = ezc3d.c3d(), len(true.stamps)
    labels = [f"P{who}:{name}" for who in true.people for name in true.model.marker_names]
    points = np.ones((4, len(labels) + 2, n))
    points[:3, :-2] = 1000 * true.positions.reshape(n, -1, 3).T
    gaps = np.where(np.isnan(points).any(axis=0), -1.0, 0.0)
    gaps[6, :20] = -1.0
    parameters = file["parameters"]["POINT"]
    parameters["RATE"]["value"], parameters["UNITS"]["value"] = [rate], ["mm"]
    parameters["LABELS"]["value"] = [*labels, "P0:LHipAngles", "*9"]
    file.add_parameter("POINT", "ANGLES", ["P0:LHipAngles"])
    file["data"]["points"] = np.nan_to_num(points)
    file["data"]["meta_points"]["residuals"] = gaps[None]
    file.write(str(path))
    return path


def test_a_c3d_file_is_a_truth(tmp_path):
    true = truth((0, 2), frames=60)
    read = load_truth(c3d(tmp_path / "a.c3d", true, 60.0))
    assert read.model.marker_names == MODEL.marker_names
    assert read.people == (0, 1)
    assert read.stamps[:2].tolist() == [0, 16_666_667]
    assert np.isnan(read.positions[:20, 0, 6]).all()
    read.positions[:20, 0, 6] = true.positions[:20, 0, 6]
    np.testing.assert_allclose(read.positions, true.positions, atol=1e-6)


def test_eval_aligns_a_file_of_another_laboratory(tmp_path, crossing, capsys):
    process(crossing, tmp_path / "r.mcap")
    whole = find_truth(crossing)
    moved = replace(
        whole,
        stamps=whole.stamps[30:120],
        positions=whole.positions[30:120],
        orientations=whole.orientations[30:120],
    ).aligned(ELSEWHERE)
    path = c3d(tmp_path / "lab.c3d", moved, 30.0)
    means = []
    for arguments in ([str(crossing)], [str(path), "--align", "--align-time"]):
        assert run(["eval", str(tmp_path / "r.mcap"), "--truth", *arguments, "--json"]) == 0
        found = json.loads(capsys.readouterr().out)
        means.append(found["channels"]["/hiros/filtered"]["mean"])
    assert means[0] - 4.0 < means[1] < means[0]  # mm
    assert found["alignment"]["seconds"] == pytest.approx(1.0, abs=0.05)
    back = Rigid(*(np.array(found["alignment"][k]) for k in ("quaternion_xyzw", "translation")))
    metres, degrees = (back @ ELSEWHERE.pose).apart(Rigid.identity())
    assert metres < 0.02
    assert degrees < 0.5
