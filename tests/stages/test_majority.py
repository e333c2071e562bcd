"""Who is outvoted about a joint, and who is not."""

from __future__ import annotations

import numpy as np
import pytest
from builders import at_once

from hiros_mcap.skeletons import Frame, SkeletonModel
from hiros_mcap.stages.fuse.fuse import fuse_blocks
from hiros_mcap.stages.fuse.fuse_params import FuseParams
from hiros_mcap.stages.fuse.fusing import Sightings
from hiros_mcap.stages.fuse.majority import LIMIT, Majority

SECOND = 1_000_000_000
ARM = SkeletonModel.of(["shoulder", "elbow", "wrist"], [("a", 0, 1), ("b", 1, 2)])
fuse = at_once(fuse_blocks)


def outvoted(positions, deviation=0.007, times=None, people=None):
    """(I, C) Whether cameras are outvoted about one joint, by its places (I, C), m, along x."""
    instants, cameras = np.shape(positions)
    n = instants * cameras
    places = np.zeros((n, 1, 3))
    places[:, 0, 0] = np.ravel(positions)
    times = np.arange(instants)[:, None] / 30 if times is None else times
    views = Sightings.allocate(n, 1)._replace(
        instants=np.repeat(np.arange(instants), cameras),
        people=np.zeros(n, np.int64) if people is None else np.ravel(people),
        cameras=np.tile(np.arange(cameras), instants),
        stamps=np.round((times + np.zeros((instants, cameras))).ravel() * 1e9 + SECOND).astype(int),
        positions=places, outvoted=np.zeros((n, 1)),
    )  # fmt: skip
    Majority(1).vote(views, np.full((n, 1), deviation**2))
    return (views.outvoted > LIMIT**2).reshape(instants, cameras)


@pytest.mark.parametrize(
    ("places", "expected"),
    [
        ((0.0, 0.01, 0.2), (0, 0, 1)),
        ((0.2, 0.0, 0.01, -0.02), (1, 0, 0, 0)),
        ((0.0, 0.2, 0.01, 0.2, -0.02), (0, 1, 0, 1, 0)),
        ((0.0, 0.01, 0.9 * LIMIT), (0, 0, 0)),
        ((0.0, 0.01, np.nan, 0.2), (0, 0, 0, 1)),
    ],
)
def test_who_sees_a_joint_elsewhere_than_most_is_outvoted(places, expected):
    assert outvoted([places]).ravel().tolist() == [bool(k) for k in expected]


@pytest.mark.parametrize("places", [(0.0, 0.3), (0.0, 0.3, np.nan), (0.0, 0.2, 0.4)])
def test_nobody_is_outvoted_where_nobody_knows_who_is_right(places):
    assert not outvoted([places]).any()


def test_a_measurement_of_great_variance_is_not_outvoted():
    """It counts little anyway; where it is right, three standard deviations are usual."""
    assert not outvoted([(0.0, 0.01, 0.2)], deviation=0.05).any()


def test_people_are_not_mixed():
    """Two cameras see one person, three the other one, .2 m away."""
    assert not outvoted([(0.0, 0.2, 0.0, 0.2, 0.2)], people=[(0, 1, 0, 1, 1)]).any()


def test_a_fast_joint_is_where_its_cameras_saw_it_at_their_times():
    """8 m/s: what the last of four cameras sees, 25 ms later, is 17 cm from what the others see."""
    times = np.arange(30)[:, None] / 30 + [0.0, 0.002, 0.004, 0.025]
    assert not outvoted(8.0 * times, times=times)[3:].any()


def test_a_camera_that_is_wrong_first_does_not_bend_the_result():
    """One camera of four shows the wrist .3 m away from the beginning; the others come later."""
    rng, frames = np.random.default_rng(2), []
    for k in range(60):
        for c, name in enumerate("abcd" if k > 5 else "a"):
            frame = Frame.empty(1, ARM, stamp=SECOND + k * SECOND // 30 + c * 10**6, source=name)
            frame.ids[:] = 0
            frame.markers[0, :, :3] = [[0, 0, 1], [0.3, 0, 1], [0.5, 0, 1]]
            frame.markers[0, :, :3] += rng.normal(0, 0.005, (3, 3))
            frame.markers[0, 2, 1] += 0.3 * (name == "a")
            frame.marker_confidences[:] = frame.confidences[:] = 0.9
            frames.append(frame)

    def error(majority):
        results = list(fuse(frames, ARM, FuseParams(majority=majority)))
        return np.mean([abs(frame.positions[0, 2, 1]) for frame in results[15:]])

    assert error(True) < 0.01 < 0.1 < error(False)
