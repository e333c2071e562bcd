"""Readers of what detectors publish, one sibling per kind. docs/detectors.md adds another one.

hiros knows its own, those that a program adds, and those that packages bring, by an entry point of
the group ``hiros.detectors``::

    [project.entry-points."hiros.detectors"]
    my_bodies = "my_package.reader:MyBodies"
"""

from __future__ import annotations

from functools import cache

from hiros_mcap.io.detectors.azure_kinect import AzureKinectMarkers
from hiros_mcap.io.detectors.body_models import body_model, linked
from hiros_mcap.io.detectors.detector_reader import (
    DetectorMessage,
    DetectorReader,
    SeenPeople,
    nanoseconds,
    seen_people,
)
from hiros_mcap.io.detectors.human_frames import HumanFrames
from hiros_mcap.io.detectors.rgb_keypoints import RgbKeypoints
from hiros_mcap.io.detectors.skeleton_groups import SkeletonGroups
from hiros_mcap.io.detectors.yolo_bodies import YoloBodies
from hiros_mcap.io.detectors.zed import ZedBodies
from hiros_mcap.plugins import DETECTORS, faulty, installed, load

__all__ = [
    "DetectorMessage",
    "DetectorReader",
    "SeenPeople",
    "body_model",
    "linked",
    "nanoseconds",
    "register_detector",
    "seen_people",
]

_READERS: list[type[DetectorReader]] = [
    SkeletonGroups,
    AzureKinectMarkers,
    ZedBodies,
    HumanFrames,
    YoloBodies,
    RgbKeypoints,
]


def register_detector(reader: type[DetectorReader]) -> type[DetectorReader]:
    """Add a reader; usable as a decorator. Of two for one type, the later is asked first."""
    if reader not in _READERS:
        _READERS.insert(0, reader)
    return reader


def detector_readers() -> tuple[type[DetectorReader], ...]:
    """Return all readers in the order in which they are asked.

    Raises ConfigError for an entry point that cannot be loaded, or is no reader.
    """
    return (*_READERS, *(r for r in _installed() if r not in _READERS))


def types_read() -> set[str]:
    """Return the types that readers take, ``pkg/Type``."""
    return {name for reader in detector_readers() for name in reader.types}


@cache
def _installed() -> tuple[type[DetectorReader], ...]:
    readers = []
    for point in installed(DETECTORS).values():
        reader = load(point)
        if not (isinstance(reader, type) and issubclass(reader, DetectorReader)):
            raise faulty(point, "is no DetectorReader")
        readers.append(reader)
    return tuple(readers)
