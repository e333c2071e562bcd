"""A camera that is wrong as a whole, or looks into a mirror, doubles nobody."""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np
import pytest
from builders import at_once
from stick_figures import MIRROR, MODEL, PERIOD, POSE, at, person, seen

from hiros_mcap.body.rotations import from_vector, to_matrix
from hiros_mcap.config import load_config
from hiros_mcap.events import CAMERA_BACK, Events
from hiros_mcap.skeletons import Floats
from hiros_mcap.stages.track.likeness import Displacement, likeness
from hiros_mcap.stages.track.track import track_blocks

track = at_once(track_blocks)

SIDES = np.array(MIRROR, np.int32)
TURN = to_matrix(from_vector(np.radians([8.0, 0.0, 25.0])))
SHIFT = np.array([1.2, -0.4, 0.1])
WALL = np.array([1.0, 1.0, 1.0]) - 2.0 * np.array([1.0, 0.0, 0.0])
"""Reflects about the plane x = 0."""

View = Callable[[Floats], Floats]


def walker(k):
    """Somebody who walks a circle of 1 m, arms swinging, at frame ``k`` of 30 Hz."""
    angle = 0.04 * k
    pose = POSE.copy()
    swing = 0.25 * np.sin(0.2 * k)
    pose[6:, 0] += [swing, -swing]
    pose[4:6, 0] += [-0.2 * swing, 0.2 * swing]
    turned = pose @ to_matrix(from_vector(np.array([0.0, 0.0, angle + np.pi / 2]))).T
    return np.asarray(turned + np.array([np.cos(angle), np.sin(angle), 0.0]))


def stroller(k):
    """Somebody else, who walks to and fro, waves, and turns."""
    pose = POSE.copy()
    pose[6, 2] += 0.3 * np.sin(0.15 * k)
    heading = np.pi if 60 <= k % 120 < 120 else 0.0
    way = 0.03 * min(k % 120, 120 - k % 120)
    return pose @ to_matrix(from_vector(np.array([0.0, 0.0, heading]))).T + [4.0, way - 1.0, 0.0]


def displaced(body):
    return np.asarray(body @ TURN.T + SHIFT)


def reflected(body):
    """In a mirror 3 m off; the detector takes left for right."""
    return np.asarray((body * WALL)[MIRROR] + [6.0, 0.0, 0.0])


def steps(body, n=20):
    rng = np.random.default_rng(5)
    poses = np.stack([body(1.5 * k) for k in range(n)])
    return np.asarray(poses + rng.normal(0.0, 0.02, poses.shape))


# Whether a track is a copy


@pytest.mark.parametrize("swaps", [False, True])
def test_a_rigid_copy_is_one_and_its_displacement_is_found(swaps):
    own = steps(lambda k: displaced(walker(k))[MIRROR if swaps else slice(None)])
    like = likeness(own, steps(walker), SIDES)
    assert like is not None
    assert like.is_copy(0.085, unseen=1.0)
    assert (like.by.mirrors, like.by.swaps) == (False, swaps)
    assert like.by.undo(own, SIDES) == pytest.approx(steps(walker), abs=0.15)
    assert like.apart == pytest.approx(1.3, abs=0.5)


def test_whom_the_camera_also_shows_in_place_has_no_rigid_copy():
    like = likeness(steps(lambda k: displaced(walker(k))), steps(walker), SIDES)
    assert like is not None
    assert not like.is_copy(0.085, unseen=0.5)


@pytest.mark.parametrize("swaps", [False, True])
def test_a_mirror_image_is_a_copy_beside_the_person(swaps):
    own = steps(lambda k: reflected(walker(k))[slice(None) if swaps else MIRROR])
    like = likeness(own, steps(walker), SIDES)
    assert like is not None
    assert like.by.mirrors
    assert like.is_copy(0.085, unseen=0.0)


def test_a_mirror_image_that_is_turned_besides_is_of_somebody_else():
    like = likeness(steps(lambda k: displaced(reflected(walker(k)))), steps(walker), SIDES)
    assert like is not None
    assert (like.distance < 0.085, like.by.mirrors) == (True, True)
    assert not like.is_copy(0.085, unseen=1.0)


@pytest.mark.parametrize("start", [0, 15, 45])
def test_two_people_who_both_walk_are_two(start):
    own = steps(lambda k: stroller(k + start))
    like = likeness(own, steps(walker), SIDES)
    assert like is not None
    assert not like.is_copy(0.12, unseen=1.0)


def test_somebody_who_stands_still_is_no_evidence():
    assert likeness(steps(lambda k: person(2.0)), steps(lambda k: person()), SIDES) is None


def test_few_markers_are_no_evidence():
    own = steps(lambda k: displaced(walker(k)))
    own[:, 5:] = np.nan
    assert likeness(own, steps(walker), SIDES) is None


def test_the_inverse_takes_people_back():
    by = Displacement(TURN * WALL, SHIFT, mirrors=True, swaps=True)
    there = by.undo(walker(3.0), SIDES)
    assert by.inverse().undo(there, SIDES) == pytest.approx(walker(3.0))


# In the tracker


def filmed(views, seconds=5.0):
    """What cameras show of people at 30 Hz."""
    rng = np.random.default_rng(7)
    frames = []
    for k in range(round(30 * seconds)):
        for c, (name, view) in enumerate(views.items()):
            people = [body + rng.normal(0.0, 0.01, body.shape) for body in view(float(k))]
            frames.append(seen(people, at(k, c), name))
    return frames


def tracked(frames, params=None):
    """Ids that each camera's messages got, and the events."""
    events = Events()
    ids: dict[str, list[list[int]]] = {}
    for frame in track(frames, MODEL, params, events):
        ids.setdefault(frame.source, []).append(frame.ids.tolist())
    return ids, events


def one(k):
    return [walker(k)]


def moved_at(when, view=displaced):
    return lambda k: [view(walker(k)) if k >= when else walker(k)]


def displacements(events):
    kinds = "camera displaced", "mirror seen"
    return [(each.source, each.detail) for each in events.log if each.kind in kinds]


@pytest.mark.parametrize("when", [0, 60])
def test_a_displaced_camera_brings_nobody(when):
    ids, events = tracked(filmed({"a": one, "b": one, "c": moved_at(when)}))
    assert ids["a"] == ids["b"] == [[0]] * 150
    assert ids["c"] == [[0]] * when + [[-1]] * (150 - when)
    ((camera, detail),) = displacements(events)
    assert camera == "c"
    assert detail.endswith("m from where other cameras see them")
    assert events.counts["displaced", "c"] == 150 - when
    (event,) = (each for each in events.log if each.kind == "camera displaced")
    assert (event.is_warning, event.stamp) == (True, pytest.approx(at(when, 2), abs=2 * PERIOD))


@pytest.mark.parametrize("system", ["hiros-realtime", "fuse-realtime"])
def test_causal_systems_leave_a_moved_camera_out_before_its_people_are_confirmed(system):
    params = load_config(system=system).track
    ids, _ = tracked(filmed({"a": one, "b": one, "c": moved_at(60)}), params)
    assert {i for each in ids["c"][60:] for i in each} == {-1}


def test_published_trackers_do_not_look_for_copies():
    params = load_config(preset="paper", system="hiros").track
    ids, events = tracked(filmed({"a": one, "b": one, "c": moved_at(0)}), params)
    assert ids["c"][-1] == [1]
    assert displacements(events) == []


def test_a_mirror_brings_nobody_and_the_camera_still_counts():
    both = filmed({"a": one, "b": one, "c": lambda k: [walker(k), reflected(walker(k))]})
    ids, events = tracked(both)
    assert ids["c"] == [[0, -1]] * 150
    ((camera, detail),) = displacements(events)
    assert (camera, detail.split(",")[0]) == ("c", "shows mirror images of people")


def test_of_two_cameras_nobody_can_know_which_is_wrong():
    ids, events = tracked(filmed({"a": one, "b": moved_at(0)}))
    assert {i for each in ids["a"] + ids["b"] for i in each} == {-1, 0}
    assert all(len({*x, *y} - {-1}) == 1 for x, y in zip(ids["a"], ids["b"], strict=True))
    ((_, detail),) = displacements(events)
    assert detail.endswith("sees them; which of them is wrong cannot be known")


def test_two_cameras_that_disagree_double_nobody_who_comes_back():
    """Whoever shows the person first: copies of the other camera are then left out."""
    frames = filmed({"a": one, "b": moved_at(0)}, 9.0)
    gone = [f for f in frames if not at(120) <= f.stamp < at(180)]
    late = [f for f in gone if f.source == "b" or not at(180) <= f.stamp < at(190)]
    ids, _ = tracked(late)
    last = ids["a"][-60:], ids["b"][-60:]
    assert all(len({*x, *y} - {-1}) == 1 for x, y in zip(*last, strict=True))


def test_one_cameras_own_person_is_somebody_new():
    other = filmed({"a": one, "b": one, "c": lambda k: [stroller(k)]})
    ids, events = tracked(other)
    assert ids["c"][-1] == [1]
    assert displacements(events) == []


def test_a_displaced_camera_may_have_a_person_of_its_own():
    alone = filmed({"a": one, "b": one, "c": lambda k: [displaced(walker(k)), stroller(k)]})
    ids, _ = tracked(alone)
    assert ids["c"][-1] == [-1, 1]


def test_a_known_displacement_finds_copies_of_people_who_stand_still():
    """The second person enters and stops, when the camera is displaced already."""

    def two(k):
        return [walker(k), person(0.0, 3.0)] if k >= 90 else [walker(k)]

    ids, _ = tracked(filmed({"a": two, "b": two, "c": lambda k: [*map(displaced, two(k))]}))
    assert ids["a"][-1] == [0, 1]
    assert {i for each in ids["c"] for i in each} == {-1}


def test_a_displaced_camera_does_not_correct_people_within_the_gate():
    """Of two people one is displaced by little: the camera's view would be taken for a good one."""

    def turned(body):  # about the second person
        turn = to_matrix(from_vector(np.array([0.0, 0.0, 0.3])))
        return np.asarray((body - [4.5, 0.0, 0.0]) @ turn.T + [4.75, 0.0, 0.0])

    def two(k):
        return [walker(k), person(4.5 + 0.2 * np.sin(0.1 * k))]

    ids, _ = tracked(filmed({"a": two, "b": two, "c": lambda k: [*map(turned, two(k))]}))
    assert sorted(ids["a"][-1]) == [0, 1]
    assert ids["c"][-1] == [-1, -1]


def test_a_camera_that_is_back_in_place_counts_again():
    def back(k):
        return [displaced(walker(k)) if 45 <= k < 105 else walker(k)]

    ids, events = tracked(filmed({"a": one, "b": one, "c": back}))
    assert ids["c"] == [[0]] * 45 + [[-1]] * 60 + [[0]] * 45
    assert displacements(events) == []
    (event,) = (event for event in events.log if event.kind == CAMERA_BACK)
    assert not event.is_warning
    assert event.source == "c"
    assert re.search(r"showed people \d\.\d\d m from where .* for 2\.0 s$", event.detail)
