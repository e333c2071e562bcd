"""Humans as frames of tf, as ROS4HRI publishes them (ROS REP 155, kinematic model of the human).

A body with the id ``abcde`` is the frame ``body_abcde``, whose parent is the camera's frame, and
below it the links of the package human_description: ``l_shoulder_abcde``, ``head_abcde``, ...
A body is read once all frames of one instant are there, which the next instant shows. A message is
refused that gives a body more frames than any human has.
hri_msgs itself has 2D skeletons only; they cannot be fused.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from hiros_mcap.body.rotations import Rigid
from hiros_mcap.body.transforms import Transform, parse_tf
from hiros_mcap.errors import LogError
from hiros_mcap.io.channels import TRANSFORM_TYPES, is_static_topic
from hiros_mcap.io.detectors.body_models import body_model
from hiros_mcap.io.detectors.detector_reader import (
    DetectorMessage,
    DetectorReader,
    SeenPeople,
    seen_people,
)
from hiros_mcap.skeletons import Floats

ROOT = "body_"
_LINK = re.compile(r"(?P<part>.+)_(?P<body>[^_]+)")
_LEAST = 6
"""Joints of human_description below a frame ``body_X`` that make it a human, not a robot's part."""
_MOST = 200
"""Frames of a human: those of human_description, with hands, face and marks of any model."""
_SAME_NS = 5_000_000
"""Frames whose stamps differ by less belong to one instant: several nodes publish them."""
_BACK_NS = 1_000_000_000
"""A stamp that is earlier by less comes late; otherwise the one before was wrong."""


@dataclass(slots=True)
class _Human:
    """The frames of one human."""

    number: int
    frames: dict[str, Transform] = field(default_factory=dict)
    """Latest transform of each frame, by its name without the id."""
    stamp: int = 0

    @property
    def camera(self) -> str:
        """The frame that it is in, "" as long as nobody said."""
        return self.frames["body"].parent.lstrip("/") if "body" in self.frames else ""


class HumanFrames(DetectorReader):
    """Reads /tf and /tf_static; the camera is the frame in which the bodies are."""

    types = TRANSFORM_TYPES

    def __init__(self) -> None:
        self._model = body_model("ros4hri")
        self._parts = frozenset(self._model.marker_names)
        self._bodies: dict[str, _Human] = {}
        self._instants: dict[str, tuple[int, DetectorMessage]] = {}
        """By camera: the stamp, and the last message that was part of it."""

    def read(self, message: DetectorMessage) -> Iterable[SeenPeople] | None:
        """Take note of the frames; return the bodies whose instant is over."""
        done: list[SeenPeople] = []
        is_new = False
        links = [
            (match["part"], match["body"], transform)
            for transform in parse_tf(message.cdr)
            if (match := _LINK.fullmatch(transform.child.lstrip("/")))
        ]
        self._check(links)
        for part, name, transform in links:
            body = self._bodies.setdefault(name, _Human(len(self._bodies)))
            if part in self._parts and not is_static_topic(message.topic):
                done += self._advance(body, transform.stamp, message)
                is_new |= self._is_human(body.frames)
            body.frames[part] = transform
        return done if is_new else None

    def rest(self) -> Iterator[SeenPeople]:
        """Return the last instant of every camera."""
        for camera in self._instants:
            yield from self._finish(camera)

    def _is_human(self, frames: Collection[str]) -> bool:
        """Whether a body with these frames has enough of a human's joints."""
        return "body" in frames and len(self._parts.intersection(frames)) >= _LEAST

    def _check(self, links: Iterable[tuple[str, str, Transform]]) -> None:
        """Raise LogError if a human has more frames than there can be."""
        frames: dict[str, set[str]] = {}
        for part, name, _ in links:
            if name not in frames:
                frames[name] = {*self._bodies[name].frames} if name in self._bodies else set()
            frames[name].add(part)
        for name, parts in frames.items():
            if len(parts) > _MOST and self._is_human(parts):
                text = f"has {len(parts)} frames, more than the {_MOST} of a human"
                raise LogError(f"{ROOT}{name} {text}")

    def _advance(self, body: _Human, stamp: int, message: DetectorMessage) -> Iterable[SeenPeople]:
        """Note that a frame of a body has a stamp; return its camera's last instant if it ends."""
        camera = body.camera
        instant, _ = self._instants.get(camera, (0, message))
        done: list[SeenPeople] = []
        if not instant - _BACK_NS <= stamp <= instant + _SAME_NS:
            done += self._finish(camera)
            instant = stamp
        body.stamp = instant
        self._instants[camera] = instant, message
        return done

    def _finish(self, camera: str) -> Iterator[SeenPeople]:
        """Yield the people of a camera's instant."""
        if camera not in self._instants or not camera:
            return
        instant, last = self._instants[camera]
        people = {
            name: body
            for name, body in self._bodies.items()
            if body.camera == camera and body.stamp == instant and self._is_human(body.frames)
        }
        if not people:
            return
        positions = np.array([self._positions(name, body) for name, body in people.items()])
        ids = [body.number for body in people.values()]
        message = replace(last, topic=f"/{camera}/bodies")
        yield seen_people(self._model, message, camera, positions, stamp=instant, ids=ids)

    def _positions(self, name: str, body: _Human) -> Floats:
        """(M, 3) of the joints in the camera's frame; NaN where a frame is missing."""
        poses: dict[str, Rigid] = {}
        missing = np.full(3, np.nan)
        return np.array(
            [
                _pose(body, part, name, poses).translation if part in body.frames else missing
                for part in self._model.marker_names
            ]
        )


def _pose(body: _Human, part: str, name: str, poses: dict[str, Rigid]) -> Rigid:
    """Pose of a frame in the camera's frame; ``poses`` has those that are known, and gets more."""
    chain: dict[str, Rigid] = {}  # upwards; a loop of a faulty tree ends where it began
    while part in body.frames and part not in chain and part not in poses:
        transform = body.frames[part]
        chain[part] = Rigid(np.array(transform.xyzw), np.array(transform.translation))
        part = "" if part == "body" else transform.parent.lstrip("/").removesuffix(f"_{name}")
    above = poses.get(part, Rigid.identity())
    for part, pose in reversed(chain.items()):
        above = poses[part] = above @ pose
    return above
