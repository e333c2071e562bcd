"""Colours: hues tell people apart, shades tell left from right; cameras stay dim."""

from __future__ import annotations

from hiros_mcap.io.export.markers import RGB

CAMERAS: tuple[RGB, ...] = (
    (78, 88, 98),
    (96, 85, 74),
    (75, 94, 78),
    (93, 78, 94),
    (93, 91, 72),
    (72, 93, 93),
)
CURVES: tuple[RGB, ...] = (
    (128, 148, 168),
    (176, 144, 112),
    (120, 168, 128),
    (172, 128, 176),
    (172, 168, 104),
    (104, 168, 168),
)
"""Of cameras, for lines on a dark or white plot: those of their detections, brighter."""
SIDES: dict[str, RGB] = {"right": (112, 132, 255), "left": (168, 163, 154), "": (140, 150, 205)}
"""Of curves of one person's limbs: strong and pale, and of nobody's hue."""
DISPLACEMENT: RGB = (255, 245, 110)
"""Of lines to where joints or cameras were before; the truth is white."""
TRUTH: RGB = (235, 240, 235)
"""Of true people, beside a result in hues."""
DISTANCES: dict[str, RGB] = {"mean": CURVES[2], "largest": CURVES[3]}
"""Of curves of the distance between two logs, whose people are orange and blue."""
SILENCE: RGB = (110, 110, 110)
"""Of the lane while no camera sends anything."""
ERROR: RGB = (255, 70, 70)
"""Of lines from a result's joints to the true ones."""
BEFORE: RGB = (150, 150, 150)
"""Of a stage that is compared with the result."""
_LEFT = 0.55
"""Brightness of left limbs to that of right ones; hue alone would fail the colour-blind."""
_GREY: RGB = (92, 98, 106)
_WHITE: RGB = (255, 255, 255)
CLASSES = 100
"""People have the classes 0..99, by id; greater ids begin anew."""


def _mixed(colour: RGB, other: RGB, n: int) -> RGB:
    """Return one part of a colour and n parts of another."""
    red, green, blue = ((a + n * b) // (n + 1) for a, b in zip(colour, other, strict=True))
    return red, green, blue


def pale(colour: RGB) -> RGB:
    """Return a colour halfway to white: of ellipsoids, through which one looks."""
    return _mixed(colour, _WHITE, 1)


def faint(colour: RGB) -> RGB:
    """Return a colour near the room's grey: of somebody whom no camera sees."""
    return _mixed(colour, _GREY, 2)


def label_colour(colour: RGB) -> RGB:
    """Return almost white with a trace of the colour: labels have dark or grey boxes by theme."""
    return _mixed(colour, _WHITE, 4)


def shade(colour: RGB) -> RGB:
    """Return the darker shade of a colour, which left limbs have."""
    red, green, blue = (round(_LEFT * part) for part in colour)
    return red, green, blue


def curve_colour(index: int) -> RGB:
    """Colour of a camera's curves."""
    return CURVES[index % len(CURVES)]


def camera_colour(index: int) -> RGB:
    """Colour of the detections of the camera with this number."""
    return CAMERAS[index % len(CAMERAS)]
