"""The keypoints of RGB cameras, triangulated: the skeletons of one more camera in the fixed frame.

This reader takes the messages of all RGB cameras of a log, and keeps a :class:`Triangulator`. Of a
file it is told beforehand how the cameras stand (:mod:`hiros_mcap.io.rgb_cameras`); live it learns
that from transforms and lenses as they come. 3D skeletons whose depth is guessed are keypoints, too
(:mod:`hiros_mcap.rays.skeleton_rays`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np

import hiros_schemas
from hiros_mcap.body.intrinsics import Intrinsics
from hiros_mcap.body.rotations import Rigid
from hiros_mcap.body.transforms import TransformTree
from hiros_mcap.errors import LogError
from hiros_mcap.io.detectors.detector_reader import (
    DetectorMessage,
    DetectorReader,
    SeenPeople,
    add_links,
)
from hiros_mcap.io.detectors.keypoint_messages import KEYPOINT_TYPES, decode_keypoints, joined
from hiros_mcap.rays.keypoints import TRIANGULATED, KeypointFrame, cleaned, confidence_of
from hiros_mcap.rays.skeleton_rays import NONE_GUESSED, GuessedDepth, keypoints_of
from hiros_mcap.rays.triangulator import LocatedPeople, Triangulator
from hiros_mcap.skeletons import Frame, SkeletonModel
from hiros_mcap.wording import quantity

_ONE_PERSON = hiros_schemas.short_name(hiros_schemas.SKELETON_2D)
NO_LENS = "no usable CameraInfo is in their frame; record camera_info of a calibrated lens"
RGB_TOPIC = "/rgb/skeletons"
"""Channel of the triangulated skeletons."""


@dataclass(frozen=True)
class RgbRig:
    """How the RGB cameras of a log stand, before their keypoints are read."""

    tree: TransformTree
    """With their poses as they are used."""
    fixed_frame: str
    """In which the skeletons are."""
    lenses: dict[str, Intrinsics]
    """By optical frame."""
    faults: Mapping[str, str]
    """Why a frame has no lens, though there is CameraInfo of it."""
    models: dict[str, SkeletonModel]
    """Of the joints on each topic."""
    homes: Mapping[str, str] = field(default_factory=dict)
    """Optical frame -> the frame in the tree, where that has another name."""
    lags: Mapping[str, float] = field(default_factory=dict)
    """By optical frame: s by which stamps are late."""
    late: Mapping[str, float] = field(default_factory=dict)
    """The same by topic."""
    is_moved: bool = False
    """Whether poses are not those of the log."""
    remarks: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    guessed: GuessedDepth = NONE_GUESSED
    """3D skeletons that are taken as keypoints; the above have their topics and frames, too."""
    changes: Mapping[str, str] = field(default_factory=dict)
    """Live: how the lens of a frame changes, as a warning. Of a file, ``warnings`` has it."""


def keypoints_of_guess(frame: Frame, guessed: GuessedDepth) -> KeypointFrame:
    """Return 3D skeletons whose depth is guessed as keypoints of :data:`.skeleton_rays.LENS`."""
    name = frame.frame_id.lstrip("/")
    pixels = keypoints_of(frame.positions, guessed.turns.get(name, Rigid.identity()))
    stamp = max(frame.stamps.tolist(), default=0) or frame.stamp
    found = cleaned(pixels, frame.marker_confidences)
    return KeypointFrame(name, stamp or frame.log_time, frame.log_time, *found)


class RgbKeypoints(DetectorReader):
    """Reads the keypoints of all RGB cameras.

    Attributes
    ----------
    rig : the cameras; None = not known (yet), so that nothing can be triangulated.
    """

    types = KEYPOINT_TYPES

    def __init__(self) -> None:
        self.rig: RgbRig | None = None
        self.model: SkeletonModel | None = None
        self._triangulator: Triangulator | None = None
        self._begun: dict[str, tuple[str, KeypointFrame]] = {}
        """Topic and people so far of an image, by optical frame, see :meth:`_whole`."""
        self._homeless: Counter[str] = Counter()
        """Messages of cameras whose lens or place is not known, by optical frame."""
        self._foreign: Counter[str] = Counter()
        """Messages with other joints, by topic."""
        self._blank: dict[str, bool] = {}
        """Topic -> whether it has shown people, but no keypoint that counts."""

    def read(self, message: DetectorMessage) -> Iterable[SeenPeople] | None:
        """Take the keypoints of an image; return the people of the instants that are complete."""
        if self.rig is None:  # live, where lenses and poses may come later
            return []
        if message.topic not in self.rig.models:
            return None
        joints = self.rig.models[message.topic].n_markers
        images = [(message.topic, decode_keypoints(message, joints, self.rig.lenses))]
        if message.type == _ONE_PERSON:
            images = self._whole(*images[0])
        return [people for image in images for people in self._located(*image, self.rig)]

    def _whole(self, topic: str, found: KeypointFrame) -> list[tuple[str, KeypointFrame]]:
        """Return the image before, once the next one of its camera begins.

        ROS4HRI has a topic per person; their messages of one stamp are of one image.
        """
        before = self._begun.pop(found.camera, None)
        is_same = before is not None and before[1].stamp == found.stamp
        if before is not None and is_same:
            found = joined(before[1], found)._replace(log_time=found.log_time)
        self._begun[found.camera] = topic, found
        return [] if before is None or is_same else [before]

    def take(self, topic: str, frame: Frame) -> list[SeenPeople]:
        """Take 3D skeletons whose depth is guessed, of the topic's model; return as read() does."""
        if self.rig is None:
            return []
        return list(self._located(topic, keypoints_of_guess(frame, self.rig.guessed), self.rig))

    def rest(self) -> Iterator[SeenPeople]:
        """Return the people of the last instants."""
        for image in sorted(self._begun.values(), key=lambda image: image[1].log_time):
            if self.rig is not None:
                yield from self._located(*image, self.rig)
        self._begun.clear()
        if self._triangulator is not None:
            yield from map(self._people, self._triangulator.rest())

    def _located(self, topic: str, image: KeypointFrame, rig: RgbRig) -> Iterator[SeenPeople]:
        """Yield the people of the instants that an image completes."""
        name, lens, model = image.camera, rig.lenses.get(image.camera), rig.models[topic]
        if lens is None:
            self._homeless[name] += 1
            return
        if self.model not in (None, model):
            self._foreign[topic] += 1
            return
        self.model = model
        if len(image.pixels):
            shows = bool(np.isfinite(image.pixels).any())
            self._blank[topic] = self._blank.get(topic, True) and not shows
        self._triangulator = triangulator = self._triangulator or Triangulator(model)
        try:
            home = rig.homes.get(name, name)
            pose = rig.tree.lookup(home, rig.fixed_frame, image.stamp, image.log_time)
        except LogError:
            self._homeless[name] += 1
            return
        if name in rig.guessed.turns:
            pose = pose @ rig.guessed.turns[name]
        if name not in triangulator.lenses:
            triangulator.add_camera(name, lens, rig.lags.get(name, 0.0))
        yield from map(self._people, triangulator.add(image, pose))

    def _people(self, skeletons: LocatedPeople) -> SeenPeople:
        """Return the people of an instant; confidences say how well their joints are known."""
        assert self.model is not None and self.rig is not None  # noqa: S101 - for the type
        n, fixed = len(skeletons.points), self.rig.fixed_frame
        frame = Frame.empty(
            n, self.model, stamp=skeletons.stamp, log_time=skeletons.log_time,
            source=TRIANGULATED, frame_id=fixed,
        )  # fmt: skip
        frame.markers[:, :, :3] = skeletons.points
        frame.marker_confidences[:] = confidence_of(skeletons.deviations)
        with suppress(ZeroDivisionError):
            frame.confidences[:] = np.nan_to_num(skeletons.scores).mean(axis=1)
        frame.stamps[:] = skeletons.stamp
        add_links(frame, self.model)
        return SeenPeople(RGB_TOPIC, self.model, frame)

    def warnings(self) -> Iterator[str]:
        """Name the cameras none of whose keypoints counts."""
        for name, n in self._homeless.items():
            if self.rig is not None and name not in self.rig.lenses:
                why = self.rig.faults.get(name, NO_LENS)
                yield f"{name}: {quantity(n, 'message')} of keypoints not used: {why}"
        if self._triangulator is not None and self.rig is not None:
            changes, used = self.rig.changes, self._triangulator.lenses
            yield from (text for name, text in changes.items() if name in used)
            yield from self._triangulator.warnings()
        for topic in (topic for topic, is_blank in self._blank.items() if is_blank):
            yield (
                f"{topic}: no keypoint counts: each has a score of 0 or less, lies at 0 0, or far "
                "outside the image; let the detector give scores from 0 to 1, and px of the image "
                "of camera_info"
            )

    def remarks(self) -> Iterator[str]:
        """Say how the cameras were taken, and what of their keypoints is not in the skeletons."""
        if self.rig is not None:
            yield from self.rig.remarks
            for name, n in self._homeless.items():
                if name in self.rig.lenses:
                    some = quantity(n, "message")
                    yield f"{name}: {some} of keypoints not used: no lens or no pose was known yet"
        for topic, n in self._foreign.items():
            yield f"{topic}: {quantity(n, 'message')} not used: other joints than other cameras'"
        if self._triangulator is not None:
            yield from self._triangulator.remarks()
