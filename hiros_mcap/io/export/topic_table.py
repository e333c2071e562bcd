"""The raw fields of any ROS 2 topic as a table, decoded by mcap-ros2-support.

A column is a field with its path as ROS 2 writes it: ``header.stamp.sec``, ``poses[2].position.x``.
An array has a column per element; bytes, as of an image, have one that says how many there are.
"""

from __future__ import annotations

import os
from array import array
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from hiros_mcap.errors import ConfigError, LogError
from hiros_mcap.io.channels import channels_of
from hiros_mcap.io.container import Channel, McapReader
from hiros_mcap.io.export.choices import warn_in_python
from hiros_mcap.io.log import open_reader
from hiros_mcap.outputs import EXPORT_MARK, LOG_TIME, replacing

_MOST_COLUMNS = 16384
"""As many as a sheet of a spreadsheet has."""

FieldPath = tuple[tuple[int, str], ...]
"""Place and name of a field in a message, of one in that field, and so on: they can be sorted."""


def export_topic(
    log: str | os.PathLike[str],
    topic: str,
    target: str | os.PathLike[str],
    warn: Callable[[str], object] = warn_in_python,
) -> int:
    """Write the messages of a topic as CSV or Parquet, by the suffix; return how many.

    Parameters
    ----------
    log : a log of any kind that hiros reads. topic : its exact name. target : the file.
    warn : is called with how many messages cannot be decoded; their rows have the log time alone.

    Raises
    ------
    ConfigError
        The suffix is another one, or the messages have too many fields for a table.
    LogError
        The log has no such topic, the topic is not of ROS 2, or no message can be decoded.
    """
    import pandas as pd

    target = Path(target)
    if target.suffix.lower() not in (".csv", ".parquet"):
        raise ConfigError(f"{target}: a topic is written as .csv or .parquet")
    with open_reader(log, topic=topic) as reader:
        rows, times, failed = _rows(reader, topic)
        path = reader.path
    if len(failed) == len(rows):
        raise LogError(f"no message can be decoded: {failed[0]}", path=path, topic=topic)
    if failed:
        warn(
            f"{path}: {topic}: {len(failed)} of {len(rows)} messages cannot be decoded: {failed[0]}"
        )
    columns = sorted({field for row in rows for field in row})
    table = {LOG_TIME: pd.Series(times, dtype="int64")} | {
        "".join(name for _, name in field).removeprefix("."): pd.Series(
            [row.get(field) for row in rows], dtype=object
        )
        for field in columns
    }
    frame = pd.DataFrame(table)

    with replacing(target) as temporary:
        if target.suffix.lower() == ".csv":
            frame.to_csv(temporary, index=False, lineterminator="\n")
        else:
            frame.attrs["hiros"] = EXPORT_MARK
            frame.to_parquet(temporary, index=False)
    return len(frame)


def _rows(
    reader: McapReader, topic: str
) -> tuple[list[dict[FieldPath, Any]], list[int], list[str]]:
    """Return the fields and the log time, ns, of each message, and why some have no fields."""
    channels = {c.id: c for c in reader.channels.values() if c.topic == topic}
    others = reader.left_out.items()
    counted = [f"{c.topic} ({c.schema})" for c in channels_of(reader) if c.count]
    counted += [f"{name} ({kind})" for name, (kind, n) in others if n]
    if not any(reader.counts.get(ident) for ident in channels):
        fault = f"has no messages of this topic; it has {', '.join(counted) or 'none'}"
        raise LogError(fault, path=reader.path, topic=topic)
    decoders = {ident: _decoder(reader, channel) for ident, channel in channels.items()}
    rows: list[dict[FieldPath, Any]] = []
    times: list[int] = []
    failed: list[str] = []
    for message in reader.messages(channels):
        row: dict[FieldPath, Any] = {}
        try:
            row = dict(_fields(decoders[message.channel_id](bytes(message.data)), ()))
        except Exception as error:  # noqa: BLE001 - damaged bytes raise anything
            failed.append(f"{type(error).__name__}: {error}")
        if len(row) >= _MOST_COLUMNS:
            raise ConfigError(
                f"{reader.path}: {topic}: a message has {len(row)} numbers, too many for the "
                f"columns of a table ({_MOST_COLUMNS})"
            )
        rows.append(row)
        times.append(message.log_time)
    return rows, times, failed


def _decoder(reader: McapReader, channel: Channel) -> Callable[[bytes], Any]:
    """Return what decodes the messages of a channel; raises LogError if it is not of ROS 2."""
    from mcap_ros2.decoder import DecoderFactory

    schema = reader.schema(channel)
    try:
        decode = DecoderFactory().decoder_for(channel.message_encoding, schema)
    except Exception as error:  # noqa: BLE001 - its parser raises many kinds
        fault = f"the message definition cannot be read: {error}"
        raise LogError(fault, path=reader.path, topic=channel.topic) from None
    if decode is None:
        kind = schema.encoding if schema else "no definition"
        raise LogError(
            f"is {channel.message_encoding or 'of no encoding'} with {kind or 'no definition'}; a "
            "table is made of ROS 2 messages, cdr with ros2msg",
            path=reader.path,
            topic=channel.topic,
        )
    return decode


def _fields(value: Any, path: FieldPath) -> Iterator[tuple[FieldPath, Any]]:
    """Yield the path and the value of every number and text in a message."""
    if isinstance(value, SimpleNamespace):
        for k, name in enumerate(value.__slots__):
            yield from _fields(getattr(value, name), (*path, (k, f".{name}")))
    elif isinstance(value, bytes | bytearray | memoryview) or (
        isinstance(value, array) and value.itemsize == 1
    ):
        yield (*path, (0, " (bytes)")), len(value)
    elif isinstance(value, list | tuple | array):
        for k, inner in enumerate(value):
            yield from _fields(inner, (*path, (k, f"[{k}]")))
    else:
        yield path, value
