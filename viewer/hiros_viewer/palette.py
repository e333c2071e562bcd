"""Colours of what is no person: cameras and their detections stay dim."""

from __future__ import annotations

from hiros_mcap.io.export.colours import RGB

CAMERAS: tuple[RGB, ...] = (
    (78, 88, 98),
    (96, 85, 74),
    (75, 94, 78),
    (93, 78, 94),
    (93, 91, 72),
    (72, 93, 93),
)
CURVES: tuple[RGB, ...] = (
    (160, 185, 210),
    (220, 180, 140),
    (150, 210, 160),
    (215, 160, 220),
    (215, 210, 130),
    (130, 210, 210),
)
"""Of cameras, for lines in a plot: those of their detections, brighter."""
CLASSES = 100
"""People have the classes 0..99, by id; greater ids begin anew."""


def pale(colour: RGB) -> RGB:
    """Return a colour halfway to white: the second of two logs."""
    red, green, blue = colour
    return ((red + 255) // 2, (green + 255) // 2, (blue + 255) // 2)


def curve_colour(index: int) -> RGB:
    """Colour of a camera's curves."""
    return CURVES[index % len(CURVES)]


def camera_colour(index: int) -> RGB:
    """Colour of the detections of the camera with this number."""
    return CAMERAS[index % len(CAMERAS)]
