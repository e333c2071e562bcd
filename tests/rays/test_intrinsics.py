"""Pixels and directions of an RGB camera."""

import numpy as np
import pytest

from hiros_mcap.rays.intrinsics import FISHEYE, PLUMB_BOB, RATIONAL, Intrinsics

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
