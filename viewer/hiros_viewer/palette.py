"""Colours: one per person, always the same; cameras and their detections stay dim."""

from __future__ import annotations

RGB = tuple[int, int, int]

# Ten colours that stay apart on a dark ground and for colour-blind people.
PEOPLE: tuple[RGB, ...] = (
    (255, 140, 0),
    (0, 174, 255),
    (50, 220, 90),
    (255, 80, 160),
    (250, 220, 50),
    (160, 110, 255),
    (0, 220, 210),
    (255, 90, 70),
    (190, 230, 60),
    (210, 160, 255),
)
CAMERAS: tuple[RGB, ...] = (
    (96, 108, 120),
    (118, 104, 90),
    (92, 116, 96),
    (114, 96, 116),
    (114, 112, 88),
    (88, 114, 114),
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


def person_colour(person: int) -> RGB:
    """Colour of an id."""
    return PEOPLE[person % len(PEOPLE)]


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
