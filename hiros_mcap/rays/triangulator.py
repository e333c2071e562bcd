"""The keypoints of all RGB cameras as the skeletons of one more camera, in the fixed frame.

::

    triangulator = Triangulator(model)
    triangulator.add_camera("left", lens)
    for frame, pose in frames:
        for skeletons in triangulator.add(frame, pose):
            ...

Images come in, as they do live; common instants, who is who, and the joints in space come out.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

from hiros_mcap.body.intrinsics import Intrinsics
from hiros_mcap.body.rotations import Rigid
from hiros_mcap.body.symmetry import symmetry_of
from hiros_mcap.rays.common_instants import CommonInstants, ImagePeople, mean_known, sizes_of
from hiros_mcap.rays.cross_view import Detections, People3D
from hiros_mcap.rays.keypoints import KeypointFrame
from hiros_mcap.skeletons import SECOND, Floats, SkeletonModel
from hiros_mcap.wording import quantity

_TWICE = 0.1  # of a person's size in the image: two detections as near are of one person

_FEW = 20  # detections of a camera that tell nothing about it
_STRANGE = 0.01  # share of a camera's detections that may be of somebody by chance


class LocatedPeople(NamedTuple):
    """The people at one instant, from several images."""

    stamp: int
    """ns."""
    log_time: int
    """Of the last image that was waited for, ns."""
    points: Floats
    """(P, J, 3) m, in the fixed frame; NaN where the cameras do not tell."""
    deviations: Floats
    """(P, J) standard deviation along an axis, m."""
    scores: Floats
    """(P, J) mean score of the images that agree, 0 to 1."""


class Triangulator:
    """Turns the keypoints of several RGB cameras into skeletons.

    ``model`` has its J joints.
    """

    def __init__(self, model: SkeletonModel) -> None:
        self.model = model
        self.lenses: dict[str, Intrinsics] = {}
        self.instants = CommonInstants()
        mirror = symmetry_of(model).mirror.astype(np.int64)
        self.people = People3D(model, mirror)
        self.doubled = 0
        """Detections of somebody whom the same image shows twice."""
        self._shown = Counter[str]()  # detections of each camera
        self._lags: dict[str, int] = {}
        self._log_time = 0

    def add_camera(self, name: str, lens: Intrinsics, lag: float = 0.0) -> None:
        """Let a camera join, whose stamps are late by ``lag`` s."""
        self.lenses[name], self._lags[name] = lens, round(lag * SECOND)
        lags = self._lags.values()
        self.instants.add_camera(name, (max(lags) - min(lags)) / SECOND)
        self.people.add_camera()

    def add(self, frame: KeypointFrame, pose: Rigid) -> Iterator[LocatedPeople]:
        """Take an image; yield the people of the instants that are complete with it.

        ``pose`` is that of the camera's optical frame in the fixed frame.
        """
        self._log_time = max(self._log_time, frame.log_time)
        points = self.lenses[frame.camera].normalized(frame.pixels)
        scores = np.where(np.isfinite(points[..., 0]), frame.scores, 0.0)
        kept = _once(points, scores)
        self.doubled += len(points) - len(kept)
        self._shown[frame.camera] += len(kept)
        stamp = frame.stamp - self._lags[frame.camera]
        for instant, sights in self.instants.add(
            frame.camera, stamp, pose, points[kept], scores[kept]
        ):
            yield self._skeletons(instant, sights)

    def rest(self) -> Iterator[LocatedPeople]:
        """Yield the people of the last instants, for which no image comes any more."""
        for instant, sights in self.instants.rest():
            yield self._skeletons(instant, sights)

    def _skeletons(self, instant: int, sights: Mapping[str, ImagePeople]) -> LocatedPeople:
        """Locate the people of an instant."""
        joints = self.model.n_markers
        found = self.people.update(instant, Detections.of([*self.lenses], sights, joints))
        return LocatedPeople(
            instant,
            self._log_time,
            np.array([f.points for f in found]).reshape(-1, joints, 3),
            np.array([f.deviations for f in found]).reshape(-1, joints),
            np.array([f.scores for f in found]).reshape(-1, joints),
        )

    def warnings(self) -> Iterator[str]:
        """Name the cameras that show somebody, but nobody whom another one shows."""
        joined = dict(zip(self.lenses, self.people.joined.tolist(), strict=True))
        shown = {name: n for name, n in self._shown.items() if n > _FEW}
        if alone := [name for name, n in shown.items() if joined[name] < _STRANGE * n]:
            n = quantity(sum(shown[name] for name in alone), "detection")
            yield (
                f"{', '.join(alone)}: {n} of people in images not used: they are nobody whom "
                "another RGB camera shows; check the detector, and the camera's pose, lens and "
                "image size"
            )

    def remarks(self) -> Iterator[str]:
        """Say what of the images is not in the skeletons."""
        counts = self.people.counts
        total = max(counts["detections"], 1)
        for kind, words in _LEFT_OUT.items():
            if counts[kind]:
                some = quantity(counts[kind], "detection")
                yield f"{some} of people in images ({counts[kind] / total:.0%}) {words}"
        if self.doubled:
            yield f"{quantity(self.doubled, 'detection')} of somebody twice in one image left out"
        if counts["outvoted"]:
            yield (
                f"{quantity(counts['outvoted'], 'keypoint')} "
                f"({counts['outvoted'] / max(counts['keypoints'], 1):.1%}) left out, which other "
                "cameras contradict"
            )
        late = {name: n for name, n in self.instants.late.items() if n}
        for name, n in late.items():
            yield f"{name}: {quantity(n, 'image')} came too late or out of order, and left out"


_LEFT_OUT = {
    "alone": "left out, since one camera alone sees them, or joins with no other",
    "vague": "left out, since the cameras that see them look from one side, or badly",
}


def _once(points: Floats, scores: Floats) -> list[int]:
    """Return which people of an image to keep: the surer of two detections of one person."""
    known = np.asarray(np.isfinite(points[..., 0]).any(axis=1))
    if len(points) < 2:
        return np.flatnonzero(known).tolist()
    order = np.argsort(-scores.sum(axis=1), kind="stable").tolist()
    apart = mean_known(np.linalg.norm(points[:, None] - points, axis=-1))
    same = apart < 2 * _TWICE * sizes_of(points)[:, None]
    kept: list[int] = []
    for n in order:
        if known[n] and not same[n, kept].any():
            kept.append(n)
    return sorted(kept)
