"""Poses and images that fit only the other way round are refused by name."""

import numpy as np
import pytest
from filmed import JOINTS, around, film, film_log, turned, walking

from hiros_mcap.errors import LogError
from hiros_mcap.running.pipeline import process
from hiros_mcap.simulate import simulate

RIG = around(3)  # of four at right angles, mirrored images fit: people turned around


def log_of(path, *, mirrored=(), poses=RIG):
    """Two people walk before four cameras; some images are mirrored, with the sides of people."""
    names = [simulate().model.marker_names[m] for m in JOINTS]
    scene = film(walking(people=2, seconds=4.0), RIG, noise=0.5)
    other = [n.replace("LEFT", "x").replace("RIGHT", "LEFT").replace("x", "RIGHT") for n in names]
    sides = [names.index(name) for name in other]
    for camera in mirrored:
        scene.frames[camera] = [
            f._replace(pixels=([1279.0, 0.0] + np.array([-1.0, 1.0]) * f.pixels)[:, sides])
            for f in scene.frames[camera]
        ]
    film_log(path, scene, names, poses)
    return path


@pytest.mark.parametrize("mirrored", [["cam2"], list(RIG)])
def test_mirrored_videos_are_named(mirrored, tmp_path):
    with pytest.raises(LogError, match=rf"the images of {', '.join(mirrored)} are mirrored"):
        process(log_of(tmp_path / "log.mcap", mirrored=mirrored))


def test_inverted_poses_are_named(tmp_path):
    inverse = {name: pose.inverse() for name, pose in RIG.items()}
    with pytest.raises(LogError, match="poses of the RGB cameras are the other way round"):
        process(log_of(tmp_path / "log.mcap", poses=inverse))


def test_poses_that_are_only_wrong_are_corrected(tmp_path):
    summary = process(log_of(tmp_path / "log.mcap", poses=turned(RIG, 3.0)))
    assert len(summary.people) == 2
