#!/bin/sh
# rosbag2's message compression in an MCAP: readers of MCAP hand out zstd frames as if they were CDR.
#
# Guess: an MCAP says how its messages are encoded, and a reader hands them out in that encoding;
#   compression is a matter of chunks.
# Version: mcap 1.6.0, mcap-ros2-support 0.6.0, rosbags 0.11.9, zstandard 0.25.0 (PyPI). Input: an MCAP
#   as ros2 bag record -s mcap --compression-mode message --compression-format zstd writes it.
# Source: rosbag2_compression/sequential_compression_writer.cpp (ros2/rosbag2) replaces the bytes of
#   each message by a zstd frame before the storage writes them. rosbag2_storage_mcap/mcap_storage.cpp
#   still declares the channel as "cdr"; only metadata.yaml beside the file has compression_mode.
# Behaviour: mcap and rosbags hand out 28 b5 2f fd..., with message_encoding "cdr" and no error. The
#   decoder of mcap-ros2-support does not look at the encapsulation and gives a wrong value silently.
# Seen: "mcap: cdr 28 b5 2f fd", "rosbags: 28 b5 2f fd", "mcap-ros2-support:
#   '\x00\x00\x01\x00\x00\x06\x00\x00\x00hello\x00'" where 'hello' was recorded, exit code 0.
#
# Fails (exit code 1) if these libraries behave otherwise. Needs python3, and the network once.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check \
    mcap==1.6.0 mcap-ros2-support==0.6.0 rosbags==0.11.9 zstandard==0.25.0
cat > "$folder/try.py" <<'PYTHON'
import sys
from pathlib import Path

import zstandard
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

path = Path(sys.argv[1]) / "lab_0.mcap"
CDR = b"\0\1\0\0\6\0\0\0hello\0"
with path.open("wb") as file:
    writer = Writer(file)
    writer.start("ros2", "libmcap 1.4.0")
    schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data\n")
    channel = writer.register_channel("/chatter", "cdr", schema)
    writer.add_message(channel, 1, zstandard.compress(CDR), 1)
    writer.finish()

with path.open("rb") as file:
    ((_, channel, message),) = make_reader(file).iter_messages()
print("mcap:", channel.message_encoding, message.data[:4].hex(" "))
with AnyReader([path]) as reader:
    ((_, _, data),) = reader.messages()
print("rosbags:", bytes(data[:4]).hex(" "))
try:
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        decoded = [m.data for *_, m in reader.iter_decoded_messages()]
except Exception as error:
    decoded = [type(error).__name__]
print("mcap-ros2-support:", *map(ascii, decoded))
frame = bytes.fromhex("28b52ffd")
as_cdr = channel.message_encoding == "cdr" and message.data[:4] == bytes(data[:4]) == frame
sys.exit(0 if as_cdr and decoded != ["hello"] else 1)
PYTHON
"$folder/venv/bin/python" "$folder/try.py" "$folder"
