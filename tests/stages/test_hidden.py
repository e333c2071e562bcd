"""Joints behind somebody else, by hand: person 7 stands, person 8 comes between and camera a."""

from __future__ import annotations

import numpy as np
import pytest
from builders import moved
from scipy.spatial.transform import Rotation
from stick_figures import MODEL, at, person, seen

from hiros_mcap.body.limb_thickness import capsules_of
from hiros_mcap.events import Events
from hiros_mcap.frames import Block, frames_of, join
from hiros_mcap.kernels import line_of_sight
from hiros_mcap.kernels.compile import Kernel
from hiros_mcap.stages.detections.detection_params import PlausibleParams
from hiros_mcap.stages.detections.hidden import mend_hidden_blocks
from hiros_mcap.stages.merge.merge import weighted_by_sight

CAMERAS = {"a": np.array([-3.0, 0.0, 1.2]), "b": np.array([0.0, -3.0, 1.2])}
PELVIS, NECK, WRIST = (MODEL.marker_names.index(name) for name in ("PELVIS", "NECK", "WRIST_LEFT"))
ALONE, BEHIND = 60, 15  # frames


def raised():
    """Person 7 with a left wrist 60 cm too high."""
    pose = person()
    pose[WRIST] += [0.0, 0.0, 0.6]
    return pose


def log(pose, front=0.25, confidences=1.0):
    """Views of camera a: 2 s of both side by side, then 8 in front of the wrist of 7."""
    frames = [seen([person(), person(-1.0, 1.5)], at(k), ids=[7, 8]) for k in range(ALONE)]
    behind = [pose, person(-1.0, front)]
    frames += [seen(behind, at(k), ids=[7, 8]) for k in range(ALONE, ALONE + BEHIND)]
    for frame in frames:
        frame.marker_confidences[:] = confidences
    return frames


def run(frames, events=None, cameras=CAMERAS, *, guesses=True, **params):
    settings = PlausibleParams.model_validate(params)
    whole = join([Block.of(frame) for frame in frames])
    return join(
        list(mend_hidden_blocks([whole], MODEL, settings, events, cameras, guesses=guesses))
    )


def test_an_invented_wrist_stays_where_it_was_seen_last():
    last = run(log(raised())).frame(-1)
    np.testing.assert_allclose(last.positions[0, WRIST], person()[WRIST], atol=0.15)
    np.testing.assert_array_equal(last.positions[1], person(-1.0, 0.25))


@pytest.mark.parametrize("pose", [person(), person(0.02, 0.03)])
def test_a_hidden_joint_that_the_detector_got_right_stays(pose):
    last = run(log(pose)).frame(-1)
    np.testing.assert_array_equal(last.positions[0], pose)


@pytest.mark.parametrize("front", [1.5, -1.5])
def test_nobody_in_front_changes_nothing(front):
    frames = log(raised(), front)
    out = run(frames)
    assert out.doubts is not None and not out.doubts.variances.any()
    for before, after in zip(frames, frames_of([out]), strict=True):
        np.testing.assert_array_equal(before.markers, after.markers)
        np.testing.assert_array_equal(before.marker_confidences, after.marker_confidences)


def test_somebody_behind_hides_nothing():
    frames = log(raised())
    for frame in frames:
        frame.markers[1, :, 0] += 2.0
    assert not run(frames).doubts.variances[0::2].any()


def rated():
    """The wrist that person 8 hides is guessed, by its confidence."""
    confidences = np.where(np.arange(MODEL.n_markers) == WRIST, 0.33, 0.66)
    return log(raised(), confidences=confidences)


def test_a_detector_that_rates_joints_is_believed():
    """It knows what it sees through between two bodies: only its guesses count less."""
    confidences = np.where(np.arange(MODEL.n_markers) == PELVIS, 0.33, 0.66)
    out = run(log(raised(), confidences=confidences))
    assert not np.delete(out.doubts.variances, PELVIS, axis=1).any()
    np.testing.assert_array_equal(out.frame(-1).positions[0, WRIST], raised()[WRIST])


def test_a_guessed_joint_stays_where_it_was_seen_last():
    """Nobody has to be in front, and it is no event: the detector says so itself."""
    events = Events()
    frames = rated()
    for frame in frames[:ALONE]:
        frame.marker_confidences[:, PELVIS] = 0.33
        frame.marker_confidences[:, WRIST] = 0.66
    out = run(frames, events, cameras={})
    np.testing.assert_allclose(out.frame(-1).positions[0, WRIST], person()[WRIST], atol=0.15)
    assert out.doubts.variances[-2, WRIST] > 0
    assert not events.counts


@pytest.mark.parametrize("scale", [0.1, 0.6, 1.5])
def test_a_detector_guesses_by_its_own_scale(scale):
    """One that is never surer than 0.4 does not guess everything."""
    frames, plain = rated(), run(rated())
    for frame in frames:
        frame.marker_confidences[:] *= scale
    np.testing.assert_array_equal(run(frames).doubts.variances, plain.doubts.variances)


def test_guesses_are_left_to_a_smoother():
    out = run(rated(), guesses=False)
    assert not out.doubts.variances.any()
    np.testing.assert_array_equal(out.frame(-1).positions[0], raised())


def test_the_remembered_pose_goes_with_the_person():
    frames = log(raised(), front=0.25)
    for k, frame in enumerate(frames):
        frame.markers[0, :, 0] += 0.02 * k  # away from the camera, .6 m/s
    wrist = run(frames).frame(-1).positions[0, WRIST]
    np.testing.assert_allclose(wrist - person()[WRIST], [0.02 * (len(frames) - 1), 0, 0], atol=0.15)


def test_somebody_whom_the_message_lacks_hides_all_the_same():
    """Camera b shows person 8 just before camera a shows person 7."""
    frames = []
    for k, pose in enumerate([person()] * ALONE + [raised()] * BEHIND):
        frames.append(seen([person(-1.0, 0.25)], at(k), "b", ids=[8]))
        frames.append(seen([pose], at(k, 1), ids=[7]))
    wrist = run(frames).frame(-1).positions[0, WRIST]
    np.testing.assert_allclose(wrist, person()[WRIST], atol=0.15)


@pytest.mark.parametrize(("front", "falls"), [(0.25, False), (1.5, True)])
def test_a_half_hidden_person_does_not_fall_in_an_instant(front, falls):
    """Where somebody is in front; elsewhere the view is believed."""
    last = run(log(person() - [0, 0, 0.25], front)[: ALONE + 2]).frame(-1)
    assert (last.positions[0, PELVIS, 2] < 0.8) == falls


@pytest.mark.parametrize("off", [{"cameras": {}}, {"behind_others": False}])
def test_without_a_camera_s_place_or_switched_off_everything_stays(off):
    last = run(log(raised()), **off).frame(-1)
    np.testing.assert_array_equal(last.positions[0], raised())


def test_an_event_says_who_was_hidden_by_whom_from_where_and_how_long():
    events = Events()
    run(log(raised(), front=0.0), events)
    (event,) = events.log
    assert (event.stamp, event.kind, event.person, event.source) == (at(ALONE), "hidden", 7, "a")
    assert event.detail == f"behind person 8 for {(BEHIND - 1) / 30:.1f} s"
    assert events.counts["hidden", "a"] > 0


def test_moving_the_room_moves_the_result():
    turn, shift = Rotation.from_euler("xyz", [0.3, -0.5, 1.2]), np.array([3.0, -1.0, 0.5])
    cameras = {name: turn.apply(place) + shift for name, place in CAMERAS.items()}
    there = run(moved(log(raised()), turn, shift), cameras=cameras)
    here = moved(list(frames_of([run(log(raised()))])), turn, shift)
    for one, other in zip(frames_of([there]), here, strict=True):
        np.testing.assert_allclose(one.positions, other.positions, atol=1e-9)


def test_limbs_have_the_radii_of_the_table():
    capsules = capsules_of(MODEL)
    at_ends = dict(zip(capsules.ends.ravel().tolist(), capsules.radii.ravel(), strict=True))
    assert at_ends[PELVIS] == pytest.approx(0.159, abs=0.001)  # 99.9 cm around the hips
    assert at_ends[NECK] == pytest.approx(0.060, abs=0.001)
    assert at_ends[WRIST] == pytest.approx(0.029, abs=0.001)


def test_the_merger_weighs_hidden_joints_less_and_no_others():
    whole = run(log(raised()))
    people = weighted_by_sight(whole.people, whole.doubts.variances)
    lowered = people.marker_confidences < 1.0
    np.testing.assert_array_equal(lowered, whole.doubts.variances > 0)
    assert people.marker_confidences[-2, WRIST] < 0.75
    np.testing.assert_array_equal(whole.people.marker_confidences, 1.0)


@pytest.fixture
def sight(monkeypatch):
    """The module with its kernels as Python runs them, which is quick for a few hundred lines."""
    for name, each in list(vars(line_of_sight).items()):
        if isinstance(each, Kernel):
            monkeypatch.setattr(line_of_sight, name, each.function)
    return line_of_sight


@pytest.mark.parametrize("camera", [(-3.0, 0.5, 1.2), (-0.7, 0.1, 1.5), (0.3, -0.4, 3.5)])
def test_no_place_outside_of_an_outline_is_hidden(sight, camera):
    """A body is looked at from afar, from near, and from above; the outline only saves work."""
    rng, camera, body = np.random.default_rng(1), np.array(camera), person()
    box, unbounded = np.empty(sight.OUTLINE), np.zeros(sight.OUTLINE)
    sight.outline(body, camera, box)
    axes = box[:9].reshape(3, 3)
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    unbounded[9] = -np.inf
    markers = body[rng.integers(len(body), size=300)] + rng.normal(scale=0.15, size=(300, 3))
    places = camera + (markers - camera) * rng.uniform(0.5, 3.0, (300, 1))
    hidden = np.array(
        [
            [sight.hidden_by(place, camera, body, each, capsules_of(MODEL)) for place in places]
            for each in (box, unbounded)
        ]
    )
    assert 100 < (hidden[1] > 0.5).sum() < 280
    np.testing.assert_allclose(hidden[0], hidden[1], atol=1e-3)
