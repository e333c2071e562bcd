"""Golden logs: what a check compares with. Small, because they are kept under version control."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hiros_mcap.evaluate.logs import output_channels, read_channel
from hiros_mcap.io.channels import (
    CONFIG_ATTACHMENT,
    LIMBS_ATTACHMENT,
    PROVENANCE,
    add_skeleton_channel,
)
from hiros_mcap.io.codec import Encoder
from hiros_mcap.io.container import McapWriter
from hiros_mcap.io.log import open_reader
from hiros_mcap.skeletons import Floats, Frame

_GRID = np.repeat([2.0**-23, 2.0**-16, 2.0**-10, 2.0**-23], [7, 6, 6, 3])
"""Of the columns of a Box: poses, velocities, accelerations, sizes. The numbers of a golden log are
multiples of these, so that they compress: at most a sixth of the default tolerances, such as 0.12
micrometres."""


def write_golden(
    output: str | os.PathLike[str], golden: str | os.PathLike[str], topics: Sequence[str] = ()
) -> None:
    """Write a compact copy of channels of an output.

    Kept are all numbers of the skeletons, rounded, the limb lengths, and how the output came
    about: version, configuration, hash of the input.

    Parameters
    ----------
    output : what ``hiros process`` wrote. golden : the file to write.
    topics : globs of output channels; empty = the last stage's.
    """
    chosen = output_channels(output, topics) if topics else output_channels(output)[-1:]
    channels = {topic: read_channel(output, topic) for topic in chosen}
    with McapWriter(Path(golden), inputs=[output]) as writer:
        for topic, (frames, model, _) in channels.items():
            encoder = Encoder(model)
            channel = add_skeleton_channel(writer, topic)
            for frame in frames:
                writer.write(channel, frame.log_time, encoder.encode(compact(frame)))
        with open_reader(output) as reader:
            for name in (LIMBS_ATTACHMENT, CONFIG_ATTACHMENT):
                if (content := reader.attachment(name)) is not None:
                    writer.add_attachment(name, content, "application/toml")
            for name, values in reader.contents.metadata:
                if name == PROVENANCE:
                    writer.add_metadata(name, values)
        writer.commit()


def compact(frame: Frame) -> Frame:
    """Return a frame with rounded numbers."""
    names = "confidences", "marker_confidences", "link_confidences"
    rounded = {name: _rounded(getattr(frame, name), _GRID[0]) for name in names}
    for name in ("markers", "links", "boxes"):
        states = getattr(frame, name)
        rounded[name] = _rounded(states, _GRID[: states.shape[-1]])
    return frame.replace(**rounded)


def _rounded(numbers: Floats, grid: Floats) -> Floats:
    return np.asarray(np.rint(numbers / grid) * grid)
