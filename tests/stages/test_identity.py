"""People keep their ids around occlusions and absences, and nobody is there twice."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from builders import at_once
from stick_figures import MODEL, POSE, SECOND, START, at, person, seen

from hiros_mcap.config import load_config
from hiros_mcap.events import Events
from hiros_mcap.frames import Block
from hiros_mcap.stages.merge.merge import MergeParams, merge_blocks
from hiros_mcap.stages.merge.unseen import Unseen
from hiros_mcap.stages.track.reidentify import (
    LimbScatter,
    PersonCues,
    limb_cues,
    place_cue,
    reidentify,
)
from hiros_mcap.stages.track.track import _Tracker, track_blocks
from hiros_mcap.stages.track.track_params import TrackParams

track = at_once(track_blocks)
merge = at_once(merge_blocks)

CAMERAS = {"a": np.array([-3.0, 0.0, 1.0]), "b": np.array([0.0, -3.0, 1.0])}
TALL = 1.1


def ids(frames, params=None):
    return [f.ids.tolist() for f in track(frames, MODEL, params, cameras=CAMERAS)]


def events_of(frames, params=None):
    events = Events()
    list(track(frames, MODEL, params, events, CAMERAS))
    return events.log


def kinds(log):
    return [event.kind for event in log]


def standing(people, start, end, cameras="ab"):
    """Messages of cameras that see people stand still, s."""
    steps = range(round(start * 30), round(end * 30))
    return [seen(people, at(k, c), name) for k in steps for c, name in enumerate(cameras)]


# Occlusions


def distorted(shift):
    """Somebody whose body the detector moves, m, and lets sink to the floor."""
    return person(shift) * [1.0, 1.0, 0.7]


def test_a_detection_that_leaps_is_left_out_and_does_not_spoil_the_track():
    """Distorted for two frames, then hidden: the person comes back near the old place."""
    before, after = standing([person()], 0, 1, "a"), standing([person(0.1)], 1.5, 2, "a")
    leaps = [seen([distorted(0.3)], at(30), "a"), seen([distorted(-0.4)], at(31), "a")]
    assert ids([*before, *leaps, *after]) == [[0]] * 30 + [[-1]] * 2 + [[0]] * 15
    events = Events()
    list(track([*before, *leaps, *after], MODEL, events=events))
    assert events.counts["leap", "a"] == 2


@pytest.mark.parametrize(("apart", "left_out"), [(0.0, 1), (0.5, 4)])
def test_what_two_cameras_show_at_once_is_no_leap(apart, left_out):
    """Somebody starts faster than his track foresees. Or each camera distorts him by itself."""
    before = standing([person()], 0, 1)
    shown = {"a": person(0.45), "b": person(0.45 - 2 * apart)}
    leaps = [seen([shown[name]], at(k, c), name) for k in (30, 31) for c, name in enumerate("ab")]
    events = Events()
    list(track([*before, *leaps], MODEL, events=events))
    assert events.total("leap") == left_out


def test_a_camera_that_insists_on_a_leap_is_believed():
    frames = [*standing([person()], 0, 1, "a"), *standing([person(0.45)], 1, 3, "a")]
    found = ids(frames)
    assert found[30] == [-1]
    assert found[-1] == [0]


@pytest.mark.parametrize(("growth", "expected"), [(0.0, 1), (0.75, 0)])
def test_somebody_who_walks_while_hidden_keeps_the_id(growth, expected):
    """1.2 m/s, hidden for 0.9 s. Without a growing gate there is a new track."""
    steps = [k for k in range(90) if not 30 <= k < 57]
    frames = [seen([person(0.04 * k)], at(k), "a") for k in steps]
    params = TrackParams(gate_growth=growth, fade=growth, reidentify=0.0)
    assert ids(frames, params)[-1] == [expected]


def test_a_gate_that_has_grown_takes_no_second_view_of_somebody_else():
    two = standing([person(), person(0.9)], 0, 1, "a")
    one = [seen([person(), person(0.0, 0.2)], at(k), "a") for k in range(45, 60)]
    assert ids([*two, *one])[30:] == [[0, -1]] * 15


def behind(depth, start, end):
    """Somebody at the origin, hidden from both cameras by people in front of them."""
    front = [person(-depth, 0.0), person(0.0, -depth)]
    frames = standing([person(), *front], 0, 2)
    frames += standing(front, 2, 2 + start)
    return frames + standing([person(), *front], 2 + start, end)


def merged_people(frames, params=None):
    """Confidences of person 0 in the merged frames between 2 s and the end."""
    tracked = track(frames, MODEL, cameras=CAMERAS)
    merged = merge(tracked, MODEL, params, cameras=CAMERAS)
    return [f.marker_confidences[f.ids == 0, 0].tolist() for f in merged if f.stamp >= at(60)]


def test_whom_others_hide_goes_on_for_a_second_with_falling_confidence():
    confidences = merged_people(behind(0.8, 1.4, 3.5))
    hidden = [each[0] for each in confidences[:29]]
    assert all(later <= sooner for sooner, later in itertools.pairwise(hidden))
    assert hidden[2] == 1.0
    assert 0.0 < hidden[27] < 0.1
    assert confidences[31:41] == [[]] * 10
    assert confidences[-1] == [1.0]


def test_nobody_is_carried_whom_a_camera_should_see():
    confidences = merged_people(behind(0.8, 1.4, 3.5), MergeParams(carry=0.0))
    alone = standing([person()], 0, 2) + standing([], 2, 3)
    assert confidences[5:40] == [[]] * 35
    assert merged_people(alone)[5:] == [[]] * 25


@pytest.mark.parametrize(("where", "goes_on"), [(0.7, False), (2.5, True)])
def test_nobody_goes_on_beside_the_new_id_that_may_be_theirs(where, goes_on):
    """Person 0 is hidden at 2 s; at 2.3 s somebody with a new id is near, or far away."""
    front = [person(-0.8, 0.0), person(0.0, -0.8)]
    frames = []
    for k in range(90):
        people = [*front, *[person()] * (k < 60), *[person(where)] * (k >= 69)]
        numbers = [1, 2, *[0] * (k < 60), *[3] * (k >= 69)]
        frames += [seen(people, at(k, c), name, ids=numbers) for c, name in enumerate("ab")]
    merged = merge(frames, MODEL, cameras=CAMERAS)
    later = [0 in f.ids for f in merged if at(72) < f.stamp < at(80)]
    assert later == [goes_on] * len(later)


def test_people_who_left_are_not_remembered_for_ever():
    unseen = Unseen(0.1, 1.0, CAMERAS)
    for k in range(50):
        shown = seen([person()], at(30 * k), ids=[k])
        unseen.show(Block.of(shown), np.array([shown.stamp]), np.zeros(1, np.bool_))
        unseen.go_on(shown.stamp, 1, [k], {k: shown.stamp})
        unseen.see_all()
    assert len(unseen._views) == len(unseen._reported) == 1


# Two tracks of one person, phantoms


def test_nobody_is_there_twice_while_cameras_disagree():
    """Camera b sees the person 0.75 m off for 0.4 s, then camera a stops."""
    frames = [
        seen([person(0.75 if c and 40 <= k < 52 else 0.0)], at(k, c), "ab"[c])
        for k in range(90)
        for c in range(2)
    ]
    assert {i for each in ids(frames) for i in each} <= {-1, 0}
    assert ids(frames)[-1] == [0]


def test_two_tracks_that_no_camera_showed_together_become_one():
    """Camera b sees somebody 0.7 m off, and wider, for a second. Then it agrees."""

    def body(k, c):
        strange = c and 40 <= k < 70
        return POSE * [1.0, 2.0, 1.0] + [0.02 * k, 0.7, 0.0] if strange else person(0.02 * k)

    frames = [seen([body(k, c)], at(k, c), "ab"[c]) for k in range(120) for c in range(2)]
    (merged,) = [event for event in events_of(frames) if event.kind == "tracks merged"]
    assert (merged.person, merged.detail) == (0, "was person 1")
    assert ids(frames)[-1] == [0]


def test_a_track_of_a_moment_is_the_person_who_walks_on():
    """Both cameras see somebody who walks 0.7 m aside for 0.4 s, and then walking on."""

    def body(k):
        return person(0.05 * k - 2.0, 0.7 if 40 <= k < 52 else 0.0)

    frames = [seen([body(k)], at(k, c), "ab"[c]) for k in range(110) for c in range(2)]
    assert ids(frames) == [[0]] * 220


@pytest.mark.parametrize("lookahead", [1.0, 3.0])
def test_a_camera_that_wavers_between_two_places_shows_one_person(lookahead):
    """For 0.6 s it shows somebody here or .95 m aside, never at both places; then aside.

    That is decided while the old track is still known, or after it is lost.
    """
    aside = [0.95 if k % 6 < 3 or k > 16 else 0.0 for k in range(120)]
    frames = standing([person()], 0, 2) + [
        seen([person(x)], at(60 + k), "a") for k, x in enumerate(aside)
    ]
    assert {i for each in ids(frames, TrackParams(lookahead=lookahead)) for i in each} <= {-1, 0}


@pytest.mark.parametrize(("seconds", "people"), [(0.8, 1), (1.3, 2)])
def test_a_still_body_where_only_one_camera_looks_needs_a_second(seconds, people):
    frames = standing([person()], 0, 2)
    for k in range(60, 150):
        body = [person(4.0, 4.0)] if k < 60 + 30 * seconds else []
        frames += [seen([person(), *body], at(k, 0), "a"), seen([person()], at(k, 1), "b")]
    assert len({i for each in ids(frames) for i in each} - {-1}) == people


# Re-identification


def away(seconds, before, after):
    """Two seconds of people, an absence, and two seconds of people."""
    return standing(before, 0, 2) + standing(after, 2 + seconds, 4 + seconds)


def test_who_comes_back_has_the_old_id_from_the_first_detection_on():
    frames = away(5.0, [person()], [person(1.0)])
    assert ids(frames) == [[0]] * 240
    found = [event for event in events_of(frames) if event.kind == "person re-identified"]
    assert [event.person for event in found] == [0]
    assert found[0].detail.startswith("seen by a, b; by ")
    assert found[0].detail.endswith("% person 0")


def test_somebody_of_another_size_has_a_new_id():
    frames = standing([person()], 0, 2) + standing([], 2, 7) + standing([person() * TALL], 7, 9)
    assert ids(frames)[-1] == [1]
    assert "not re-identified" in events_of(frames)[-1].detail


def test_two_people_who_leave_and_change_places_are_told_apart_by_their_limbs():
    shift = np.array([2.0, 0.0, 0.0])
    short, tall = person(-1.0), person() * TALL + shift / 2
    frames = away(4.0, [short, tall], [tall - shift, short + shift])
    assert ids(frames)[-1] == [1, 0]


def test_who_may_be_either_of_two_waits_for_the_other_one():
    """Two people of almost one size left. The first comes back 2 s before the second."""
    taller = 1.04
    frames = standing([person(-0.5), person(0.5) * taller], 0, 2) + standing([], 2, 7)
    first, second = person(0.0, -0.5), person(0.0, 0.5) * taller
    frames += standing([first], 7, 9) + standing([first, second], 9, 11)
    later = [each for each in ids(frames) if each][120:]
    assert later == [[0]] * 120 + [[0, 1]] * 120


def test_who_is_in_doubt_and_leaves_again_has_an_id():
    """Either of two who are alike comes back for 1.5 s. One goes on for whom nobody waits."""
    other = person(2.0)
    frames = standing([person(-0.5), person(0.5), other], 0, 2) + standing([other], 2, 10)
    frames += standing([person(0.0, -0.5), other], 10, 11.5) + standing([other], 11.5, 16)
    assert ids(frames)[600:] == [[3, 2]] * 90 + [[2]] * 270


@pytest.mark.parametrize("beside", [person(2.0), person() * [1.0, 1.0, 0.1]])
def test_who_ended_before_it_was_clear_that_anybody_came_has_no_id(beside):
    """For 0.47 s, while somebody is absent: at another place, or on the floor under a person."""
    frames = standing([person(), person(-2.0)], 0, 2) + standing([person()], 2, 6)
    frames += standing([person(), beside], 6, 6.47) + standing([person()], 6.47, 10)
    assert {i for each in ids(frames) for i in each} == {-1, 0, 1}


@pytest.mark.parametrize("beside", [[], [person(2.0)]])
def test_whom_only_a_misplaced_camera_shows_is_nobody(beside):
    """Camera b stands elsewhere, and shows another person 2 m away, or the person as well."""
    shown = {"a": [person()], "b": [person(-2.0), *beside]}
    frames = [seen(shown[name], at(k, c), name) for k in range(90) for c, name in enumerate("ab")]
    events = Events()
    found = track(frames, MODEL, None, events, CAMERAS, misplaced={"b"})
    assert {i for frame in found for i in frame.ids.tolist()} == {-1, 0}
    assert events.counts["displaced", "b"] == 90 * len(shown["b"])


def test_nobody_is_lost_before_being_born():
    """Somebody comes while another one is absent, and leaves before it is clear who it was."""
    frames = standing([person(), person(-2.0)], 0, 2) + standing([person()], 2, 6)
    frames += standing([person(), person(2.0) * TALL], 6, 7) + standing([person()], 7, 12)
    newcomer = [event for event in events_of(frames) if event.person == 2]
    assert kinds(sorted(newcomer, key=lambda event: event.stamp)) == ["track born", "track lost"]


def test_two_people_who_are_alike_get_new_ids_rather_than_each_others():
    frames = away(8.0, [person(-0.5), person(0.5)], [person(0.0, -0.5), person(0.0, 0.5)])
    assert ids(frames)[-1] == [2, 3]


def test_who_comes_back_second_is_not_whom_the_first_resembles():
    """The first is measured too tall at first, so nobody knows who it is. The second is in between,
    but by then the limbs of the first are known."""
    frames = standing([person(-1.0), person(1.0) * 1.04], 0, 2)
    frames += standing([person() * 1.02], 5, 6) + standing([person()], 6, 14)
    alone = ids([*frames, *standing([person(), person(1.0) * 1.02], 14, 16)])
    assert alone[-1] == [2, 1]


def test_who_is_missing_is_counted_by_person_not_by_the_largest_crowd():
    """One of two leaves, a stranger comes, and only then does the first come back."""
    stays, leaves, stranger = person(-1.0), person(1.0), person(0.0, 1.5) * TALL
    frames = standing([stays, leaves], 0, 3) + standing([stays], 3, 5)
    frames += standing([stays, stranger], 5, 9)
    frames += standing([stays, stranger, person(0.0) * 1.03], 9, 13)
    assert ids(frames)[-1] == [0, 2, 1]


def test_nobody_is_missing_once_two_are_there_who_may_be_the_two_that_left():
    """Two come back who may be either of them. The third has the size of one, and is a stranger."""
    frames = standing([person(-0.5) * 0.97, person(0.5) * 1.03], 0, 2) + standing([], 2, 10)
    two = [person(0.0, -0.5), person(0.0, 0.5)]
    frames += standing(two, 10, 18) + standing([*two, person(1.5) * 0.97], 18, 26)
    assert ids(frames)[-1] == [2, 3, 4]


def test_who_was_seen_for_long_is_still_well_known_after_a_short_return():
    """Seen for 8 s, and for 1 s when back. Then somebody comes who is taller by 6 %."""
    frames = standing([person()], 0, 8) + standing([], 8, 10) + standing([person(0.3)], 10, 11)
    frames += standing([], 11, 19) + standing([person(1.0) * 1.06], 19, 27)
    assert [each for each in ids(frames) if each][:: 60 * 8] == [[0], [0], [1]]


def test_who_is_seen_badly_at_first_is_known_when_he_is_seen_well():
    frames = away(6.0, [person()], [person(0.5) * 1.15])[:-60] + standing([person(0.5)], 9, 14)
    assert ids(frames)[-1] == [0]
    assert ids(frames)[150] == [0]  # from the first detection on


@pytest.mark.parametrize("chair", [True, False])
def test_what_was_nobody_is_not_missing(chair):
    """A chair is a person until the second camera looks. It must not make a newcomer probable.

    Who left may be there already, under another id.
    """
    two, third = [person(-1.0), person(1.0)], person(0.0, 1.5)
    furniture = [person()] if chair else []
    frames = standing([*two, *furniture], 0, 1, "a")
    frames += [
        seen([*two, *furniture] if name == "a" else two, at(k, c), name)
        for k in range(30, 90)
        for c, name in enumerate("ab")
    ]
    frames += standing([two[0]], 3, 5) + standing([two[0], third * 1.04], 5, 9)
    frames += standing([two[0], third * 1.04, person(0.0) * 1.03], 9, 13)
    found = events_of(frames)
    assert ("track withdrawn" in kinds(found)) == chair
    assert found[-1].kind == "track born"


@pytest.mark.parametrize(("absence", "expected"), [(3.9, 0), (4.5, 1)])
def test_nobody_is_remembered_for_longer_than_the_parameter_says(absence, expected):
    frames = standing([person()], 0, 2) + standing([], 2, 2 + absence)
    frames += standing([person()], 2 + absence, 4 + absence)
    assert ids(frames, TrackParams(reidentify=4.0))[-1] == [expected]


@pytest.mark.parametrize(("pause", "expected"), [(5.0, 0), (70.0, 1)])
def test_a_pause_of_all_cameras_is_no_absence_unless_it_is_long(pause, expected):
    frames = away(pause, [person()], [person()])
    assert ids(frames, TrackParams(reidentify=4.0))[-1] == [expected]


def test_cameras_that_stop_one_by_one_do_not_pause():
    """The last camera went on for half a second: the person may have left."""
    frames = standing([person()], 0, 2) + standing([person()], 2, 2.5, "b")
    frames += standing([person()], 8, 10)
    assert ids(frames, TrackParams(reidentify=4.0))[-1] == [1]


@pytest.mark.parametrize("pause", [True, False])
@pytest.mark.parametrize(("shift", "expected"), [(0.0, [0, 1]), (0.8, [2, 3])])
def test_who_stood_still_still_stands_there(pause, shift, expected):
    """Two people of one size, who were not seen for 9 s; or others, in between the two places."""
    two, away = [person(-1.0), person(1.0)], [] if pause else standing([], 2, 11)
    later = [person(-1.0 + shift), person(1.0 - shift)]
    assert ids([*standing(two, 0, 2), *away, *standing(later, 11, 13)])[-1] == expected


def test_who_walked_by_does_not_stand_there():
    """Both cross the room; after 8 s two people stand where they were seen last."""
    steps = [
        seen([person(-2.0 + 0.033 * k), person(2.0 - 0.033 * k, 0.8)], at(k, c), name)
        for k in range(60)
        for c, name in enumerate("ab")
    ]
    later = standing([person(), person(0.0, 0.8)], 10, 12)
    assert ids([*steps, *standing([], 2, 10), *later])[-1] == [2, 3]


@pytest.mark.parametrize(
    ("system", "expected"), [("hiros-realtime", 0), ("fuse-realtime", 0), ("lee", 1)]
)
def test_live_runs_know_who_comes_back_and_the_papers_do_not_unless_asked(system, expected):
    frames = away(5.0, [person()], [person()])
    plain = load_config(system=system).track
    asked = load_config(system=system, overrides=["track.reidentify=30"]).track
    assert ids(frames, plain)[-1] == [expected]
    assert ids(frames, asked)[-1] == [0]


def cues(person_id, seconds, x, size=1.0, n=30.0, seen_for=3.0):
    """Cues of somebody; the limbs of two who were seen for 3 s scatter like a second's."""
    lengths = size * np.array([0.5, 0.3, 0.3, 0.4, 0.4])
    stamp = START + round(seconds * SECOND)
    return PersonCues(person_id, stamp, np.array([x, 0.0, 1.0]), lengths, np.full(5, n), seen_for)


def limb_cue(new, old, limbs):
    """The cue of limbs if nobody else is absent."""
    return limb_cues(new, [old], limbs)[0]


# Thigh and shank of both legs, and the trunk.
LEGS = LimbScatter(np.array([0, 3, 4, 1, 2]))


def test_each_cue_speaks_for_whom_it_fits():
    old = cues(0, 0.0, 0.0)
    same, other = cues(9, 5.0, 0.0), cues(9, 5.0, 0.0, TALL)
    assert limb_cue(same, old, LEGS) > 0 > limb_cue(other, old, LEGS)
    assert limb_cue(cues(9, 5.0, 0.0, n=0.0), old, LEGS) == 0.0
    assert place_cue(cues(9, 2.0, 0.0), old) > 0 > place_cue(cues(9, 2.0, 6.0), old)
    assert place_cue(cues(9, 0.1, 2.0), old) == -math.inf
    assert place_cue(cues(9, -0.9, 0.0), old) == -math.inf
    assert place_cue(cues(9, -0.2, 0.0), old) > 0


def test_what_one_limb_gains_and_the_next_one_loses_is_learned():
    """A knee wanders along the leg from second to second: that makes no other leg."""
    old, new, taller, limbs = *(cues(k, 0.0, 0.0) for k in range(3)), LimbScatter(np.arange(5))
    knee, counts = np.array([0.0, 0.05, -0.05, 0.05, -0.05]), np.full(5, 30.0)
    means = np.cumsum([old.lengths + knee * (-1) ** k for k in range(40)], axis=0)
    for k, lengths in enumerate(means):
        limbs.learn(7, lengths / (k + 1), counts * (k + 1))
    new.lengths[:] += knee
    taller.lengths[:] += np.abs(knee)
    assert limb_cue(new, old, limbs) > 0 > limb_cue(taller, old, limbs)
    assert limb_cue(new, old, LEGS) < 0


def test_the_scatter_of_limbs_is_pooled_over_people_and_starts_with_a_usual_detector():
    scatter, lengths = LimbScatter(np.arange(2)), np.array([0.4, 0.25])
    np.testing.assert_allclose(scatter.covariance(lengths), np.diag([0.05, 0.08]) ** 2)
    rng, sums, n = np.random.default_rng(1), np.zeros((2, 2)), 10.0
    for k in range(1, 2001):
        for who in range(2):
            scatter.keep((0, 1))
            sums[who] += n * lengths * np.exp(rng.normal([0.0, 0.1 * who], [0.02, 0.1]))
            scatter.learn(who, sums[who] / (n * k), np.full(2, n * k))
    found = np.sqrt(np.diag(scatter.covariance(lengths)))
    np.testing.assert_allclose(found, [0.02, 0.1], rtol=0.05)


def test_both_sides_of_a_body_are_alike():
    assert LEGS.alike[1, 3] == LEGS.alike[0, 0] == 1 > LEGS.alike[1, 2]


def test_nobody_runs_faster_than_people_do():
    verdict = reidentify([cues(9, 0.1, 2.0)], [cues(0, 0.0, 0.0)], missing=1, limbs=LEGS)[9]
    assert verdict.probability == 0.0
    assert not verdict.accepted


def test_two_people_of_almost_one_size_are_told_apart_by_each_other():
    old = [cues(0, 0.0, 0.0), cues(1, 0.1, 0.0, 1.04)]
    verdicts = reidentify([cues(9, 5.0, 0.0, 1.04), cues(8, 5.1, 0.0)], old, missing=2, limbs=LEGS)
    assert {new: verdict.person for new, verdict in verdicts.items()} == {9: 1, 8: 0}
    assert all(verdict.accepted for verdict in verdicts.values())


def test_strangers_are_no_likelier_beside_one_absent_person_than_beside_another():
    """Two who are absent differ by their own densities alone, however people's sizes vary."""
    old, new = [cues(0, 0.0, 0.0), cues(1, 0.0, 0.0, 1.06)], cues(9, 5.0, 0.0)
    right, wrong = limb_cues(new, old, LEGS)
    lengths = new.lengths * np.sqrt(1.06)
    variance = (0.02**2 + 0.04**2 / 30.0) / lengths**2
    squares = np.sum(np.log(1.06) ** 2 / variance)
    assert right - wrong == pytest.approx(7.5 * math.log1p(squares / 8.0))  # t of 10 degrees


def test_who_was_never_measured_is_as_good_as_a_stranger_and_silences_nobody():
    old, new = [cues(0, 0.0, 0.0), cues(1, 0.0, 0.0, n=0.0)], cues(9, 5.0, 0.0)
    old[1].lengths[:] = 0.0
    known, unknown = limb_cues(new, old, LEGS)
    assert known > 0.8 * limb_cue(new, old[0], LEGS) > 1.0
    assert unknown == 0.0


def test_limbs_are_learned_for_as_long_as_somebody_is_seen():
    tracker, limbs = _Tracker(MODEL, TrackParams(), Events(), CAMERAS), set()
    for frame in standing([person()], 0, 12):
        list(tracker.take(Block.of(frame)))
        limbs |= set(tracker._people.bank.past.length_counts[0].tolist())
    assert max(limbs) == 720


def test_nobody_gets_the_id_of_who_may_as_well_be_somebody_else():
    """Two absent people of almost one size: it is one of them with 92 %, the other with 6 %."""
    old = [cues(0, 0.0, 0.0), cues(1, 0.1, 0.0, 1.046)]
    verdict = reidentify([cues(9, 5.0, 0.0)], old, missing=2, limbs=LEGS)[9]
    assert str(verdict) == "limb lengths, 92% person 0, 6% others"
    assert not verdict.accepted


def test_limbs_tell_the_more_the_longer_both_were_seen():
    sizes = 1.0, 1.08
    right, wrong = (
        [limb_cue(cues(9, 5.0, 0.0, size, seen_for=s), cues(0, 0.0, 0.0, seen_for=s), LEGS)
         for s in (0.8, 3.0, 12.0)]
        for size in sizes
    )  # fmt: skip
    assert 0.0 < right[0] < right[1] < right[2]
    assert 0.0 > wrong[1] > wrong[2]
    assert wrong[0] > wrong[1]


def test_who_may_be_another_one_is_given_no_id_while_more_is_to_come():
    """Two are absent; the limbs are at first those of the other, as somebody walks in."""
    stays, short, tall = person(-2.0), person(0.0), person(1.5) * 1.06
    frames = standing([stays, short, tall], 0, 6) + standing([stays], 6, 9)
    frames += standing([stays, person(0.5) * 1.06], 9, 10.2)
    frames += standing([stays, person(0.5)], 10.2, 17)
    assert ids(frames)[-1] == [0, 1]


@pytest.mark.parametrize(("same", "accepted"), [(0.0, False), (0.98, True)])
def test_two_ids_that_may_be_of_one_person_do_not_silence_each_other(same, accepted):
    first, second = cues(0, 0.0, 0.0), replace(cues(1, 1.0, 0.0), may_be={0: same})
    verdict = reidentify([cues(9, 5.0, 0.0)], [first, second], missing=1, limbs=LEGS)[9]
    assert (verdict.person, verdict.accepted) == (1, accepted)  # the later id


def test_of_many_who_left_the_first_one_is_known_again():
    """Seven people of different sizes left one after the other."""
    old = [cues(k, 0.1 * k, 0.0, 1.0 + 0.08 * k) for k in range(7)]
    for size, person_id in ((1.0, 0), (1.48, 6)):
        verdict = reidentify([cues(9, 5.0, 0.0, size)], old, missing=7, limbs=LEGS)[9]
        assert (verdict.person, verdict.accepted) == (person_id, True)


def test_a_noisy_measurement_of_the_size_does_not_rule_somebody_out():
    assert reidentify([cues(9, 5.0, 0.0, 1.05)], [cues(0, 0.0, 0.0)], missing=1, limbs=LEGS)[
        9
    ].accepted


def test_an_old_id_is_given_once_at_most():
    """Both newcomers fit the one who is absent: together they can't be him."""
    verdicts = reidentify([cues(8, 5.0, 0.0), cues(9, 5.0, 0.1)], [cues(0, 0.0, 0.0)], 1, LEGS)
    assert sum(verdict.probability for verdict in verdicts.values()) <= 1.0
    assert not any(verdict.accepted for verdict in verdicts.values())


def test_the_number_of_people_tips_the_balance():
    newcomer, old = [cues(9, 10.0, 2.0, n=0.0)], [cues(0, 0.0, 0.0, n=0.0)]
    missing, complete = (reidentify(newcomer, old, n, LEGS)[9].probability for n in (1, 0))
    assert missing > 0.8 > 0.6 > complete
    assert reidentify(newcomer, old, 1, LEGS)[9].cue == "number of people"


def test_whom_one_camera_carries_off_for_a_moment_keeps_the_id():
    """Two cameras are silent for 0.28 s; the third, 0.25 m off, jumps by 17 cm. 12 Hz."""
    rng = np.random.default_rng(2)
    frames = []
    for k, camera in itertools.product(range(72), range(3)):
        seconds = (k + camera / 3) / 12
        if camera < 2 and 3.0 < seconds < 3.28:
            continue
        jump = 0.17 if 3.0 < seconds < 3.5 else 0.0
        body = person(0.0, 0.25 + jump if camera == 2 else 0.0)
        stamp = START + round(seconds * SECOND)
        frames.append(seen([body + rng.normal(0.0, 0.02, body.shape)], stamp, "abc"[camera]))
    found = ids(sorted(frames, key=lambda frame: frame.stamp))
    assert {i for each in found for i in each} - {-1} == {0}
