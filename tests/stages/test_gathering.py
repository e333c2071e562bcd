"""The fuser's means of orientations and link positions at an instant."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hiros_mcap.kernels.averaging import Buffers
from hiros_mcap.skeletons import People, SkeletonModel
from hiros_mcap.stages.fuse.gathering import WIDTHS, ViewGatherer
from hiros_mcap.stages.merge.merge_params import MergeParams

MODEL = SkeletonModel.of(("root", "end"), [("bone", 0, 1)])
SECOND = 1_000_000_000


def views_of(degrees, confidences=None):
    """One view of person 7 by each camera, whose link is turned about z."""
    people = People.absent(len(degrees), 2, 1)
    people.ids[:] = 7
    people.markers[:, :, :3] = 0.0
    people.links[:, 0, :3] = np.arange(len(degrees))[:, None]
    turned = Rotation.from_euler("z", np.array(degrees, float)[:, None], degrees=True)
    people.links[:, 0, 3:7] = turned.as_quat()
    people.link_confidences[:] = 0.5 if confidences is None else np.array(confidences)[:, None]
    return people


def fused(gatherer, people, stamp=SECOND, times=None):
    """The person at one instant; nobody shows her where ``people`` is None."""
    n = 0 if people is None else len(people.ids)
    people = People.absent(1, 2, 1) if people is None else people
    messages = [[k, k + 1, stamp if times is None else times[k], k] for k in range(n)]
    buffers = Buffers(
        np.array([stamp]), np.array([0, 1]), np.array([0, n]),
        np.array(messages, np.int64).reshape(n, 4),
        np.array([gatherer.bank.row(7, stamp)]), np.zeros((len(people.ids), 2)),
    )  # fmt: skip
    out = People.allocate(1, 2, 1, *WIDTHS)
    out.ids[:] = 7
    gatherer(buffers, people, n, out, np.zeros((0, n), np.int64))
    return out


def heading(out):
    """Degrees about z of the fused link."""
    return Rotation.from_quat(out.links[0, 0, 3:7]).as_euler("zyx", degrees=True)[0]


@pytest.fixture
def gatherer():
    return ViewGatherer(MODEL, MergeParams())


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 1, 0), (1, 2, 0)])
def test_one_wrong_view_of_three_hardly_turns_a_link(gatherer, order):
    out = fused(gatherer, views_of(np.array([10, 14, 130])[list(order)]))
    assert heading(out) == pytest.approx(12, abs=3)


def test_a_surer_view_counts_by_the_square_of_its_confidence(gatherer):
    assert heading(fused(gatherer, views_of([0, 5], [0.8, 0.4]))) == pytest.approx(1, abs=0.05)


def test_views_without_any_confidence_count_alike(gatherer):
    assert heading(fused(gatherer, views_of([0, 6], [0.0, 0.0]))) == pytest.approx(3, abs=0.01)


def test_the_sign_of_a_quaternion_does_not_matter(gatherer):
    people = views_of([20, 24])
    people.links[1, 0, 3:7] *= -1
    assert heading(fused(gatherer, people)) == pytest.approx(22, abs=0.01)


def test_a_view_is_turned_on_to_the_time_of_the_instant(gatherer):
    people = views_of([0, 0])
    people.links[:, 0, 10:13] = [0, 0, np.radians(90)]
    out = fused(gatherer, people, times=[SECOND - 100_000_000] * 2)
    assert heading(out) == pytest.approx(9)


def test_where_two_views_contradict_each_other_the_last_mean_decides(gatherer):
    fused(gatherer, views_of([10, 10]))
    out = fused(gatherer, views_of([12, 150]), stamp=SECOND + 33_000_000)
    assert heading(out) == pytest.approx(12, abs=10)


def test_a_view_without_an_orientation_says_nothing_of_the_links_place(gatherer):
    people = views_of([0, 0])
    people.links[1, 0, 3:7] = np.nan
    assert fused(gatherer, people).links[0, 0, 0] == 0.0


def test_who_is_not_seen_keeps_the_orientation_and_loses_confidence(gatherer):
    fused(gatherer, views_of([30]))
    soon = fused(gatherer, None, stamp=SECOND + 100_000_000)
    late = fused(gatherer, None, stamp=SECOND + 500_000_000)
    assert heading(soon) == heading(late) == pytest.approx(30)
    assert [soon.link_confidences[0, 0], late.link_confidences[0, 0]] == pytest.approx([0.5, 0.25])


def test_orientations_of_markers_are_averaged_as_well(gatherer):
    people = views_of([0, 0])
    people.markers[:, 1, 3:7] = Rotation.from_euler("z", [[0], [10]], degrees=True).as_quat()
    turned = Rotation.from_quat(fused(gatherer, people).markers[0, 1, 3:7])
    assert turned.as_euler("zyx", degrees=True)[0] == pytest.approx(5, abs=0.01)
