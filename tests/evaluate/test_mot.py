"""MOTA, IDF1 and HOTA: by hand, and equal to TrackEval's on shared cases."""

from __future__ import annotations

import numpy as np
import pytest

from hiros_mcap.evaluate.mot import ALPHAS, FrameSimilarity, tracking_scores


def instant(true, ids, similarity):
    return FrameSimilarity(
        tuple(true), tuple(ids), np.array(similarity, float).reshape(len(true), len(ids))
    )


def test_perfect_tracking():
    s = tracking_scores([instant([0, 1], [5, 7], np.eye(2))] * 4)
    assert (s.mota, s.idf1, s.hota) == (1, 1, 1)


def test_one_missing_one_false_and_one_switch_in_ten():
    """10 true: 1 missing, 1 false, 1 switch -> MOTA 0.7; ids 5 (6 frames) and 6 (3)."""
    rows = [instant([0], [5], [[1.0]])] * 6 + [instant([0], [6], [[1.0]])] * 3
    s = tracking_scores([*rows, instant([0], [9], [[0.0]])])
    assert s.mota == pytest.approx(0.7)
    assert s.idf1 == pytest.approx(2 * 6 / (10 + 10))


def test_hota_of_an_id_that_changes_halfway():
    """All are found: DetA 1; each match shares 5 of 10 frames with its id: AssA 1/2."""
    rows = [instant([0], [5], [[1.0]])] * 5 + [instant([0], [6], [[1.0]])] * 5
    s = tracking_scores(rows)
    assert s.hota == pytest.approx(np.sqrt(0.5))


def test_half_similar_matches_count_up_to_that_similarity():
    s = tracking_scores([instant([0], [5], [[0.5]])] * 3)
    assert s.hota == pytest.approx((ALPHAS <= 0.5 + 1e-9).mean())


def test_a_match_is_kept_while_it_is_possible():
    """CLEAR MOT: the other person comes closer to the id for a moment; no switch."""
    far = [[0.6, 0.7], [0.7, 0.6]]
    rows = [instant([0, 1], [5, 7], np.eye(2)), instant([0, 1], [5, 7], far)]
    assert tracking_scores(rows).mota == 1


def test_nobody_to_be_found():
    assert np.isnan(tracking_scores([instant([], [], [])]).hota)
    assert np.isnan(tracking_scores([instant([], [], [])]).mota)
    assert tracking_scores([instant([0], [], [])]).mota == 0


def random_case(seed):
    """People and ids that come, go, change and are similar by chance."""
    rng = np.random.default_rng(seed)
    people, names = int(rng.integers(1, 5)), int(rng.integers(1, 7))
    rows = []
    for _ in range(int(rng.integers(2, 40))):
        true = np.nonzero(rng.random(people) < 0.8)[0]
        ids = np.nonzero(rng.random(names) < 0.7)[0]
        similarity = rng.random((len(true), len(ids))) * (rng.random((len(true), len(ids))) < 0.7)
        rows.append(FrameSimilarity(tuple(true.tolist()), tuple((ids + 10).tolist()), similarity))
    return rows


def as_trackeval(instants):
    people = sorted({i for now in instants for i in now.true_ids})
    names = sorted({i for now in instants for i in now.ids})
    return {
        "num_timesteps": len(instants),
        "num_gt_ids": len(people),
        "num_tracker_ids": len(names),
        "num_gt_dets": sum(len(now.true_ids) for now in instants),
        "num_tracker_dets": sum(len(now.ids) for now in instants),
        "gt_ids": [np.array([people.index(i) for i in now.true_ids], int) for now in instants],
        "tracker_ids": [np.array([names.index(i) for i in now.ids], int) for now in instants],
        "similarity_scores": [now.similarity for now in instants],
    }


@pytest.mark.parametrize("seed", range(60))
def test_equal_to_trackeval(seed):
    import trackeval

    instants = random_case(seed)
    if not any(now.true_ids for now in instants) or not any(now.ids for now in instants):
        pytest.skip("TrackEval defines other values for empty cases")
    ours, data = tracking_scores(instants), as_trackeval(instants)
    loose = {"THRESHOLD": 1e-9, "PRINT_CONFIG": False}
    clear = trackeval.metrics.CLEAR(loose).eval_sequence(data)
    identity = trackeval.metrics.Identity(loose).eval_sequence(data)
    hota = trackeval.metrics.HOTA().eval_sequence(data)
    assert ours.mota == pytest.approx(clear["MOTA"], abs=1e-9)
    assert ours.idf1 == pytest.approx(identity["IDF1"], abs=1e-9)
    assert ours.hota == pytest.approx(hota["HOTA"].mean(), abs=1e-9)
