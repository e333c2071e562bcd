"""Recordings as ``ros2 bag record`` leaves them, written by the mcap library and by sqlite3.

What is written where follows the sources of ros2/rosbag2: rosbag2_storage_mcap/mcap_storage.cpp,
rosbag2_storage_sqlite3/sqlite_storage.cpp (tables of version 4),
rosbag2_compression/sequential_compression_writer.cpp (one zstd frame per message, or per file) and
rosbag2_cpp/writers/sequential_writer.cpp (names of the parts; those of Lyrical: pull request 2265).
"""

from __future__ import annotations

import sqlite3
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import zstandard
from mcap.writer import Writer
from ruamel.yaml import YAML

import hiros_schemas
from hiros_mcap.io.container import McapReader

SAMPLE = Path(__file__).parent.parent / "sample_data" / "one_person_walking.mcap"
TABLES = """
CREATE TABLE schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT NOT NULL);
CREATE TABLE metadata(id INTEGER PRIMARY KEY, metadata_version INTEGER, metadata TEXT);
CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL,
  serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL,
  type_description_hash TEXT NOT NULL);
CREATE TABLE message_definitions(id INTEGER PRIMARY KEY, topic_type TEXT NOT NULL,
  encoding TEXT NOT NULL, encoded_message_definition TEXT NOT NULL,
  type_description_hash TEXT NOT NULL);
CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL,
  timestamp INTEGER NOT NULL, data BLOB NOT NULL);
CREATE INDEX timestamp_idx ON messages (timestamp ASC);
INSERT INTO schema VALUES (4, 'lyrical');
"""


class Recorded(NamedTuple):
    """A message, and what the recorder knows of its type."""

    topic: str
    type: str
    time: int
    data: bytes
    definition: str
    encoding: str = "ros2msg"
    """"" in MCAP: the channel has no schema."""


def sample(n=150):
    """The first messages of the sample log, those of the truth left out."""
    with McapReader(SAMPLE) as reader:
        found = []
        for m in reader.messages():
            channel = reader.channels[m.channel_id]
            schema = reader.schema(channel)
            if schema and not channel.topic.startswith("/truth"):
                text = bytes(schema.data).decode()
                row = Recorded(channel.topic, schema.name, m.log_time, bytes(m.data), text)
                found.append(row)
    return found[:n]


IDL = {"float64": "double", "float32": "float", "[]": "sequence<{}>", "": "{}"}


def in_idl(name):
    """The definition of a type as rosidl translates it to IDL, files one after the other."""
    files = []
    for key, fields in hiros_schemas.parse(name, hiros_schemas.text(name)).items():
        package, kind = key.split("/")
        lines = [
            f"{IDL[f.array].format(IDL.get(f.type, f.type.replace('/', '::msg::')))} {f.name};"
            for f in fields
        ]
        body = f"struct {kind} {{ {' '.join(lines)} }};"
        title = f"{'=' * 80}\nIDL: {package}/msg/{kind}\n"
        files.append(f"{title}module {package} {{ module msg {{ {body} }}; }};\n")
    return "\n".join(files)


SINCE_LYRICAL = "{k}_{folder}_2026_11_27-10_0{k}_00"
"""Names of the parts since ROS 2 Lyrical."""


def record(
    folder, messages, *, storage="mcap", parts=1, mode="none", names="{folder}_{k}", metadata=True
):
    """Write a recording; ``mode`` is the recorder's --compression-mode. Return the folder."""
    folder.mkdir(parents=True)
    files, size = [], -(-len(messages) // parts)
    for k in range(parts):
        name = names.format(folder=folder.name, k=k)
        some = messages[k * size : (k + 1) * size]
        packed = some
        if mode == "message":
            packed = [m._replace(data=zstandard.compress(m.data)) for m in some]
        file = folder / (name + (".mcap" if storage == "mcap" else ".db3"))
        # The recorder declares all topics in every part.
        (_mcap if storage == "mcap" else _sqlite)(file, packed, messages)
        if mode == "file":
            file.with_name(file.name + ".zstd").write_bytes(zstandard.compress(file.read_bytes()))
            file.unlink()
            file = file.with_name(file.name + ".zstd")
        files.append(file)
    if metadata:
        write_metadata(folder, files, messages, storage, mode)
    return folder


def write_metadata(folder, files, messages, storage="mcap", mode="none"):
    """Write the recorder's metadata.yaml."""
    counts = Counter(m.topic for m in messages)
    types = {m.topic: m.type for m in messages}
    information = {
        "version": 9,
        "storage_identifier": storage,
        "duration": {"nanoseconds": messages[-1].time - messages[0].time},
        "starting_time": {"nanoseconds_since_epoch": messages[0].time},
        "message_count": len(messages),
        "topics_with_message_count": [
            {
                "topic_metadata": {
                    "name": topic,
                    "type": types[topic],
                    "serialization_format": "cdr",
                    "offered_qos_profiles": [],
                    "type_description_hash": "",
                },
                "message_count": n,
            }
            for topic, n in counts.items()
        ],
        "compression_format": "" if mode == "none" else "zstd",
        "compression_mode": "" if mode == "none" else mode.upper(),
        "relative_file_paths": [file.name for file in files],
        "files": [],
        "custom_data": None,
        "ros_distro": "lyrical",
    }
    with (folder / "metadata.yaml").open("w") as file:
        YAML(typ="safe").dump({"rosbag2_bagfile_information": information}, file)


def _mcap(path, messages, declared):
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=200_000)
        writer.start("ros2", "libmcap 1.4.0")
        channels: dict[str, int] = {}
        schemas: dict[str, int] = {}
        for m in declared:
            if m.type not in schemas:
                text = m.definition.encode()
                named = m.encoding and writer.register_schema(m.type, m.encoding, text)
                schemas[m.type] = named or 0
            if m.topic not in channels:
                channels[m.topic] = writer.register_channel(m.topic, "cdr", schemas[m.type])
        for m in messages:
            writer.add_message(channels[m.topic], m.time, m.data, m.time)
        writer.finish()


def _sqlite(path, messages, declared):
    database = sqlite3.connect(path)
    database.executescript(TABLES)
    topics = list(dict.fromkeys((m.topic, m.type) for m in declared))
    for k, (topic, kind) in enumerate(topics, 1):
        database.execute("INSERT INTO topics VALUES (?, ?, ?, 'cdr', '', '')", (k, topic, kind))
    types = dict.fromkeys(
        # The definition of a service's events is stored as that of the service.
        (m.type.removesuffix("_Event") if "/srv/" in m.type else m.type, m.encoding, m.definition)
        for m in declared
    )
    for k, row in enumerate(types, 1):
        database.execute("INSERT INTO message_definitions VALUES (?, ?, ?, ?, '')", (k, *row))
    numbers = {topic: k for k, (topic, _) in enumerate(topics, 1)}
    rows = [(numbers[m.topic], m.time, m.data) for m in messages]
    database.executemany("INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)", rows)
    database.commit()
    database.close()
