"""A simulation as a log: the cameras' channels, their poses on /tf_static, and the truth."""

from __future__ import annotations

import heapq
import os
from collections.abc import Iterator, Mapping

import hiros_schemas
from hiros_mcap.body.rotations import Rigid
from hiros_mcap.io.cdr_writer import CdrWriter
from hiros_mcap.io.channels import LATCHED_QOS, add_skeleton_channel
from hiros_mcap.io.codec import Encoder
from hiros_mcap.io.container import McapWriter
from hiros_mcap.simulate.settings import SimulateParams
from hiros_mcap.simulate.simulation import WORLD, simulate
from hiros_mcap.skeletons import Frame

TRUTH_TOPIC = "/truth/skeletons"


def write_log(path: str | os.PathLike[str], params: SimulateParams) -> dict[str, int]:
    """Write a simulated log and return its messages by topic.

    Detections are on /<camera>/skeletons in the camera's coordinates, the cameras' published
    poses on /tf_static, and the true skeletons on /truth/skeletons in the frame "world". The
    same parameters give the same bytes.

    Raises LogError if ``path`` cannot be written; there is no file then.
    """
    simulation = simulate(params)
    encoder = Encoder(simulation.model)
    with McapWriter(path) as writer:
        tf = writer.add_channel(
            "/tf_static",
            writer.add_schema(
                hiros_schemas.TF_MESSAGE, hiros_schemas.text(hiros_schemas.TF_MESSAGE).encode()
            ),
            metadata={"offered_qos_profiles": LATCHED_QOS},
        )
        writer.write(tf, params.start, encode_tf(simulation.transforms, WORLD, params.start))
        channels: dict[str, int] = {}
        for topic, frame in _by_log_time(simulation.detections, simulation.truth):
            if topic not in channels:
                channels[topic] = add_skeleton_channel(writer, topic)
            writer.write(channels[topic], frame.log_time, encoder.encode(frame))
        writer.commit()
        return {writer.channels[ident].topic: n for ident, n in sorted(writer.counts.items())}


def _by_log_time(
    detections: Iterator[Frame], truth: Iterator[Frame]
) -> Iterator[tuple[str, Frame]]:
    named = ((f"/{frame.source}/skeletons", frame) for frame in detections)
    true = ((TRUTH_TOPIC, frame) for frame in truth)
    return heapq.merge(named, true, key=lambda pair: pair[1].log_time)


def encode_tf(poses: Mapping[str, Rigid], parent: str, stamp: int) -> bytes:
    """Return a tf2_msgs/msg/TFMessage in little-endian CDR: each child's pose in ``parent``."""
    out = CdrWriter()
    out.uint32(len(poses))
    for child, pose in poses.items():
        out.header(stamp, parent)
        out.string(child)
        out.array(pose.translation)
        out.array(pose.xyzw)
    return out.finish()
