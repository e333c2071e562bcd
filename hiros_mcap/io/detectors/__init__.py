"""Readers of what detectors publish, one sibling per kind. docs/detectors.md adds another one."""

from hiros_mcap.io.detectors.body_models import body_model, linked
from hiros_mcap.io.detectors.detector_reader import (
    DetectorMessage,
    DetectorReader,
    SeenPeople,
    nanoseconds,
    seen_people,
)
from hiros_mcap.io.detectors.registry import register_detector

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
