"""Detections that contradict a person's own limb lengths, by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from stick_figures import MIRROR, MODEL, SECOND, at, person, seen

from hiros_mcap.body.symmetry import symmetry_of
from hiros_mcap.events import Events
from hiros_mcap.frames import Block, Doubts, frames_of, join
from hiros_mcap.simulate import SimulateParams, simulate
from hiros_mcap.skeletons import UNTRACKED, Frame, SkeletonModel
from hiros_mcap.stages.detections.plausible import PlausibleParams, drop_implausible_blocks
from hiros_mcap.stages.detections.sides import decide_sides, views_of
from hiros_mcap.stages.merge.merge import merge_blocks

CAMERAS = {"a": np.array([-3.0, 0.0, 1.0]), "b": np.array([0.0, -3.0, 1.0])}
WRIST = MODEL.marker_names.index("WRIST_LEFT")
KNOWN = 200  # frames after which the lengths of a person are known


def noisy(n, x=0.0, seed=1):
    """Views of somebody who stands still: 1 cm of noise along each axis."""
    noise = np.random.default_rng(seed).normal(0, 0.01, (n, MODEL.n_markers, 3))
    return list(person(x) + noise)


def squeezed(x=0.0):
    """Somebody half as large."""
    return np.asarray(person(x) * [1, 0.5, 0.5] + [0, 0, 0.5])


def run(frames, events=None, **params):
    settings = PlausibleParams.model_validate(params)
    return list(frames_of(tables(frames, settings, events)))


def tables(frames, params=None, events=None):
    """The tables of views, a message each."""
    blocks = drop_implausible_blocks(map(Block.of, frames), MODEL, params, events, CAMERAS)
    return [views_of(join([block])) for block in blocks]


def doubts(frames):
    """By how much the variances of markers grow, m2: (P, M) of each frame."""
    return [table.doubts.variances for table in tables(frames)]


def alone(poses):
    return [seen([pose], at(k), ids=[7]) for k, pose in enumerate(poses)]


def behind(poses, aside=0.0):
    """Person 7, and person 8 a metre nearer to camera a."""
    front = person(-1.0, aside)
    return [seen([pose, front], at(k), ids=[7, 8]) for k, pose in enumerate(poses)]


def is_blank(frame, row=0):
    return bool(np.isnan(frame.positions[row]).all())


def test_honest_views_stay_as_they_are():
    frames = behind(noisy(300))
    for before, after in zip(frames, run(frames), strict=True):
        np.testing.assert_array_equal(before.positions, after.positions)
        np.testing.assert_array_equal(before.marker_confidences, after.marker_confidences)
    assert not np.concatenate(doubts(frames)).any()


def test_the_far_end_of_a_stretched_limb_has_a_larger_variance_and_keeps_its_confidence():
    stretched = person()
    stretched[WRIST] += [0.0, 0.5, 0.0]
    frames, events = alone([*noisy(KNOWN), stretched]), Events()
    last = run(frames, events)[-1]
    assert np.flatnonzero(doubts(frames)[-1][0] > 0.06**2).tolist() == [WRIST]
    np.testing.assert_array_equal(last.marker_confidences, frames[-1].marker_confidences)
    assert events.counts["implausible marker", "a"] == 1
    assert not is_blank(last)


def test_the_variance_grows_with_the_length():
    """A result does not change at once where a limb is a little longer."""
    stretched = [person() for _ in range(4)]
    for pose, metres in zip(stretched, (0.3, 0.4, 0.5, 0.6), strict=True):
        pose[WRIST] += [0.0, metres, 0.0]
    found = np.array(doubts(alone([*noisy(KNOWN), *stretched]))[KNOWN:])[:, 0, WRIST]
    assert (np.diff(found) > 0).all()


def test_the_doubt_goes_with_a_side_that_is_exchanged():
    """Frames from the end of a walk, mirrored there; the left wrist contradicts the arm."""
    simulation = simulate(SimulateParams(people=1, cameras=1, seconds=4.0, seed=3))
    walk = simulation.truth_at(simulation.params.start + np.arange(120) * 33_000_000)
    blocks = [Block.of(frame.replace(markers=frame.markers.copy())) for frame in walk]
    mirror = symmetry_of(simulation.model).mirror
    left = simulation.model.marker_names.index("WRIST_LEFT")
    for k, block in enumerate(blocks):
        hidden = np.zeros(block.people.markers.shape[:2])
        hidden[:, left] = 1.0
        if 60 <= k < 90:
            block.people.markers[:] = block.people.markers[:, mirror]
        doubts = Doubts.none(*hidden.shape)._replace(variances=hidden)
        blocks[k] = replace(block, doubts=doubts)
    decided = list(decide_sides(blocks, simulation.model, None, Events()))
    found = np.concatenate([block.doubts.variances[:, left] for block in decided])
    assert (found == np.where((np.arange(120) >= 60) & (np.arange(120) < 90), 0.0, 1.0)).all()


def test_a_distorted_view_behind_somebody_is_left_out():
    events = Events()
    last = run(behind([*noisy(KNOWN), squeezed()]), events)[-1]
    assert is_blank(last)
    assert last.ids.tolist() == [7, 8]
    assert not is_blank(last, 1)
    assert events.counts["distorted", "a"] == 1


@pytest.mark.parametrize("place", [[0.0, 0.0, 0.0], [5.0, -3.0, 1.0]])
@pytest.mark.parametrize(("aside", "left_out"), [(0.0, True), (0.8, False), (-0.8, False)])
def test_who_stands_before_whom_depends_on_no_place_of_the_room(place, aside, left_out):
    frames = behind([*noisy(KNOWN), squeezed()], aside)
    for frame in frames:
        frame.positions[...] += place
    cameras = {name: at + place for name, at in CAMERAS.items()}
    *_, last = drop_implausible_blocks(map(Block.of, frames), MODEL, None, None, cameras)
    assert last.doubts.distorted.tolist() == [left_out, False]


def test_the_doubts_name_the_distorted_views_and_detections_stay_as_they_are():
    frames = behind([*noisy(KNOWN), squeezed()])
    *_, last = drop_implausible_blocks(map(Block.of, frames), MODEL, None, None, CAMERAS)
    assert last.doubts.distorted.tolist() == [True, False]
    np.testing.assert_array_equal(last.frame(0).positions[0], squeezed())


@pytest.mark.parametrize("aside", [0.8, -0.8])
def test_a_distorted_view_beside_somebody_stays(aside):
    frames = behind([*noisy(KNOWN), squeezed()], aside)
    assert not is_blank(run(frames)[-1])
    assert (doubts(frames)[-1][0] > 0.06**2).any()


def test_nothing_is_left_out_while_another_camera_shows_the_person():
    frames = behind(noisy(KNOWN))
    other = seen([person()], at(KNOWN), "b", ids=[7])
    distorted = seen([squeezed(), person(-1.0)], at(KNOWN, 1), ids=[7, 8])
    assert not is_blank(run([*frames, other, distorted])[-1])
    assert is_blank(run([*frames, distorted])[-1])


def test_distorted_views_are_left_out_for_a_second_only():
    after = run(behind([*noisy(KNOWN), *[squeezed()] * 45]))[KNOWN:]
    blank = [is_blank(frame) for frame in after]
    assert blank == [True] * 31 + [False] * 14  # 30 periods are a little less than 1 s


def test_nothing_happens_before_a_person_is_known():
    frames = behind([*noisy(100), squeezed()])
    last = run(frames)[-1]
    np.testing.assert_array_equal(last.positions, frames[-1].positions)
    assert not doubts(frames)[-1].any()


def test_a_fast_kick_and_exchanged_sides_are_no_contradiction():
    """Lengths do not depend on speed, nor on which side is which."""
    poses = [pose + np.array([0.4 * k, 0, 0]) for k, pose in enumerate(noisy(20, seed=2))]  # 12 m/s
    mirrored = noisy(1, seed=3)[0][MIRROR]
    assert not np.concatenate(doubts(alone([*noisy(KNOWN), *poses, mirrored]))).any()


def test_detections_without_an_id_and_without_links_stay():
    nobody = [seen([pose], at(k), ids=[UNTRACKED]) for k, pose in enumerate(noisy(KNOWN))]
    strange = seen([squeezed()], at(KNOWN), ids=[UNTRACKED])
    assert not is_blank(run([*nobody, strange])[-1])
    loose = SkeletonModel.of(MODEL.marker_names, [])
    frames = [
        Frame.empty(1, loose, stamp=at(k)).replace(ids=np.array([7], np.int32)) for k in range(3)
    ]
    assert len(list(drop_implausible_blocks(map(Block.of, frames), loose))) == 3


def test_without_it_nothing_changes():
    frames = behind([*noisy(KNOWN), squeezed()])
    assert not is_blank(run(frames, limbs=False)[-1])


def test_the_cut_into_blocks_does_not_matter():
    frames = behind([*noisy(KNOWN), *[squeezed()] * 10, *noisy(10)])
    whole = join([*map(Block.of, frames)])
    (at_once,) = drop_implausible_blocks([whole], MODEL, None, None, CAMERAS)
    one_by_one = run(frames)
    for one, other in zip(views_of(join([at_once])).frames(), one_by_one, strict=True):
        np.testing.assert_array_equal(one.positions, other.positions)
    np.testing.assert_array_equal(at_once.doubts.variances, np.concatenate(doubts(frames)))


def test_the_merger_carries_a_person_whose_views_are_left_out():
    """As long as they come, and with less and less confidence."""
    frames = behind([*noisy(KNOWN), *[squeezed()] * 20])
    merged = list(frames_of(merge_blocks(tables(frames), MODEL, cameras=CAMERAS)))
    rows = [frame.ids.tolist().index(7) for frame in merged[-20:]]
    places = np.array([f.positions[row] for f, row in zip(merged[-20:], rows, strict=True)])
    assert np.abs(places - person()).max() < 0.1
    shown = zip(merged[-15:], rows[-15:], strict=True)
    assert (np.diff([f.marker_confidences[row, 0] for f, row in shown]) < 0).all()
    assert merged[-1].stamp - frames[0].stamp > 7 * SECOND


def test_a_view_whose_detector_says_what_it_guesses_is_not_left_out():
    frames = behind([*noisy(KNOWN), squeezed()])
    frames[-1].marker_confidences[0, WRIST] = 0.33
    assert not is_blank(run(frames)[-1])
