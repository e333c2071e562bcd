"""Pixels and directions of an RGB camera."""

import numpy as np
import pytest

from hiros_mcap.body.intrinsics import FISHEYE, PLUMB_BOB, RATIONAL, Intrinsics

MATRIX = np.array([[800.0, 0.0, 320.0], [0.0, 780.0, 250.0], [0.0, 0.0, 1.0]])
LENSES = {
    PLUMB_BOB: [-0.2, 0.05, 0.001, -0.001],
    RATIONAL: [0.3, -0.1, 0.0, 0.001, 0.02, 0.4, -0.1, 0.01],
    FISHEYE: [0.1, -0.03, 0.002, 0.0],
}


@pytest.mark.parametrize("model", LENSES)
def test_directions_and_pixels_belong_together(model):
    lens = Intrinsics((640, 480), MATRIX, np.array(LENSES[model]), model)
    points = np.array([[0.0, 0.0, 2.0], [0.6, -0.3, 2.0], [np.nan] * 3, [0.0, 0.0, -1.0]])
    pixels = lens.pixels(points)
    assert pixels[0] == pytest.approx([320, 250])
    assert np.isnan(pixels[2:]).all()
    straight = [320 + 800 * 0.3, 250 - 780 * 0.15]
    assert np.linalg.norm(pixels[1] - straight) > 1.0  # the lens is not left out
    assert lens.normalized(pixels)[:2] == pytest.approx(points[:2, :2] / 2, abs=1e-5)


def lens_of(size, focal, distortion, model=PLUMB_BOB):
    width, height = size
    matrix = np.array([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    return Intrinsics(size, matrix, np.array(distortion, np.float64), model)


@pytest.mark.parametrize(
    "lens",
    [
        lens_of((1088, 1920), 1680, [-0.05, 0.12, 0.0, 0.0, 0.0]),
        lens_of((3840, 2160), 1750, [-0.25, 0.09, 0.0005, 0.0003, -0.0145]),  # an action camera
        lens_of((1280, 720), 700, [-0.4, 0.0, 0.0, 0.0]),  # its corners fold
        lens_of((1024, 1024), 252, [4.3, 2.7, 0, 0, 0.13, 4.6, 4.2, 0.7], RATIONAL),  # 120 degrees
        lens_of((2704, 1520), 1100, [0.05, 0.02, -0.02, 0.005], FISHEYE),
        lens_of((848, 800), 286, [-0.006, 0.04, -0.038, 0.006], FISHEYE),
        lens_of((1920, 1080), 1080 / np.radians(220), np.zeros(4), FISHEYE),
    ],
)
def test_a_real_lens_is_one(lens):
    assert lens.fault == ""


@pytest.mark.parametrize("value", [-1e30, -1e5, 1e5, 1e30, 1e300])
@pytest.mark.parametrize("model", LENSES)
def test_a_distortion_that_leaves_little_of_the_image_is_a_fault(value, model):
    size, most = (640, 480), [value] * len(LENSES[model])
    if model == RATIONAL:
        most[5:] = [0.0] * 3  # of equal numerator and denominator nothing would be left
    assert "cannot be undone on" in Intrinsics(size, MATRIX, np.array(most), model).fault
    first = np.array(value * np.eye(len(most))[0])
    assert "cannot be undone on" in Intrinsics(size, MATRIX, first, model).fault
