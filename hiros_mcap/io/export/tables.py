"""Results as tables: CSV, Parquet, JSON lines and numpy arrays; and any ROS 2 topic as one.

A column of a topic's table is a field with its path as ROS 2 writes it: ``header.stamp.sec``,
``poses[2].position.x``. An array has a column per element; bytes, as of an image, have one that
says how many there are.
"""

from __future__ import annotations

import json
import math
import os
from array import array
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np

from hiros_mcap.errors import ConfigError, LogError
from hiros_mcap.events import hidden_times
from hiros_mcap.io.channels import channels_of
from hiros_mcap.io.container import Channel, McapReader
from hiros_mcap.io.export.choices import Choices, warn_in_python
from hiros_mcap.io.log import open_reader
from hiros_mcap.outputs import EXPORT_MARK, LOG_TIME, replacing
from hiros_mcap.skeletons import Floats, Stamps

if TYPE_CHECKING:
    import pandas as pd

    from hiros_mcap.io.result import Motion, Result


def table(result: Result, parts: tuple[str, ...]) -> pd.DataFrame:
    """Return joints and angles side by side, with flat column names that carry their units.

    Behind the joints follow their confidences, 0 to 1, and if the result states them, their
    standard deviations along an axis. The last column is :func:`hidden_from`.
    """
    import pandas as pd

    columns = []
    if "joints" in parts:
        names = result.model.marker_names
        joints = result.joints(0)
        index = joints.index
        joints.columns = pd.Index([f"{name} {axis} (m)" for name in names for axis in "xyz"])
        columns.append(joints)
        for values, text in _certainties(result):
            columns.append(pd.DataFrame(values, index, [f"{name} {text}" for name in names]))
    if "angles" in parts:
        angles = result.angles(0)
        columns.append(angles.rename(columns=lambda name: f"{name} (deg)"))
    hidden = np.concatenate([hidden_from(result, person) for person in result.motions])
    columns.append(pd.DataFrame({"hidden from (cameras)": hidden}, columns[0].index))
    return pd.concat(columns, axis=1).rename_axis(index=["person", "time (s)"])


def _certainties(result: Result) -> list[tuple[Floats, str]]:
    """(T, M) of everybody, and what it is."""
    motions = result.motions.values()
    certainties = [(np.concatenate([m.confidences for m in motions]), "confidence")]
    if any(m.deviations is not None for m in motions):
        certainties.append((np.concatenate([deviations_of(m) for m in motions]), "SD (m)"))
    return certainties


def deviations_of(motion: Motion) -> Floats:
    """(T, M) standard deviations of a motion, m; NaN if it states none."""
    absent = np.full_like(motion.confidences, np.nan)
    return absent if motion.deviations is None else motion.deviations


def hidden_from(result: Result, person: int) -> Stamps:
    """(T,) Number of cameras from which somebody else hides a person: its joints are guesses."""
    times = result.motions[person].times
    count = np.zeros(len(times), np.int64)
    for begin, end, *_ in hidden_times(result.happened, person, result.start):
        count += (times >= begin) & (times <= end)
    return count


def write_csv(result: Result, target: Path, choices: Choices) -> None:
    """Write a table with a header line; an empty cell is a gap."""
    table(result, choices.parts).round(6).to_csv(target, lineterminator="\n")


def write_parquet(result: Result, target: Path, choices: Choices) -> None:
    """Write the table of :func:`write_csv` at full precision."""
    rows = table(result, choices.parts).reset_index()
    rows.attrs["hiros"] = EXPORT_MARK  # pandas stores them as metadata of the file
    rows.to_parquet(target, index=False)


def write_jsonl(result: Result, target: Path, choices: Choices) -> None:
    """Write one object per person and time; null is a gap."""
    names, lines = result.model.marker_names, []
    angles = result.angles(0)
    for person, motion in result.motions.items():
        degrees, deviations = angles.loc[[person]].to_numpy(), deviations_of(motion)
        hidden = hidden_from(result, person).tolist()
        for k, time in enumerate(motion.times.tolist()):
            row: dict[str, Any] = {"person": int(person), "time": round(time, 6)}
            if "joints" in choices.parts:
                row["joints"] = dict(zip(names, map(_numbers, motion.positions[k]), strict=True))
                row["confidences"] = _named(names, motion.confidences[k])
                if motion.deviations is not None:
                    row["deviations"] = _named(names, deviations[k])
            if "angles" in choices.parts:
                row["angles"] = _named(angles.columns, degrees[k])
            row["hidden_from"] = hidden[k]
            lines.append(json.dumps(row))
    write_lines(target, lines)


def write_npz(result: Result, target: Path, choices: Choices) -> None:
    """Write ``person_<id>_times``, ``..._positions`` and so on, with the names of the columns."""
    arrays: dict[str, Any] = {EXPORT_MARK: [], "markers": np.array(result.model.marker_names)}
    angles = result.angles(0) if "angles" in choices.parts else None
    if angles is not None:
        arrays["angles"] = np.array(angles.columns, dtype=str)
    for person, motion in result.motions.items():
        arrays[f"person_{person}_times"] = motion.times
        arrays[f"person_{person}_hidden_from"] = hidden_from(result, person)
        if "joints" in choices.parts:
            arrays[f"person_{person}_positions"] = motion.positions
            arrays[f"person_{person}_confidences"] = motion.confidences
            if motion.deviations is not None:
                arrays[f"person_{person}_deviations"] = motion.deviations
        if angles is not None:
            arrays[f"person_{person}_angles"] = angles.loc[[person]].to_numpy()
    with target.open("wb") as file:  # a name would get the suffix .npz once more
        np.savez_compressed(file, **arrays)


def write_lines(target: Path, lines: Sequence[str]) -> None:
    """Write lines of text."""
    target.write_text("\n".join(lines) + "\n", encoding="utf-8", newline="\n")


def _named(names: Iterable[str], values: Floats) -> dict[str, float | None]:
    return dict(zip(names, _numbers(values), strict=True))


def _numbers(values: Floats) -> list[float | None]:
    return [None if math.isnan(v) else round(v, 6) for v in values.tolist()]


_MOST_COLUMNS = 16384  # as many as a sheet of a spreadsheet has

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
    values = {LOG_TIME: pd.Series(times, dtype="int64")} | {
        "".join(name for _, name in field).removeprefix("."): pd.Series(
            [row.get(field) for row in rows], dtype=object
        )
        for field in columns
    }
    frame = pd.DataFrame(values)

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
            _put_fields(decoders[message.channel_id](bytes(message.data)), (), row)
        except Exception as error:  # noqa: BLE001 - damaged bytes raise anything
            row = {}
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


def _put_fields(value: Any, path: FieldPath, row: dict[FieldPath, Any]) -> None:
    """Put every number and text in a message into a row, by its path."""
    if isinstance(value, SimpleNamespace):
        for k, name in enumerate(value.__slots__):
            _put_fields(getattr(value, name), (*path, (k, f".{name}")), row)
    elif isinstance(value, bytes | bytearray | memoryview) or (
        isinstance(value, array) and value.itemsize == 1
    ):
        row[(*path, (0, " (bytes)"))] = len(value)
    elif isinstance(value, list | tuple | array):
        for k, inner in enumerate(value):
            _put_fields(inner, (*path, (k, f"[{k}]")), row)
    else:
        row[path] = value
