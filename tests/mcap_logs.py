"""Small MCAP files for tests: by the mcap library, and record by record."""

from __future__ import annotations

import struct
import zlib

import lz4.frame
import zstandard
from mcap.reader import NonSeekingReader
from mcap.writer import CompressionType, IndexType, Writer
from mcap_ros2._dynamic import serialize_dynamic

import hiros_schemas
from hiros_mcap.io.container import records as r

NO_SUMMARY = {
    "index_types": IndexType.NONE,
    "repeat_channels": False,
    "repeat_schemas": False,
    "use_statistics": False,
    "use_summary_offsets": False,
}
KINDS = {
    "zstd": {"compression": CompressionType.ZSTD},
    "lz4": {"compression": CompressionType.LZ4},
    "none": {"compression": CompressionType.NONE},
    "unchunked": {"use_chunking": False},
    "no-summary": NO_SUMMARY,
}
"""Options of mcap.Writer for every kind of container."""


def make_messages(n=40):
    """Channel 1 or 2, log time, payload."""
    return [(1 + k % 2, 1000 + 10 * k, bytes([k]) * (20 + 7 * (k % 5))) for k in range(n)]


def write_log(path, messages=None, *, attachment=True, chunk_size=500, **options):
    """Write a log of two channels by the mcap library."""
    options = {"enable_data_crcs": True, "chunk_size": chunk_size, **options}
    with path.open("wb") as file:
        writer = Writer(file, **options)
        writer.start("ros2", "test")
        schema = writer.register_schema("pkg/msg/Type", "ros2msg", b"int32 x")
        for topic in ("/a", "/b"):
            writer.register_channel(topic, "cdr", schema, {"qos": topic})
        for k, (channel, time, data) in enumerate(messages or make_messages()):
            writer.add_message(channel, time, data, publish_time=time + 1, sequence=k)
        if attachment:
            writer.add_attachment(3, 4, "note.txt", "text/plain", b"some note")
            writer.add_metadata("about", {"key": "value"})
        writer.finish()
    return path


def by_library(path):
    """Messages of a file as the mcap library's streaming reader has them, by time."""
    with path.open("rb") as file:
        reader = NonSeekingReader(file, validate_crcs=True)
        return [
            (m.channel_id, m.log_time, bytes(m.data), m.publish_time, m.sequence)
            for _, _, m in reader.iter_messages(log_time_order=True)
        ]


def channel(ident=1, topic="/a", extra=b""):
    body = struct.pack("<HH", ident, 0) + r.text(topic) + r.text("cdr") + r.texts({})
    return r.record(r.Opcode.CHANNEL, body, extra)


def message(ident=1, time=5, data=b"payload"):
    return r.record(r.Opcode.MESSAGE, r.MESSAGE_HEAD.pack(ident, 0, time, time), data)


PACK = {"": bytes, "zstd": zstandard.compress, "lz4": lz4.frame.compress}


def chunk(*inner, compression="", packed=None, size=None, times=(0, 100), crc=None, extra=b""):
    """A chunk record that says what it is told to say."""
    plain = b"".join(inner)
    packed = PACK[compression](plain) if packed is None else packed
    size = len(plain) if size is None else size
    crc = zlib.crc32(plain) if crc is None else crc
    head = r.CHUNK_HEAD.pack(*times, size, crc)
    body = head + r.text(compression) + struct.pack("<Q", len(packed)) + packed
    return r.record(r.Opcode.CHUNK, body, extra)


def index(ident, entries, extra=b""):
    body = (
        struct.pack("<H", ident)
        + struct.pack("<I", 16 * len(entries))
        + b"".join(struct.pack("<QQ", *e) for e in entries)
    )
    return r.record(r.Opcode.MESSAGE_INDEX, body, extra)


def mcap_file(path, *data, header_extra=b"", tail=b""):
    """A file with the given data section and no summary."""
    start = r.MAGIC + r.record(r.Opcode.HEADER, r.text(""), r.text("test"), header_extra)
    start += b"".join(data)
    end = r.record(r.Opcode.DATA_END, struct.pack("<I", zlib.crc32(start)))
    path.write_bytes(start + end + r.record(r.Opcode.FOOTER, bytes(20)) + r.MAGIC + tail)
    return path


def tf_bytes(*rows):
    """TFMessage by the mcap library; rows are (stamp ns, parent, child, translation, xyzw)."""
    name = hiros_schemas.TF_MESSAGE
    serialize = serialize_dynamic(name, hiros_schemas.text(name))[name]
    transforms = [
        {
            "header": {
                "stamp": {"sec": stamp // 10**9, "nanosec": stamp % 10**9},
                "frame_id": parent,
            },
            "child_frame_id": child,
            "transform": {
                "translation": dict(zip("xyz", translation, strict=True)),
                "rotation": dict(zip("xyzw", xyzw, strict=True)),
            },
        }
        for stamp, parent, child, translation, xyzw in rows
    ]
    return bytes(serialize({"transforms": transforms}))
