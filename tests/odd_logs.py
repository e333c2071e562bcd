"""Recordings with something wrong in them: the sample log, message by message."""

from __future__ import annotations

from collections.abc import Callable

from mcap_logs import tf_bytes

import hiros_schemas
from hiros_mcap.body.transforms import parse_tf
from hiros_mcap.io.channels import add_ros_channel
from hiros_mcap.io.codec import Decoder, Encoder
from hiros_mcap.io.container import McapWriter
from hiros_mcap.io.log import open_log
from hiros_mcap.skeletons import Frame

Change = Callable[[Frame, int], Frame]
"""(what a camera says, how many messages it has sent before) -> what it says instead."""


def changed(source, target, change, *, keep=True):
    """Copy a log with other detections; without ``keep``, of the cameras there is no message."""
    with open_log(source) as log, McapWriter(target) as writer:
        writer.copy_definitions(log.reader, log.reader.channels)
        decoder, encoder = Decoder(log.model, exact=True), Encoder(log.model)
        for message in log.reader.messages():
            topic, time = log.reader.channels[message.channel_id].topic, message.log_time
            data = bytes(message.data)
            if topic.startswith("/camera_") and not keep:
                continue
            if topic.startswith("/camera_"):
                sent = writer.counts[message.channel_id]
                (frame,) = decoder.decode_message(data, time)
                data = encoder.encode(change(frame, sent))
            writer.write(message.channel_id, time, data)
        writer.commit()
    return target


def shifted(source, target, seconds):
    """Copy a log whose stamps and log times are later by ``seconds`` (topic)."""
    with open_log(source, topics=["/camera_*/*", "/truth/*"]) as log, McapWriter(target) as writer:
        writer.copy_definitions(log.reader, log.reader.channels)
        decoder, encoder, rows = Decoder(log.model, exact=True), Encoder(log.model), []
        for m in log.reader.messages():
            topic, data = log.reader.channels[m.channel_id].topic, bytes(m.data)
            ns = round(1e9 * seconds(topic))
            if ns and topic.startswith(("/camera", "/truth")):
                (frame,) = decoder.decode_message(data, m.log_time)
                data = encoder.encode(later(frame, ns))
            rows.append((m.log_time + ns, m.channel_id, data))
        for time, channel, data in sorted(rows):
            writer.write(channel, time, data)
        writer.commit()
    return target


def later(frame, ns):
    """The same at another time of the camera's clock."""
    return frame.replace(stamp=frame.stamp + ns, stamps=frame.stamps + ns)


def scaled(frame, factor):
    """The same in another unit."""
    markers = frame.markers.copy()
    markers[:, :, :3] *= factor
    return frame.replace(markers=markers)


def believed(frame, confidence):
    """The same with another confidence of every marker."""
    confidences = frame.marker_confidences.copy()
    confidences[:] = confidence
    return frame.replace(marker_confidences=confidences)


def poses_of(path):
    """Parent, child, translation and rotation of every static transform."""
    with open_log(path) as log:
        (ident,) = (info.id for info in log.channels if info.topic == "/tf_static")
        every = [t for m in log.reader.messages([ident]) for t in parse_tf(m.data)]
    return [(t.parent, t.child, t.translation, t.xyzw) for t in every]


def published(source, target, topics, frame=None):
    """Copy a log with other transforms, by topic, and other frames of the cameras, by topic."""
    if frame is not None:
        source = changed(
            source, target.with_suffix(".frames"), lambda f, _: f.replace(frame_id=frame(f.source))
        )
    with open_log(source) as log, McapWriter(target) as writer:
        others = {i: c for i, c in log.reader.channels.items() if c.topic != "/tf_static"}
        writer.copy_definitions(log.reader, others)
        for topic, rows in topics.items():
            channel = add_ros_channel(writer, topic, hiros_schemas.TF_MESSAGE)
            data = tf_bytes(*((0, *row) for row in rows))
            writer.write(channel, log.span[0], data)
        for message in log.reader.messages(others):
            writer.write(message.channel_id, message.log_time, bytes(message.data))
        writer.commit()
    return target
