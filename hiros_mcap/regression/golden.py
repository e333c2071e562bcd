"""Golden logs: what a check compares with. Small, because they are kept under version control."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hiros_mcap.evaluate.logs import output_channels, read_channel
from hiros_mcap.io.channels import LIMBS_ATTACHMENT, add_skeleton_channel
from hiros_mcap.io.codec import Encoder
from hiros_mcap.io.container import McapReader, McapWriter
from hiros_mcap.skeletons import ORIENTATION, POSITION, Floats, Frame

GRID = 2.0**-23
"""Numbers of a golden log are multiples of this: 0.12 micrometres, a fifth of the bytes' noise."""


def write_golden(
    output: str | os.PathLike[str], golden: str | os.PathLike[str], topics: Sequence[str] = ()
) -> None:
    """Write a compact copy of channels of an output.

    Kept are times, ids, joint positions, link orientations and confidences (rounded to
    :data:`GRID`) and the limb lengths; velocities, accelerations and boxes are left out.

    Parameters
    ----------
    output : what ``hiros process`` wrote. golden : the file to write.
    topics : globs of output channels; empty = the last stage's.
    """
    chosen = output_channels(output, topics) if topics else output_channels(output)[-1:]
    channels = [(topic, *read_channel(output, topic)[:2]) for topic in chosen]
    with McapWriter(Path(golden), inputs=[output]) as writer:
        for topic, frames, model in channels:
            encoder = Encoder(model)
            channel = add_skeleton_channel(writer, topic)
            for frame in frames:
                writer.write(channel, frame.log_time, encoder.encode(compact(frame)))
        with McapReader(output) as reader:
            if (limbs := reader.attachment(LIMBS_ATTACHMENT)) is not None:
                writer.add_attachment(LIMBS_ATTACHMENT, limbs, "application/toml")
        writer.commit()


def compact(frame: Frame) -> Frame:
    """Return a frame with nothing but what a check compares."""
    markers, links = np.full_like(frame.markers, np.nan), np.full_like(frame.links, np.nan)
    markers[..., POSITION] = _rounded(frame.positions)
    links[..., ORIENTATION] = _rounded(frame.orientations)
    return frame.replace(
        markers=markers,
        links=links,
        # Without orientations, its confidence is all that is known of a link.
        confidences=_rounded(frame.confidences),
        marker_confidences=_rounded(frame.marker_confidences),
        link_confidences=_rounded(frame.link_confidences),
        boxes=np.full_like(frame.boxes, np.nan),
    )


def _rounded(numbers: Floats) -> Floats:
    return np.asarray(np.rint(numbers / GRID) * GRID)
