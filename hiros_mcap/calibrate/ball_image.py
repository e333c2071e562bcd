"""Find a coloured ball of known radius in one colour and depth image (Lee et al. 2022, 2.1.1)."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from hiros_mcap.body.intrinsics import Intrinsics, opencv
from hiros_mcap.body.rotations import Rigid
from hiros_mcap.calibrate.registration import fit_sphere
from hiros_mcap.errors import ConfigError, RegistrationError
from hiros_mcap.io.ros_messages import Bytes
from hiros_mcap.skeletons import Floats

Labels = npt.NDArray[np.int32]

LEAST_PIXELS = 30
"""A ball that covers fewer depth pixels is too far away."""
MOST_REGIONS = 4
"""Regions of the colour that are tried, the largest first."""
MOST_POINTS = 1500  # of a region, from which the sphere is found
COVERAGE = 0.3
"""Least share of the ball's disc that inliers must cover: a small flat patch fits any sphere."""
CURVED = 1.5
"""How much worse than the sphere a plane must fit."""
NOISE_M, NOISE_PER_M2 = 0.01, 0.003
"""Tolerance of the fit: the noise of depth grows with the square of the range."""
BINS = 30, 32
"""Of the histogram over hue and saturation."""
LIKELY = 0.03
"""A colour belongs to the ball if it is so frequent, compared with the ball's commonest one."""


class ColorRange(NamedTuple):
    """Range of the ball's colour in OpenCV's HSV: hue 0 to 179, the others 0 to 255."""

    low: tuple[int, int, int] = (170, 110, 50)
    high: tuple[int, int, int] = (10, 255, 255)
    """If its hue is less than the low one, the range goes over 179 to 0. The default is red."""

    @classmethod
    def parse(cls, text: str) -> ColorRange:
        """Read ``H-H:S-S:V-V``; raises ConfigError if it is of another form."""
        try:
            pairs = [tuple(map(int, part.split("-"))) for part in text.split(":")]
            (h0, h1), (s0, s1), (v0, v1) = pairs
        except ValueError:
            raise ConfigError(f"--color: {text!r} is not of the form H-H:S-S:V-V") from None
        if not (max(h0, h1) < 180 and s0 <= s1 < 256 and v0 <= v1 < 256):
            raise ConfigError(f"--color: {text!r}: hue is 0 to 179, the others are 0 to 255")
        return cls((h0, s0, v0), (h1, s1, v1))


class DepthCamera(NamedTuple):
    """How the depth and the colour image of a camera belong together."""

    rays: Floats  # (H, W, 2) x / z and y / z of the depth image's pixels
    focal: float  # of the depth image, pixels
    colour: Intrinsics | None
    """Lens of the colour image; None if each depth pixel belongs to the same colour pixel."""
    to_colour: Rigid  # from the frame of the depth image to that of the colour image


class BallFit(NamedTuple):
    """The ball in one frame of a camera."""

    centre: Floats  # (3,) m, in the frame of the colour image
    inliers: int  # depth pixels on it
    radius: float  # radius of the sphere that fits these pixels best, m


def find_ball(
    image: Bytes, depth: Floats, camera: DepthCamera, radius: float, color: ColorRange
) -> BallFit | None:
    """Return the ball in a colour image (H, W, 3) and a depth image (h, w), None if it is not seen.

    The ball is that region of its colour which is a sphere of its radius, m. Depths are in m. Two
    such spheres at different places are no ball: nobody can tell which one is meant.
    """
    labels = color_regions(image, color)
    points, region_of = points_of_labels(labels, depth, camera)
    # Depth has holes. Where each depth pixel has its colour pixel, they can be counted.
    size = int((labels > 0).sum()) if camera.colour is None else 0
    focal = camera.focal * math.sqrt(len(points) / size if size else 1.0)
    regions = [points[region_of == k] for k in range(1, MOST_REGIONS + 1)]
    balls = [ball for region in regions if (ball := fit_ball(region, points, focal, radius))]
    if not balls:
        return None
    ball = max(balls, key=lambda fit: fit.inliers)  # an arm may cut the ball in two
    if any(np.linalg.norm(ball.centre - fit.centre) > 0.5 * radius for fit in balls):
        return None
    return ball._replace(centre=camera.to_colour.moved(ball.centre))


def color_regions(image: Bytes, color: ColorRange) -> Labels:
    """(H, W) number of each pixel's region, the largest is 1; 0 = of another colour.

    Pixels in the range give the histogram of hue and saturation under this light. Its
    back-projection (Swain and Ballard 1991) finds what has the same colours.
    """
    cv2 = opencv()

    hsv: Any = cv2.cvtColor(image, cv2.COLOR_BGR2HSV)
    seed = _in_range(hsv, color)
    histogram: Any = cv2.calcHist([hsv], [0, 1], seed, list(BINS), [0, 180, 0, 256])
    if not histogram.max():
        return np.zeros(image.shape[:2], np.int32)
    histogram = cv2.GaussianBlur(histogram, (3, 3), 0)  # the shaded side is rare and noisy
    histogram *= 255.0 / histogram.max()
    likely = cv2.calcBackProject([hsv], [0, 1], histogram, [0, 180, 0, 256], 1)
    mask: Any = ((likely >= 255 * LIKELY) & (hsv[:, :, 2] >= color.low[2])).astype(np.uint8)
    square = np.ones((3, 3), np.uint8)
    mask = cv2.morphologyEx(mask, cv2.MORPH_OPEN, square)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=4)
    sizes = stats[1:, cv2.CC_STAT_AREA]
    rank = np.zeros(len(stats), np.int32)
    rank[1 + np.argsort(-sizes, kind="stable")] = np.arange(1, len(stats))
    return np.asarray(rank[labels])


def _in_range(hsv: Any, color: ColorRange) -> Bytes:
    cv2 = opencv()

    (h0, *low), (h1, *high) = color
    if h0 <= h1:
        return np.asarray(cv2.inRange(hsv, (h0, *low), (h1, *high)))
    upper: Any = cv2.inRange(hsv, (h0, *low), (179, *high))
    lower: Any = cv2.inRange(hsv, (0, *low), (h1, *high))
    return np.asarray(upper | lower)


def points_of_labels(labels: Labels, depth: Floats, camera: DepthCamera) -> tuple[Floats, Labels]:
    """(N, 3) points of the colour, m, in the depth camera's frame, and (N,) their regions."""
    measured = np.isfinite(depth)
    if camera.colour is None:
        measured &= labels > 0
    z = depth[measured]
    points = np.column_stack([camera.rays[measured] * z[:, None], z])
    if camera.colour is None:
        return points, labels[measured]
    of_points = _labels_of(points, labels, camera.colour, camera.to_colour)
    return points[of_points > 0], of_points[of_points > 0]


def _labels_of(points: Floats, labels: Labels, lens: Intrinsics, to_colour: Rigid) -> Labels:
    """Return the label of the colour pixel at which each point of the depth image appears."""
    values = np.zeros(len(points), np.int32)
    moved = to_colour.moved(points)
    front = np.flatnonzero(moved[:, 2] > 0.0)
    columns, rows = np.rint(lens.pixels(moved[front])).T
    inside = (columns >= 0) & (columns < labels.shape[1]) & (rows >= 0) & (rows < labels.shape[0])
    values[front[inside]] = labels[rows[inside].astype(int), columns[inside].astype(int)]
    return values


def fit_ball(region: Floats, points: Floats, focal: float, radius: float) -> BallFit | None:
    """Return the ball of which a region (N, 3), m, is the largest part, None if it is of no ball.

    Besides the sphere's inliers, three things must fit: the sphere bulges towards the camera, a
    plane fits worse, and enough of its disc is covered by ``points`` (M, 3) of all regions.

    Parameters
    ----------
    focal : focal length that gives the number of depth pixels on a disc; see :class:`DepthCamera`.
    """
    if len(region) < LEAST_PIXELS:
        return None
    sample = region[:: 1 + len(region) // MOST_POINTS]
    distance = float(np.linalg.norm(np.median(region, axis=0)))
    tolerance = min(max(NOISE_M, NOISE_PER_M2 * distance**2), 0.2 * radius)
    try:
        fit = fit_sphere(sample, radius, tolerance=tolerance)
    except RegistrationError:
        return None
    surface = sample[fit.inliers]
    on_ball = np.abs(np.linalg.norm(points - fit.centre, axis=1) - radius) <= tolerance
    disc = math.pi * (focal * radius / float(fit.centre[2])) ** 2
    plane = np.linalg.svd(surface - surface.mean(axis=0), compute_uv=False)[2]
    bulges = np.linalg.norm(fit.centre) > np.linalg.norm(surface.mean(axis=0))
    flat = plane / math.sqrt(len(surface)) < CURVED * fit.rms
    inliers = int(on_ball.sum())
    if not bulges or flat or inliers < COVERAGE * disc:
        return None
    return BallFit(fit.centre, inliers, _free_radius(surface, fit.centre))


def _free_radius(surface: Floats, centre: Floats) -> float:
    """Return the radius, m, of the sphere nearest to the points, by Gauss-Newton from a centre."""
    radius = 0.0
    for _ in range(5):
        rays = surface - centre
        lengths = np.linalg.norm(rays, axis=1)
        rows = np.column_stack([rays / lengths[:, None], np.ones(len(rays))])
        *step, radius = np.linalg.lstsq(rows, lengths, rcond=None)[0]
        centre = centre + np.array(step)
    return float(radius)
