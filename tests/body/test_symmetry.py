"""Left and right are read from the names that detectors use."""

from __future__ import annotations

import pytest
from stick_figures import MIRROR, MODEL

from hiros_mcap.body.symmetry import split_side, symmetry_of
from hiros_mcap.skeletons import SkeletonModel


@pytest.mark.parametrize(
    ("left", "right"),
    [
        ("SHOULDER_LEFT", "SHOULDER_RIGHT"),
        ("ShoulderLeft", "ShoulderRight"),
        ("left_shoulder", "right_shoulder"),
        ("LShoulder", "RShoulder"),
        ("lshoulder", "rshoulder"),
        ("Shoulder.L", "Shoulder.R"),
        ("l_shoulder", "r_shoulder"),
    ],
)
def test_sides_by_name(left, right):
    assert (split_side(left), split_side(right)) == (("shoulder", "left"), ("shoulder", "right"))
    symmetry = symmetry_of(SkeletonModel.of(["Head", left, right], []))
    assert symmetry.mirror.tolist() == [0, 2, 1]
    assert symmetry.lateral.tolist() == [[1, 2]]


@pytest.mark.parametrize("name", ["Head", "Pelvis", "Lumbar", "Root", "SPINE_NAVAL", "", "3"])
def test_names_without_a_counterpart_have_no_side(name):
    assert not symmetry_of(SkeletonModel.of([name, "Neck"], [])).has_sides


def test_links_mirror_as_their_ends_do():
    symmetry = symmetry_of(MODEL)
    assert symmetry.mirror.tolist() == MIRROR
    assert symmetry.link_mirror.tolist() == [0, 2, 1, 4, 3, 6, 5]
