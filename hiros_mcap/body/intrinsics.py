"""How an RGB camera maps directions to pixels: focal length, principal point and distortion."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any

import numpy as np

from hiros_mcap.skeletons import Floats

PLUMB_BOB = "plumb_bob"
RATIONAL = "rational_polynomial"
FISHEYE = "equidistant"
"""Models of distortion, by the names of sensor_msgs/CameraInfo."""
COUNTS = {PLUMB_BOB: (0, 4, 5, 8), RATIONAL: (5, 8, 12, 14), FISHEYE: (4,)}
"""How many coefficients each model has, in the order of OpenCV."""

_SHORTEST_FOCAL = 0.05  # of the larger side of the image; less is in mm, say
_LEAST_KNOWN, _KNOWN = 0.25, 0.01
"""Share of the image whose pixels can be undistorted to this part of its larger side. Of a fisheye
lens of 220 degrees it is 0.3, since nothing is known of what lies behind a camera."""
_ALONG = 16  # pixels along each side that tell that share

_LIMIT = "OPENCV_IO_MAX_IMAGE_PIXELS"


def opencv() -> Any:
    """Return the module cv2, which decodes no picture of more than 2**27 pixels.

    It reads that when it is loaded. Its own limit is 2**30: 100 kB of PNG would take 6 GB.
    """
    is_ours = _LIMIT not in os.environ
    os.environ.setdefault(_LIMIT, str(1 << 27))
    try:
        import cv2
    finally:
        if is_ours:
            del os.environ[_LIMIT]
    return cv2


@dataclass(frozen=True, eq=False)
class Intrinsics:
    """The inner geometry of a camera, as OpenCV and ``sensor_msgs/CameraInfo`` write it.

    The camera's optical frame has x to the right, y down and z forward.
    """

    size: tuple[int, int]
    """Width and height of the image, px."""
    matrix: Floats
    """(3, 3) focal lengths and principal point, px."""
    distortion: Floats
    """(D,) coefficients of ``model``; empty = none."""
    model: str = PLUMB_BOB

    @property
    def fault(self) -> str:
        """Why this is no lens of a camera, with the remedy; "" if it is one."""
        matrix, longest = self.matrix, max(self.size)
        is_finite = bool(np.isfinite(matrix).all())
        there = min(self.size) > 0 and min(matrix[0, 0], matrix[1, 1]) > _SHORTEST_FOCAL * longest
        is_flat = bool((matrix[[1, 2, 2, 2], [0, 0, 1, 2]] == (0, 0, 0, 1)).all())
        if not (is_finite and there and is_flat):
            return "has no focal lengths in px or no image size; calibrate the lens"
        across, down = (np.linspace(0.0, side - 1.0, _ALONG) for side in self.size)
        pixels = np.stack(np.meshgrid(across, down), axis=-1)
        with np.errstate(all="ignore"):
            seen = np.insert(self.normalized(pixels), 2, 1.0, axis=-1)
            missed = np.linalg.norm(self.pixels(seen) - pixels, axis=-1)
        unknown = 1.0 - float(np.mean(missed < _KNOWN * longest))
        if unknown > 1.0 - _LEAST_KNOWN:
            return (
                f"has a distortion that cannot be undone on {unknown:.0%} of its image; calibrate "
                "the lens"
            )
        return ""

    @property
    def focal(self) -> float:
        """Mean focal length, px."""
        return float(self.matrix[0, 0] + self.matrix[1, 1]) / 2

    def rays(self, height: int, width: int) -> Floats:
        """(H, W, 2) x / z and y / z of what each pixel of an image sees."""
        columns, rows = np.meshgrid(np.arange(width), np.arange(height))
        return self.normalized(np.stack([columns, rows], axis=-1).astype(np.float64))

    def normalized(self, pixels: Floats) -> Floats:
        """Take the distortion out: (..., 2) px -> (..., 2) x / z and y / z; NaN stays NaN."""
        flat = np.reshape(pixels, (-1, 2)).astype(np.float64)
        out = np.full(flat.shape, np.nan)
        there = np.isfinite(flat).all(axis=1)
        if not there.any():
            return out.reshape(np.shape(pixels))
        points = flat[there][:, None]
        cv2 = opencv()

        if self.model == FISHEYE:
            found = cv2.fisheye.undistortPoints(points, self.matrix, self.distortion)
        elif np.any(self.distortion):
            found = cv2.undistortPoints(points, self.matrix, self.distortion)
        else:
            fx, fy, cx, cy = self.matrix[[0, 1, 0, 1], [0, 1, 2, 2]]
            found = (points - (cx, cy)) / (fx, fy)
        out[there] = found[:, 0]
        return out.reshape(np.shape(pixels))

    def pixels(self, points: Floats) -> Floats:
        """Project (..., 3) points of the optical frame, m -> (..., 2) px; NaN behind the camera."""
        flat = np.reshape(points, (-1, 3)).astype(np.float64)
        out = np.full((len(flat), 2), np.nan)
        front = flat[:, 2] > 0  # also false for NaN
        if not front.any():
            return out.reshape(*np.shape(points)[:-1], 2)
        cv2 = opencv()

        zero, seen = np.zeros(3), flat[front][:, None]
        if self.model == FISHEYE:
            found, _ = cv2.fisheye.projectPoints(seen, zero, zero, self.matrix, self.distortion)
        else:
            found, _ = cv2.projectPoints(seen, zero, zero, self.matrix, self.distortion)
        out[front] = found.reshape(-1, 2)
        return out.reshape(*np.shape(points)[:-1], 2)
