"""Logs for calibration: simulated people, no transforms, clocks that are wrong."""

from __future__ import annotations

import numpy as np

from hiros_mcap.io.channels import add_skeleton_channel, add_static_poses
from hiros_mcap.io.codec import Encoder
from hiros_mcap.io.container import McapWriter
from hiros_mcap.simulate import SimulateParams, simulate


def simulated(**params):
    usual = {"people": 1, "seconds": 12.0, "rig": {"rate": 20.0}}
    return simulate(SimulateParams.model_validate({**usual, **params}))


def late(frame, seconds):
    """The frame of a camera whose clock, and whose recorder's clock, is fast."""
    ns = round(1e9 * seconds)
    times = {"stamp": frame.stamp + ns, "log_time": frame.log_time + ns}
    return frame.replace(**times, stamps=frame.stamps + ns)


def mirrored(frame, mirror):
    """The frame of a detector that takes left for right."""
    confidences = np.ascontiguousarray(frame.marker_confidences[:, mirror])
    markers = np.ascontiguousarray(frame.markers[:, mirror])
    return frame.replace(markers=markers, marker_confidences=confidences)


def write(path, frames, model, transforms=None, parent="lab"):
    """Write a log, by default without transforms."""
    encoder = Encoder(model)
    with McapWriter(path) as writer:
        if transforms:
            add_static_poses(writer, transforms, parent, frames[0].log_time)
        channels = {
            name: add_skeleton_channel(writer, f"/{name}/people")
            for name in sorted({frame.source for frame in frames})
        }
        for frame in sorted(frames, key=lambda frame: frame.log_time):
            writer.write(channels[frame.source], frame.log_time, encoder.encode(frame))
        writer.commit()
    return path
