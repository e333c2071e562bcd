"""The images of an RGB camera: pictures, keypoints, and the result as the camera sees it.

::

    /images/<camera>/picture                 the image or the video, if the log has it
    /images/<camera>/keypoints .../bones     what a detector found, in the camera's colour
    /images/<camera>/border                  of the image
    /images/<camera>/result .../bones        the result, through the lens, in people's colours

All is in px. Keypoints stand at the times of their images, the result at its own.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import rerun as rr

from hiros_mcap.body.rotations import Rigid
from hiros_mcap.errors import ConfigError
from hiros_mcap.io.rgb_cameras import RgbCamera
from hiros_mcap.io.ros_messages import FilmFrame
from hiros_mcap.rays.keypoints import KeypointFrame
from hiros_mcap.skeletons import Floats, SkeletonModel, Stamps
from hiros_viewer.columns import LOGGED, STAMP, TIMELINE, columns, strips, time_columns
from hiros_viewer.entities import Layer, Rows, packed, path_part, person_hue
from hiros_viewer.palette import SILENCE, curve_colour, label_colour
from hiros_viewer.poses import Crowd, Poses

_KEYPOINTS, _RESULT = (-2.5, -0.8, 40.0), (-2.0, -2.0, 30.0)
"""Radii of joints and bones, points on the screen, and what is on top: thin lines on thick ones."""
Part = tuple[str, dict[Any, Any], Stamps]
"""Path below the people's own, batches, and how many instances each person has."""


class CameraImages:
    """Draws what an RGB camera sees.

    Parameters
    ----------
    recording : where to draw. camera : with its keypoints. number : of its colour.
    pose : of its optical frame in the fixed frame; None = unknown, then no result is drawn.
    """

    def __init__(
        self, recording: rr.RecordingStream, camera: RgbCamera, number: int, pose: Rigid | None
    ) -> None:
        self.camera, self.pose = camera, pose
        self.path = f"/images/{path_part(camera.name)}"
        self._recording, self._number = recording, number
        self._crowds: dict[str, Crowd] = {}
        border = rr.Boxes2D(array=[0, 0, *camera.lens.size], array_format=rr.Box2DFormat.XYWH,
                            colors=[SILENCE], radii=-0.5)  # fmt: skip
        recording.log(f"{self.path}/border", border, static=True)

    def keypoints(self, images: Sequence[KeypointFrame], start: int) -> None:
        """Draw what the detector found in images, in the order of their stamps."""
        model, counts = self.camera.model, np.array([len(image.pixels) for image in images])
        if not len(counts):
            return
        times = np.array([(image.stamp, image.log_time) for image in images], np.int64)
        pixels = np.concatenate([image.pixels for image in images])
        colour = packed(label_colour(curve_colour(self._number)))
        colours = np.full(len(pixels), colour, np.uint32)
        people = Poses(times, counts, np.zeros(len(pixels), np.int64), pixels, pixels[..., 0])
        self._draw("keypoints", people, model, colours, start)

    def result(self, poses: Poses, model: SkeletonModel, layer: Layer, start: int) -> None:
        """Draw a result as the camera sees it."""
        if self.pose is None:
            return
        points = self.pose.inverse().moved(poses.positions)
        pixels = self.camera.lens.pixels(points)
        colours = np.array([packed(person_hue(i, layer)) for i in poses.ids.tolist()], np.uint32)
        people = Poses(poses.times, poses.counts, poses.ids, pixels, poses.confidences)
        self._draw(f"result{layer.prefix}", people, model, colours, start)

    def _draw(
        self,
        what: str,
        people: Poses,
        model: SkeletonModel,
        colours: npt.NDArray[np.uint32],
        start: int,
    ) -> None:
        """Draw people whose positions (P, M, 2) are px, each in a colour (P,)."""
        if what not in self._crowds:
            joint, bone, order = _KEYPOINTS if what == "keypoints" else _RESULT
            self._crowds[what] = Crowd()
            for part, style in (
                ("", rr.Points2D.from_fields(radii=joint, draw_order=order)),
                ("/bones", rr.LineStrips2D.from_fields(radii=bone, draw_order=order)),
            ):
                self._recording.log(f"{self.path}/{what}{part}", style, static=True)
        rows = self._crowds[what].rows(people)
        self._send(what, _parts(people.positions, model, colours), rows, start)

    def _send(self, what: str, parts: Iterable[Part], rows: Rows, start: int) -> None:
        times, counts = rows
        owner = np.repeat(np.arange(len(counts)), counts)
        for part, batches, per_person in parts:
            per_row = np.bincount(owner, per_person, len(counts)).astype(np.int32)
            path = f"{self.path}/{what}{part}"
            when = time_columns(times, start)
            self._recording.send_columns(path, when, columns(batches, per_row))

    def finish(self, start: int) -> None:
        """Hide everybody after the last image, and after the last frame of the result."""
        nobody = np.zeros((0, 0, 2)), SkeletonModel.of([], []), np.zeros(0, np.uint32)
        for what, crowd in self._crowds.items():
            if len(times := crowd.finish()):
                self._send(what, _parts(*nobody), (times, np.zeros(1, np.int64)), start)

    def film(self, path: Path, span: tuple[int, int], start: int) -> None:
        """Draw a video whose first frame is that of the first keypoints, between two times, ns.

        Raises ConfigError if it is no video that the viewer plays.
        """
        try:
            video = rr.AssetVideo(path=path)
            frames = video.read_frame_timestamps_nanos()
        except (RuntimeError, ValueError) as error:
            raise ConfigError(f"{path}: no video that the viewer plays: {error}") from None
        stamps = frames - frames[0] + min((f.stamp for f in self.camera.frames), default=start)
        shown = (stamps >= span[0]) & (stamps <= span[1])
        self._recording.log(f"{self.path}/picture", video, static=True)
        times = np.stack([stamps, stamps], axis=1)[shown]
        rows = rr.VideoFrameReference.columns_nanos(frames[shown])
        self._recording.send_columns(f"{self.path}/picture", time_columns(times, start), rows)

    def picture(self, picture: FilmFrame, start: int) -> None:
        """Draw an image, or a frame of a video."""
        self._recording.set_time(TIMELINE, duration=(picture.stamp - start) / 1e9)
        self._recording.set_time(STAMP, timestamp=np.datetime64(picture.stamp, "ns"))
        self._recording.set_time(LOGGED, timestamp=np.datetime64(picture.log_time, "ns"))
        self._recording.log(f"{self.path}/picture", _drawn(picture))
        self._recording.reset_time()


def _parts(pixels: Floats, model: SkeletonModel, colours: npt.NDArray[np.uint32]) -> Iterator[Part]:
    """Yield joints and bones of people (P, M, 2), px."""
    there = ~np.isnan(pixels[..., 0])
    yield (
        "",
        {
            rr.Points2D.descriptor_positions(): rr.components.Position2DBatch(
                pixels[there].astype(np.float32)
            ),
            rr.Points2D.descriptor_colors(): _colours(colours, there.sum(axis=1)),
        },
        there.sum(axis=1),
    )
    bones = model.links[(model.links >= 0).all(axis=1)]
    whole = there[:, bones].all(axis=2)
    yield (
        "/bones",
        {
            rr.LineStrips2D.descriptor_strips(): strips(pixels[:, bones][whole].astype(np.float32)),
            rr.LineStrips2D.descriptor_colors(): _colours(colours, whole.sum(axis=1)),
        },
        whole.sum(axis=1),
    )


def _colours(colours: npt.NDArray[np.uint32], counts: Stamps) -> Any:
    return rr.components.ColorBatch(np.repeat(colours, counts))


def _drawn(picture: FilmFrame) -> Any:
    """Return a picture as the viewer takes it."""
    if picture.pixels is not None:
        return rr.Image(picture.pixels, color_model="BGR").compress(jpeg_quality=80)
    if picture.is_video:
        return rr.VideoStream(codec=rr.VideoCodec[picture.format.upper()], sample=picture.data)
    kind = "png" if "png" in picture.format else "jpeg"
    return rr.EncodedImage(contents=picture.data, media_type=f"image/{kind}")
