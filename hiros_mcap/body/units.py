"""Units and axes of positions as users name them, for all cameras or for some."""

from __future__ import annotations

from collections.abc import Collection

METRES = {"mm": 0.001, "cm": 0.01, "m": 1.0}
"""Units in which people are measured."""
AXES = ("x", "y", "z")


def by_camera(text: str, values: Collection[str]) -> dict[str, str]:
    """Read a value of each camera: ``mm`` of all, ``left=mm,right=cm`` of some; "" is all cameras.

    Raises ValueError for another value than one of ``values``.
    """
    found: dict[str, str] = {}
    for part in filter(None, text.split(",")):
        camera, _, value = part.rpartition("=")
        if value.strip() not in values or camera.strip() in found:
            some = ", ".join(values)
            raise ValueError(f"should be one of {some}, or of some cameras: CAMERA={value or some}")
        found[camera.strip()] = value.strip()
    return found


def is_called(topic: str, camera: str) -> bool:
    """Whether a user means a topic: "" means any, otherwise it is the topic or a part of it."""
    return f"/{camera.strip('/')}/" in f"/{topic.strip('/')}/" if camera else True
