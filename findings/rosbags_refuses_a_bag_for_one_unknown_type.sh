#!/bin/sh
# One topic that nobody needs makes rosbags refuse a whole SQLite bag.
#
# Guess: a reader of ROS bags fails where a message is decoded whose type it does not know, and reads
#   the other topics.
# Version: rosbags 0.11.9 (PyPI). Input: a bag as ros2 bag record writes it with -s sqlite3.
# Source: rosbag2_cpp/local_message_definition_source.cpp (ros2/rosbag2) stores a definition that it
#   cannot find with the encoding "unknown", and keeps recording the topic. rosbags'
#   rosbag2/storage_sqlite3.py looks the encoding up in a table of two, ros2msg and ros2idl, for every
#   topic, when it opens the file. highlevel/anyreader.py also parses every definition then.
# Behaviour: with the topic, KeyError 'unknown' from open(), although only /chatter is wanted. With a
#   type that has a bounded wstring, which ROS 2 knows, "Could not parse". Without such a topic,
#   /chatter is read.
# Seen: "plain: hello", "unknown: KeyError 'unknown'", "wstring: AnyReaderError Could not", exit
#   code 0.
#
# Fails (exit code 1) if rosbags behaves otherwise. Needs python3, and the network once.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check rosbags==0.11.9
cat > "$folder/try.py" <<'PYTHON'
import sqlite3
import sys
from pathlib import Path

from rosbags.highlevel import AnyReader

TABLES = """
CREATE TABLE schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT NOT NULL);
CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL,
  serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL,
  type_description_hash TEXT NOT NULL);
CREATE TABLE message_definitions(id INTEGER PRIMARY KEY, topic_type TEXT NOT NULL,
  encoding TEXT NOT NULL, encoded_message_definition TEXT NOT NULL,
  type_description_hash TEXT NOT NULL);
CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL,
  timestamp INTEGER NOT NULL, data BLOB NOT NULL);
INSERT INTO schema VALUES (4, 'jazzy');
"""
BAGS = {
    "plain": [],
    "unknown": [("/odd", "acme_msgs/msg/Odd", "unknown", "")],
    "wstring": [("/odd", "acme_msgs/msg/Odd", "ros2msg", "wstring<=5 name\n")],
}


def bag(path, others):
    database = sqlite3.connect(path)
    database.executescript(TABLES)
    string = ("/chatter", "std_msgs/msg/String", "ros2msg", "string data\n")
    for k, (topic, kind, encoding, text) in enumerate([string, *others], 1):
        database.execute("INSERT INTO topics VALUES (?, ?, ?, 'cdr', '', '')", (k, topic, kind))
        row = (k, kind, encoding, text)
        database.execute("INSERT INTO message_definitions VALUES (?, ?, ?, ?, '')", row)
        data = b"\0\1\0\0\6\0\0\0hello\0"
        database.execute("INSERT INTO messages VALUES (?, ?, ?, ?)", (k, k, k, data))
    database.commit()
    database.close()
    return path


def chatter(path):
    with AnyReader([path]) as reader:
        wanted = [c for c in reader.connections if c.topic == "/chatter"]
        ((connection, _, data),) = reader.messages(wanted)
        return reader.deserialize(data, connection.msgtype).data


found = {}
for name, others in BAGS.items():
    try:
        found[name] = chatter(bag(Path(sys.argv[1]) / f"{name}.db3", others))
    except Exception as error:
        found[name] = f"{type(error).__name__} {str(error)[:9]}".strip()
    print(f"{name}: {found[name]}")
refused = found["unknown"] == "KeyError 'unknown'" and found["wstring"].startswith("AnyReaderError")
sys.exit(0 if found["plain"] == "hello" and refused else 1)
PYTHON
"$folder/venv/bin/python" "$folder/try.py" "$folder"
