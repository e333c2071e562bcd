"""A simulation as a log: the cameras' channels, their poses on /tf_static, and the truth."""

from __future__ import annotations

import heapq
import os
from collections.abc import Iterator
from typing import TYPE_CHECKING

from hiros_mcap.io.channels import add_skeleton_channel, add_static_poses
from hiros_mcap.io.codec import Encoder
from hiros_mcap.io.container import McapWriter
from hiros_mcap.simulate.settings import SimulateParams
from hiros_mcap.simulate.simulation import WORLD, simulate
from hiros_mcap.skeletons import Frame

if TYPE_CHECKING:
    from hiros_mcap.running.process_options import Progress

TRUTH_TOPIC = "/truth/skeletons"


def write_log(
    path: str | os.PathLike[str], params: SimulateParams, progress: Progress | None = None
) -> dict[str, int]:
    """Write a simulated log and return its messages by topic.

    Detections are on /<camera>/skeletons in the camera's coordinates, the cameras' published
    poses on /tf_static, and the true skeletons on /truth/skeletons in the frame "world". The
    same parameters give the same bytes. ``progress`` is told the time that is simulated, ns.

    Raises LogError if ``path`` cannot be written; there is no file then.
    """
    simulation = simulate(params)
    encoder = Encoder(simulation.model)
    with McapWriter(path) as writer:
        add_static_poses(writer, simulation.transforms, WORLD, params.start)
        channels: dict[str, int] = {}
        for topic, frame in _by_log_time(simulation.detections, simulation.truth):
            if topic not in channels:
                channels[topic] = add_skeleton_channel(writer, topic)
            writer.write(channels[topic], frame.log_time, encoder.encode(frame))
            if progress is not None:
                progress.update(frame.stamp - params.start, round(params.seconds * 1e9))
        writer.commit()
        return {writer.channels[ident].topic: n for ident, n in sorted(writer.counts.items())}


def _by_log_time(
    detections: Iterator[Frame], truth: Iterator[Frame]
) -> Iterator[tuple[str, Frame]]:
    named = ((f"/{frame.source}/skeletons", frame) for frame in detections)
    true = ((TRUTH_TOPIC, frame) for frame in truth)
    return heapq.merge(named, true, key=lambda pair: pair[1].log_time)
