"""The ball in rendered images."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from rendered_ball import RADIUS, K, compressed, header, image, millimetres, render

from hiros_mcap.body.intrinsics import Intrinsics
from hiros_mcap.body.rotations import Rigid
from hiros_mcap.calibrate.ball_image import ColorRange, DepthCamera, find_ball
from hiros_mcap.errors import ConfigError, LogError
from hiros_mcap.io.ros_messages import colour_image, depth_image, is_colour, is_depth

LENS = Intrinsics((160, 120), K, np.zeros(5))
CAMERA = DepthCamera(LENS.rays(120, 160), K[0, 0], None, Rigid.identity())
HEAD = header(10**18, "camera")


def error_of(ball, seed, **options):
    found = find_ball(*render(ball, seed, **options), CAMERA, RADIUS, ColorRange())
    return np.inf if found is None else float(np.linalg.norm(found.centre - ball))


def test_centre_with_noise_holes_and_strays():
    """5 mm of noise, 30 % strays, 30 % holes, a box of the same colour: 3 mm."""
    rng = np.random.default_rng(3)
    balls = rng.uniform([-0.3, -0.3, 0.9], [0.3, 0.1, 1.7], (30, 3))
    errors = [error_of(ball, k, wrong=0.3) for k, ball in enumerate(balls)]
    assert np.mean(np.isfinite(errors)) > 0.9
    assert np.median(errors) < 0.002
    assert np.percentile(np.array(errors)[np.isfinite(errors)], 95) < 0.003


@pytest.mark.parametrize("seed", range(5))
def test_things_of_the_same_colour_are_no_ball(seed):
    """A flat box of the ball's colour, a ball of another size, two balls."""
    assert find_ball(*render(None, seed), CAMERA, RADIUS, ColorRange()) is None
    small = render(np.array([0, 0, 1.2]), seed, radius=0.5 * RADIUS)
    assert find_ball(*small, CAMERA, RADIUS, ColorRange()) is None
    one, two = (render(np.array([x, 0, 1.2]), seed) for x in (-0.2, 0.2))
    right = np.arange(160) > 80
    both = np.where(right[:, None], two[0], one[0]), np.where(right, two[1], one[1])
    assert find_ball(*both, CAMERA, RADIUS, ColorRange()) is None


def test_a_flat_patch_is_no_ball_at_any_size():
    rng = np.random.default_rng(0)
    for half in range(4, 40, 4):
        pixels, depth = render(None, half, clutter=False)
        pixels[60 - half : 60 + half, 80 - half : 80 + half] = (30, 30, 200)
        depth[:] = 1.2 + rng.normal(0, 0.003, depth.shape)
        assert find_ball(pixels, depth, CAMERA, RADIUS, ColorRange()) is None, half


def test_the_middle_of_the_ball_hidden_by_an_arm():
    ball = np.array([0.05, 0, 1.1])
    pixels, depth = render(ball, 4)
    pixels[:, 83:87], depth[:, 83:87] = (120, 150, 200), 0.9
    found = find_ball(pixels, depth, CAMERA, RADIUS, ColorRange())
    assert found is not None
    assert np.linalg.norm(found.centre - ball) < 0.004


def test_depth_camera_beside_the_colour_camera():
    """Depth in its own frame, 3 cm to the left and of another focal length; centre in colour's."""
    ball, beside = np.array([0.1, 0.0, 1.2]), np.array([0.03, 0.0, 0.0])
    pixels = cv2.resize(render(ball, 7)[0], (320, 240), interpolation=cv2.INTER_NEAREST)
    depth = render(ball + beside, 8)[1]
    larger = np.diag([2.0, 2.0, 1.0]) @ K + [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
    lens = Intrinsics((320, 240), larger, np.zeros(5))
    to_colour = Rigid(np.array([0, 0, 0, 1.0]), -beside)
    camera = CAMERA._replace(colour=lens, to_colour=to_colour)
    found = find_ball(pixels, depth, camera, RADIUS, ColorRange())
    assert found is not None
    assert np.linalg.norm(found.centre - ball) < 0.003


def test_lens_distortion_is_undone():
    lens = Intrinsics((160, 120), K, np.array([-0.2, 0.05, 0.001, -0.001, 0.0]))
    rays = lens.rays(120, 160)[40, 20]
    assert lens.pixels(np.array([[*rays, 1.0]]))[0] == pytest.approx([20, 40], abs=1e-3)


def test_a_green_ball():
    pixels, depth = render(np.array([0, 0, 1.2]), 2, clutter=False)
    green = np.ascontiguousarray(pixels[:, :, [0, 2, 1]])
    assert find_ball(green, depth, CAMERA, RADIUS, ColorRange()) is None
    assert find_ball(green, depth, CAMERA, RADIUS, ColorRange.parse("50-70:110-255:50-255"))


@pytest.mark.parametrize(
    "text", ["red", "1-2:3-4", "0-180:0-1:0-1", "0-9:9-1:0-1", "0-9:0-1:0-256"]
)
def test_a_wrong_color_names_the_option(text):
    with pytest.raises(ConfigError, match="--color: "):
        ColorRange.parse(text)


METRES = np.array([[1.0, np.nan], [2.5, 4.0]])
QUANTISED = np.array([[10000.0 / 1.0 + 5, 0], [10000.0 / 2.5 + 5, 10000.0 / 4.0 + 5]])
CONFIG = b"\0\0\0\0" + np.array([10000.0, 5.0], "<f4").tobytes()


@pytest.mark.parametrize(
    "message",
    [
        image(HEAD, millimetres(METRES), "16UC1"),
        image(HEAD, METRES.astype("<f4"), "32FC1"),
        compressed(HEAD, millimetres(METRES), "16UC1; compressedDepth png", ".png", bytes(12)),
        compressed(HEAD, QUANTISED.astype("u2"), "32FC1; compressedDepth png", ".png", CONFIG),
    ],
    ids=["16UC1", "32FC1", "png", "quantised"],
)
def test_depth_in_metres(message):
    assert is_depth(message)
    assert not is_colour(message)
    assert np.allclose(depth_image(message), METRES, atol=1e-3, equal_nan=True)


def test_colour_is_blue_green_red():
    pixels = np.full((4, 4, 3), (10, 200, 90), np.uint8)
    for message in (
        image(HEAD, pixels, "bgr8"),
        image(HEAD, pixels[:, :, ::-1], "rgb8"),
        image(HEAD, np.dstack([pixels[:, :, ::-1], pixels[:, :, 0]]), "rgba8"),
        compressed(HEAD, pixels, "rgb8; png compressed bgr8", ".png"),
        compressed(HEAD, pixels, "jpeg", ".jpg"),
    ):
        assert is_colour(message)
        assert np.abs(colour_image(message).astype(int) - pixels).max() <= 3


def test_damaged_images():
    short = image(HEAD, millimetres(METRES), "16UC1")
    short.height = 3
    with pytest.raises(LogError, match="2 x 3 pixels has only 16 bytes"):
        depth_image(short)
    broken = compressed(HEAD, millimetres(METRES), "png", ".png", b"x")
    with pytest.raises(LogError, match="cannot be decoded"):
        colour_image(broken)
