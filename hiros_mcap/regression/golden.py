"""Golden files, logs or metrics: what a check compares with.

They are small, because they are kept under version control.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from hiros_mcap.errors import ConfigError
from hiros_mcap.evaluate.logs import output_channels, read_channel
from hiros_mcap.evaluate.measures import MEASURES
from hiros_mcap.io.channels import (
    CONFIG_ATTACHMENT,
    LIMBS_ATTACHMENT,
    PROVENANCE,
    add_skeleton_channel,
)
from hiros_mcap.io.codec import Encoder
from hiros_mcap.io.container import McapWriter
from hiros_mcap.io.log import open_reader
from hiros_mcap.outputs import write_text
from hiros_mcap.outside import parse, read_text
from hiros_mcap.regression.provenance import Provenance
from hiros_mcap.skeletons import Floats, Frame

VERSION = 1
"""Of a file of metrics."""
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


def save_metrics(
    path: Path, channel: str, metrics: Mapping[str, float], provenance: Provenance
) -> None:
    """Write golden metrics: JSON, one number a line, so that a change shows in a diff."""
    rounded = {name: float(f"{value:.6g}") for name, value in metrics.items()}
    data = {
        "hiros_golden_metrics": VERSION,
        "channel": channel,
        "metrics": rounded,
        "provenance": provenance.to_json(),
    }
    write_text(path, json.dumps(data, indent=1) + "\n")


def load_metrics(path: Path) -> tuple[dict[str, float], Provenance]:
    """Read golden metrics, and how they were made.

    Raises ConfigError if the file is not what :func:`save_metrics` writes, or names a metric that
    does not exist.
    """
    data = parse(read_text(path), "JSON", path)
    values = data.get("metrics") if isinstance(data, dict) else None
    if not isinstance(values, dict) or data.get("hiros_golden_metrics") != VERSION:
        raise ConfigError(f"{path}: is not a file of golden metrics, version {VERSION}")
    for name, value in values.items():
        if name not in MEASURES:
            raise ConfigError(f"{path}: no metric {name!r} (there are: {', '.join(MEASURES)})")
        if not isinstance(value, int | float) or not math.isfinite(value):
            raise ConfigError(f"{path}: {name} is not a number")
    numbers = {name: float(value) for name, value in values.items()}
    return numbers, Provenance.from_json(data.get("provenance"), path)
