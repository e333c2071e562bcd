"""Signs of wrong sides in a result without truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from builders import FAULTLESS, moved
from scipy.spatial.transform import Rotation

from hiros_mcap.evaluate.score_tables import side_table
from hiros_mcap.evaluate.side_scores import SideScores, side_scores
from hiros_mcap.simulate import SimulateParams, simulate
from hiros_mcap.simulate.body_model import MODEL, SYMMETRY


def walk(*, backwards=False):
    """4 s of somebody who walks; ``backwards`` in reversed time."""
    simulation = simulate(SimulateParams.model_validate({**FAULTLESS, "seed": 3}))
    stamps = simulation.params.start + (np.arange(30, 150) / 30 * 1e9).astype(np.int64)
    frames = simulation.truth_at(stamps)
    shown = frames[::-1] if backwards else frames
    return [replace(f, stamp=t) for f, t in zip(shown, stamps.tolist(), strict=True)]


def mirror(frame):
    return frame.replace(markers=frame.markers[:, SYMMETRY.mirror].copy())


def test_right_sides_show_no_sign():
    scores = side_scores(walk(), MODEL)
    assert scores.walking > 60 and scores.backwards == scores.jumps == 0
    assert scores.contradicting["toe"] == 0 and max(scores.contradicting.values()) < 0.2


def test_z_need_not_point_up():
    turn = Rotation.from_euler("xy", [-70, 20], degrees=True)
    tilted = side_scores(moved(walk(), turn, np.ones(3)), MODEL)
    scores = side_scores(walk(), MODEL)
    assert (tilted.walking, tilted.backwards, tilted.jumps) == (scores.walking, 0, 0)


def test_straight_knees_point_nowhere():
    slots = [[MODEL.marker_names.index(f"{m}_{side}") for m in ("HIP", "KNEE", "ANKLE")]
             for side in ("LEFT", "RIGHT")]  # fmt: skip
    rng, straight = np.random.default_rng(1), []
    for frame in walk():
        markers = frame.markers.copy()
        for hip, knee, ankle in slots:
            middle = (markers[:, hip, :3] + markers[:, ankle, :3]) / 2
            markers[:, knee, :3] = middle + rng.normal(0, 0.008, 3)
        straight.append(frame.replace(markers=markers))
    assert "knee" not in side_scores(straight, MODEL).contradicting


def test_swapped_sides_walk_backwards_and_contradict_every_cue():
    scores = side_scores(map(mirror, walk()), MODEL)
    assert scores.backwards == scores.walking > 60
    assert scores.contradicting["toe"] == 1 and min(scores.contradicting.values()) > 0.8


def test_real_backward_walking_contradicts_no_toe():
    scores = side_scores(walk(backwards=True), MODEL)
    assert scores.backwards == scores.walking > 60 and scores.contradicting["toe"] == 0


def test_who_walks_backwards_slowly_is_seen_to_do_so():
    start, *_ = frames = walk(backwards=True)
    slow = [replace(f, stamp=2 * f.stamp - start.stamp) for f in frames]
    scores = side_scores(slow, MODEL)
    assert scores.backwards == scores.walking > 60


def test_who_walks_sideways_does_not_walk_backwards():
    turn, sideways = Rotation.from_euler("z", 90, degrees=True), []
    for frame in walk():
        markers, centre = frame.markers.copy(), frame.positions[0].mean(axis=0)
        markers[0, :, :3] = turn.apply(markers[0, :, :3] - centre) + centre
        sideways.append(frame.replace(markers=markers))
    scores = side_scores(sideways, MODEL)
    assert scores.walking > 60 and scores.backwards < 0.1 * scores.walking


def test_a_swap_in_the_middle_is_two_jumps():
    frames = [mirror(f) if 40 <= k < 80 else f for k, f in enumerate(walk())]
    assert side_scores(frames, MODEL).jumps == 2


def test_the_share_that_walks_backwards_is_of_the_frames_that_walk():
    scores = SideScores(1, 1, 0, {}, {})
    assert side_table(scores)[1][0][2] == "100.0 % of 1"


def test_an_empty_result_has_no_share():
    _, rows = side_table(side_scores([], MODEL, {"/a": 3}))
    assert rows[0] == ("/a: mirrored detections", "3", "")
