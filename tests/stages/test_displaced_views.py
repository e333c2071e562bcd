"""Cameras that show people elsewhere than the others lose their weight."""

from __future__ import annotations

import re

import numpy as np
import pytest
from builders import at_once, same

from hiros_mcap.events import CAMERA_BACK, CAMERA_DISPLACED, Events
from hiros_mcap.frames import by_frame
from hiros_mcap.kernels.array_types import chosen, joined
from hiros_mcap.skeletons import Frame, SkeletonModel
from hiros_mcap.stages.fuse.displaced_views import (
    LIMIT,
    LIMIT_AHEAD,
    SHARE,
    DisplacedViews,
    excess_of,
    limits_of,
)
from hiros_mcap.stages.fuse.fuse import FuseParams, fuse_blocks
from hiros_mcap.stages.fuse.fusing import Sightings
from hiros_mcap.stages.known_cameras import KnownCameras

fuse = at_once(fuse_blocks)

BODY = SkeletonModel.of([f"m{k}" for k in range(8)], [])
REALTIME = {"lookahead": 0.02, "window": 0.0}
SECOND = 1_000_000_000


def views_of(cameras, seconds=1.0, person=0):
    """Views of one person by some cameras, ten a second each."""
    n = round(10 * seconds)
    stamps = np.repeat(np.arange(n) * SECOND // 10, cameras)
    return Sightings.allocate(n * cameras, 1)._replace(
        stamps=stamps, people=np.full(len(stamps), person), cameras=np.tile(np.arange(cameras), n)
    )


def excess(*metres):
    """Excess of each camera, m2, of cameras that are off by so much along x."""
    views = views_of(len(metres))
    offsets = np.zeros((len(views.stamps), 3))
    offsets[:, 0] = np.array(metres)[views.cameras]
    return excess_of(views, offsets, np.full(len(metres), LIMIT))[: len(metres)]


def test_who_is_off_alone_loses_its_weight():
    assert excess(0.16, -0.04, -0.04, -0.04, -0.04) == pytest.approx([SHARE * 0.16**2, 0, 0, 0, 0])
    assert excess(-0.03, 0.06, -0.03) == pytest.approx([0, SHARE * 0.06**2, 0])


def test_a_small_offset_is_that_of_the_detector():
    assert not excess(0.9 * LIMIT, 0.0, 0.0).any()


def test_without_a_majority_nobody_loses_weight():
    assert not excess(0.2, -0.2).any()
    assert not excess(0.07, -0.06, 0.06, -0.07).any()


def test_each_second_and_each_person_counts_alone():
    views = views_of(3, seconds=2)
    offsets = np.zeros((60, 3))
    offsets[(views.cameras == 2) & (views.stamps >= SECOND)] = 0.1
    limits = np.full(3, LIMIT)
    lost = excess_of(views, offsets, limits) > 0
    np.testing.assert_array_equal(lost, (views.cameras == 2) & (views.stamps >= SECOND))
    others = views._replace(people=np.where(views.stamps >= SECOND, 1, 0))
    np.testing.assert_array_equal(excess_of(others, offsets, limits) > 0, lost)


@pytest.mark.parametrize(("error", "is_displaced"), [(0.004, True), (0.034, False)])
def test_a_pose_that_people_gave_may_be_off_by_its_error(error, is_displaced):
    """A rig of three cameras, found from people who merely sit down, has errors of 3 to 10 cm."""
    limits = limits_of("abc", {"c": error})
    views = views_of(3)
    offsets = np.zeros((len(views.stamps), 3))
    offsets[views.cameras == 2, 0] = 0.07
    assert (excess_of(views, offsets, limits) > 0).any() == is_displaced


def told(*lost, seconds=12.0):
    """Events, if each camera's views lose their weight in some seconds, of a person."""
    views, events = DisplacedViews(KnownCameras(), is_filter=False), Events()
    views.name(tuple("abcdef"[: len(lost)]))
    seen = views_of(len(lost), seconds=seconds)
    is_off = [int(t) in lost[c] for t, c in zip(seen.stamps / SECOND, seen.cameras, strict=True)]
    excess = np.where(is_off, SHARE * 0.08**2, 0.0)
    for k in range(0, len(is_off), 7):  # as they come in a live run
        part = slice(k, k + 7)
        views.count(chosen(seen, part), excess[part], np.ones(len(excess[part]), np.bool_))
    views.warn(events)
    return [(event.kind, event.source, event.stamp // SECOND, event.detail) for event in events.log]


def test_a_camera_that_shows_people_in_place_again_is_displaced_no_longer():
    """Its clock was corrected, or its pose was found."""
    (event,) = told({}, {1, 2, 3}, {}, {})
    assert event[:3] == (CAMERA_BACK, "b", 1)
    assert event[3] == "showed people 0.08 m from where other cameras see them for 3.0 s"
    (event,) = told({}, {1, 2, 3, *range(8, 12)}, {}, {})[1:]
    assert event[:3] == (CAMERA_DISPLACED, "b", 8)


def test_seconds_here_and_there_are_those_of_people():
    """Who is half hidden for a second is seen wrong, by whichever camera it is."""
    assert told({}, {1, 4, 7, 10}, {}, {}) == []


def test_if_most_cameras_are_displaced_none_is():
    last = set(range(8, 12))
    assert [source for _, source, _, _ in told({}, {}, last, last)] == ["c", "d"]
    assert told({}, last, last, last) == []
    assert told(last, last, last, last) == []


@pytest.mark.parametrize("n_displaced", [1, 4])
def test_a_camera_that_was_moved_shows_everybody_elsewhere(n_displaced):
    """Of people who touch, one camera may see some wrong for seconds."""
    views, events = DisplacedViews(KnownCameras(), is_filter=False), Events()
    views.name(("a", "b", "c"))
    seen = joined([views_of(3, seconds=4.0, person=person) for person in range(4)])
    is_off = (seen.cameras == 1) & (seen.people < n_displaced)
    views.count(seen, np.where(is_off, SHARE * 0.1**2, 0.0), np.ones(len(is_off), np.bool_))
    views.warn(events)
    told = [(event.source, event.kind) for event in events.log]
    assert told == ([("b", CAMERA_DISPLACED)] if n_displaced == 4 else [])


def learned(*metres):
    """Excess that a filter expects of each camera after batches in which camera 2 was off so much.

    None: it alone was there.
    """
    displaced = DisplacedViews(KnownCameras(), is_filter=True)
    displaced.name(("a", "b", "c"))
    views = views_of(3)
    views = views._replace(instants=np.arange(len(views.stamps)) // 3)
    for off in metres:
        batch = chosen(views, views.cameras == 2) if off is None else views
        offsets = np.zeros((len(batch.stamps), 3))
        offsets[batch.cameras == 2, 0] = off or 0.0
        displaced.take(batch, offsets, np.ones(len(offsets), np.bool_))
        displaced.learn()
    return displaced.expected(chosen(views, slice(3)))


def test_a_filter_knows_it_from_the_views_before():
    assert learned() == pytest.approx([0, 0, 0])
    assert learned(0.9 * LIMIT_AHEAD) == pytest.approx([0, 0, 0])
    assert learned(0.1) == pytest.approx([0, 0, SHARE * 0.1**2])
    assert learned(0.1, None) == pytest.approx([0, 0, SHARE * 0.1**2])
    assert learned(0.1, 0.0) == pytest.approx([0, 0, 0])


def test_chunks_of_instants_change_nothing_in_a_filter():
    """A live run hands over one at a time."""
    frames = detections({"b": 0.15})
    together, alone = (
        list(stage(frames, BODY, FuseParams(**REALTIME))) for stage in (fuse, by_frame(fuse_blocks))
    )
    assert len(together) == len(alone) > 250
    assert all(map(same, together, alone))


def detections(shift):
    """20 s of one who moves before four cameras, of which some are displaced from 10 s on."""
    rng = np.random.default_rng(5)
    times = np.arange(300) / 15
    place = 0.4 * np.sin(times[:, None, None] + np.arange(24.0).reshape(8, 3))
    frames = []
    for k, t in enumerate(times):
        for c, name in enumerate("abcd"):
            frame = Frame.empty(1, BODY, stamp=round((t + 0.005 * c) * 1e9) + SECOND, source=name)
            frame.ids[:] = 0
            frame.markers[0, :, :3] = place[k] + rng.normal(0, 0.01, (8, 3))
            if t >= 10:
                frame.markers[0, :, 0] += shift.get(name, 0.0)
            frame.marker_confidences[:] = frame.confidences[:] = 0.9
            frames.append(frame)
    return frames


def error(shift, left_out="", pose_error=0.0, **params):
    """Mean error, m, in the last 8 s."""
    known = KnownCameras(errors={"b": pose_error})
    frames = [f for f in detections(shift) if f.source != left_out or f.stamp < 11 * SECOND]
    events = Events()
    errors = []
    for frame in fuse(frames, BODY, FuseParams(**params), events, known=known):
        t = frame.stamp * 1e-9 - 1
        if t > 12:
            true = 0.4 * np.sin(t + np.arange(24.0).reshape(8, 3))
            errors.append(np.linalg.norm(frame.positions[0] - true, axis=1).mean())
    return float(np.mean(errors)), events


@pytest.mark.parametrize("params", [{"window": 5.0}, REALTIME])
def test_a_camera_that_was_moved_hardly_harms_the_result(params):
    moved, events = error({"b": 0.15}, **params)
    without, _ = error({}, left_out="b", **params)
    assert moved < 1.2 * without
    (event,) = (e for e in events.log if e.kind == CAMERA_DISPLACED)
    assert event.source == "b"
    assert re.search(r" 0\.1[45] m ", event.detail)
    assert event.stamp * 1e-9 - 1 == pytest.approx(10, abs=1.1)


@pytest.mark.parametrize("params", [{"window": 5.0}, REALTIME])
def test_a_camera_of_an_uncertain_pose_keeps_its_weight(params):
    _, events = error({"b": 0.15}, pose_error=0.06, **params)
    assert not [e for e in events.log if e.kind == CAMERA_DISPLACED]


@pytest.mark.parametrize("params", [{"window": 5.0}, REALTIME])
def test_healthy_cameras_are_not_named(params):
    _, events = error({}, **params)
    assert not [e for e in events.log if e.kind == CAMERA_DISPLACED]
