"""Log times that cannot be right, and what the stamps of their messages say instead.

A recorder with use_sim_time logs at time 0 until it hears the first /clock. Others log years away
from everything else, because their own clock was set meanwhile. The stamps of such messages fit
those of all others all the same. So the stamp counts: the message gets the log time that a usual
delivery gives it. From there on the log is read as if it had been logged so.

- **Right.** Most log times lie about as long after their stamps as the others do. Between the first
  and the last of these the recorder's clock went right.
- **Wrong.** A log time far outside of that, or 0. What the recorder's clock did between is none of
  that: it may stall, and deliveries may be late (:mod:`hiros_mcap.io.camera_clock`).
- **Mended.** Only where the stamp, with the camera's usual delay, gives a time within a day of the
  right ones. Where both times make no sense, both stay. A message without a stamp, as of an empty
  room, is put beside the message before it in the file.

/tf_static is kept for late listeners, and is rightly logged at any time.

Live input knows the past alone (:class:`LiveLogTimes`). A message that is far ahead by its stamp,
too, waits until others follow it there; else it is left out. Where time begins anew, nobody can
mend it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from statistics import median_low
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

import hiros_schemas
from hiros_mcap.errors import LogError
from hiros_mcap.io.channels import TF_TOPICS, ChannelInfo, channels_of, info_of, is_ours
from hiros_mcap.io.container import McapReader, Records
from hiros_mcap.io.container.live_reader import Arriving, LiveReader
from hiros_mcap.io.container.records import Chunk, Message, Schema
from hiros_mcap.io.log_accounts import LATEST
from hiros_mcap.io.ros_cdr import definition
from hiros_mcap.kernels.record_index import CHANNEL, LOG_TIME, START, STOP
from hiros_mcap.skeletons import Flags, Stamps
from hiros_mcap.wording import quantity

FAR = 60_000_000_000
"""ns: a message that is later is no late one, and a log that pauses longer has two parts."""
EARLY = 500_000_000
"""ns: no message is logged so long before its time."""
_PAUSE = 86_400_000_000_000
"""ns: nobody looks at every message of a log because it pauses for an hour."""
_ENOUGH = 10  # messages that are logged near their stamps: then that is what right clocks do
_STAMP_AT = 4
"""Byte of a message at which its header's stamp begins: behind the encapsulation of CDR, or behind
the number of a ROS 1 header."""
_APART = 10 * 10**9
"""ns: how far messages out of order may lie from the newest one."""
_STAY = 100  # messages behind it, one after the other, that show that time goes on from there
_FOLLOW = 10  # messages ahead of it, none near it between them, that show the same
Bytes = npt.NDArray[np.uint8]


class StampPlace(NamedTuple):
    """Where the stamps of a channel's messages lie."""

    byte: int  # of the message; beyond all messages if they have none
    has_people: bool
    """Whether the messages are SkeletonGroups, whose people have times of their own."""


NO_STAMP = StampPlace(1 << 62, has_people=False)
"""Of a channel whose messages have no stamp to go by."""


def mend_log_times(reader: McapReader) -> None:
    """Let a reader hand out messages whose log times cannot be right by their stamps.

    ``reader.remarks`` says how many. Raises LogError where the file is damaged.
    """
    infos = {info.id: info for info in channels_of(reader) if info.count}
    stamped = {i: place for i, info in infos.items() if (place := place_of(reader, info))}
    chunks = sorted(reader.contents.chunks, key=lambda chunk: chunk.offset)
    if not _is_odd(reader, [chunk for chunk in chunks if chunk.holds(stamped)], stamped):
        return
    latched = {i: NO_STAMP for i, info in infos.items() if info.topic == TF_TOPICS[0]}
    places = stamped | latched
    chunks = [chunk for chunk in chunks if chunk.holds(places)]
    parts = [times_of(records, places) for records in reader.ahead(map(reader.load, chunks))]
    channels, log_times, stamps = np.concatenate(parts).T
    # What was written later tells nothing of the recorder.
    ours = [i for i in places if is_ours(infos[i].topic)]
    right = right_log_times(
        channels, log_times, stamps, ~np.isin(channels, ours), np.isin(channels, list(latched))
    )
    if (right == log_times).all():
        return
    cuts = np.cumsum([len(part) for part in parts])[:-1]
    mended = {}
    for chunk, old, new in zip(
        chunks, np.split(log_times, cuts), np.split(right, cuts), strict=True
    ):
        if (new != old).any():
            rows = np.isin(reader.load(chunk).messages[:, CHANNEL], list(places))
            mended[chunk.offset] = rows, new
    reader.retime(mended)
    mended_counts = Counter(infos[i].topic for i in channels[right != log_times].tolist())
    reader.remarks = (*reader.remarks, *remarks(mended_counts))


def place_of(reader: McapReader, info: ChannelInfo) -> StampPlace | None:
    """Return where the stamps of a channel's messages lie; None if they have none to go by."""
    schema = reader.schema(reader.channels[info.id])
    if schema is None or info.topic == TF_TOPICS[0]:
        return None
    is_group = info.encoding == "cdr" and info.has_type(hiros_schemas.SKELETON_GROUP)
    place = stamp_place(schema, info.encoding)
    return StampPlace(place, is_group) if place else None


def stamp_place(schema: Schema, encoding: str) -> int:
    """Byte of a message at which its stamp begins: that of its header, or of its first element's.

    0 if messages do not begin with either. ``encoding`` is that of the messages.
    """
    if encoding not in ("cdr", "ros1"):
        return 0
    with suppress(hiros_schemas.DefinitionError, UnicodeDecodeError, LogError):
        name, place = hiros_schemas.short_name(schema.name), _STAMP_AT
        text = definition(name, schema.encoding, bytes(schema.data).decode())
        texts = hiros_schemas.parse(name, text)
        for _ in range(4):  # messages in messages
            first = next(iter(texts.get(name, ())), None)
            if first is None:
                return 0
            place += 4 if first.is_sequence else 0
            if first.type.endswith("/Header") or first.type == "builtin_interfaces/Time":
                return place
            name = first.type
    return 0


def _is_odd(reader: McapReader, chunks: Sequence[Chunk], places: Iterable[int]) -> bool:
    """Whether a log time may be wrong, as far as the chunks tell, of which few are read."""
    spans = [(chunk.start_time, chunk.end_time) for chunk in chunks]
    for k in _odd(spans):
        messages = reader.load(chunks[k]).messages
        times = messages[np.isin(messages[:, CHANNEL], list(places)), LOG_TIME]
        if len(times):  # without what is rightly logged at any time
            spans[k] = int(times.min()), int(times.max())
    return bool(_odd(spans))


def _odd(spans: Sequence[tuple[int, int]]) -> set[int]:
    """Return which spans of chunks, in the order of the file, make no sense, with their neighbours.

    They begin at 0, are long, or lie far before or behind the one before them.
    """
    odd = {k for k, (start, end) in enumerate(spans) if not start or end - start > FAR}
    odd |= {k for k, (_, end) in enumerate(spans) if end > LATEST}
    for k in range(1, len(spans)):
        apart = spans[k][0] - spans[k - 1][1]
        if apart < -FAR or apart > _PAUSE:
            odd |= {k - 1, k}
    return odd


def times_of(records: Records, places: Mapping[int, StampPlace]) -> Stamps:
    """(N, 3) channel, log time and stamp, ns, of messages with stamps; a stamp of 0 is none."""
    messages = records.messages[np.isin(records.messages[:, CHANNEL], list(places))]
    channels = messages[:, CHANNEL].astype(np.int64)
    first = np.array([places[i].byte for i in channels.tolist()], np.int64)
    data = np.frombuffer(records.data, np.uint8)
    begin, end = messages[:, [START, STOP]].astype(np.int64).T
    stamps = _times(data, begin + first, end)
    groups = np.array([places[i].has_people for i in channels.tolist()], np.bool_)
    for k in np.flatnonzero(groups & (stamps == 0)).tolist():
        stamps[k] = _source_time(data[begin[k] : end[k]])
    log_times = np.minimum(messages[:, LOG_TIME], np.uint64(LATEST)).astype(np.int64)
    return np.stack([channels, log_times, stamps], axis=1)


def stamp_of(message: Message, place: StampPlace) -> int:
    """Return the stamp of a message, ns; 0 if it has none."""
    data = np.frombuffer(message.data, np.uint8)
    stamp = int(_times(data, np.array([place.byte]), np.array([len(data)]))[0])
    return _source_time(data) if place.has_people and not stamp else stamp


def _times(data: Bytes, at: Stamps, end: Stamps) -> Stamps:
    """(N,) ns, the times in some places of bytes; 0 where a message ends before, or has none."""
    times, whole = np.zeros(len(at), np.int64), at + 8 <= end
    words = data[at[whole, None] + np.arange(8)].view("<u4").astype(np.int64)
    times[whole] = words[:, 0] * 1_000_000_000 + words[:, 1]
    return times


def _source_time(message: Bytes) -> int:
    """Time, ns, of the first person of a SkeletonGroup; 0 if there is none."""
    if len(message) < 20:
        return 0
    behind_name = 16 + int.from_bytes(message[12:16].tobytes(), "little")
    place = -(-behind_name // 4) * 4 + 8
    return int(_times(message, np.array([place]), np.array([len(message)]))[0])


def right_log_times(
    channels: Stamps, log_times: Stamps, stamps: Stamps, counts: Flags, latched: Flags
) -> Stamps:
    """(N,) ns, log times of messages in the order of the file, those that are wrong mended.

    Parameters
    ----------
    channels, log_times, stamps : (N,) of the messages; ns, a stamp of 0 is none.
    counts : (N,) which messages tell what is right, if any of them can.
    latched : (N,) which messages may be older than all others.
    """
    known = (stamps > 0) & (log_times > 0) & (log_times < LATEST)
    teachers = known & counts if (known & counts).any() else known
    usual, first, last = _recorder(log_times[teachers], stamps[teachers])
    inside = known & (log_times >= first - FAR) & (log_times <= last + FAR)
    due = stamps + _delays(channels, log_times - stamps, inside, usual)
    stamped = stamps > 0
    far = np.where(stamped, FAR, _PAUSE)
    is_wrong = (log_times < first - far) | (log_times > last + far)
    is_wrong |= (log_times == 0) & (np.where(stamped, due, first) > EARLY)
    is_wrong &= ~latched | (log_times > last)
    begin, end = (first - _PAUSE, last + _PAUSE) if last else (0, LATEST)
    mended = is_wrong & stamped & (due >= begin) & (due <= end)
    right = np.where(mended, due, log_times)
    good, lost = np.flatnonzero(~is_wrong | mended), np.flatnonzero(is_wrong & ~stamped)
    if len(good):
        right[lost] = right[good[np.maximum(np.searchsorted(good, lost) - 1, 0)]]
    return right


def _recorder(log_times: Stamps, stamps: Stamps) -> tuple[int, int, int]:
    """Return the usual log time - stamp of messages, and between which log times it is so; ns."""
    usual = _usual(log_times - stamps)
    near = log_times[np.abs(log_times - stamps - usual) <= FAR]
    return (usual, int(near.min()), int(near.max())) if len(near) else (0, 0, 0)


def _delays(channels: Stamps, lags: Stamps, inside: Flags, usual: int) -> Stamps:
    """(N,) usual log time - stamp, ns, of each message's channel, by those that are ``inside``."""
    delays = np.full(len(channels), usual)
    for channel in np.unique(channels[inside]).tolist():
        delays[channels == channel] = int(np.median(lags[inside & (channels == channel)]))
    return delays


def _usual(lags: Stamps) -> int:
    """Return the usual log time - stamp, ns, of (N,): the middle, or that of enough near 0."""
    near = lags[np.abs(lags) <= FAR]
    counted = near if len(near) >= _ENOUGH else lags
    return int(np.median(counted)) if len(counted) else 0


def remarks(mended: Mapping[str, int]) -> Iterator[str]:
    """Say how many messages of which topics were logged at a wrong time, and what hiros does."""
    if mended:
        parts = [f"{quantity(n, 'message')} of {topic}" for topic, n in sorted(mended.items())]
        verb = "was" if len(parts) == 1 else "were"
        yield (
            f"{', '.join(parts)} {verb} logged at time 0 (1970) or far from all others; the stamps "
            "fit, so hiros goes by them"
        )


class LiveLogTimes:
    """Gives messages right log times in the order in which they come.

    Where time begins anew, which nobody can put in order, ``reader`` reads no further.
    """

    def __init__(self, reader: LiveReader) -> None:
        self._reader = reader
        self._places: dict[int, StampPlace | None] = {}
        self._delays: dict[int, int] = {}
        """Channel -> log time - stamp, ns, of its last message."""
        self._delay = 0  # that of the last message of all
        self._last = 0  # log time, ns, of the last message with a stamp
        self._newest = 0  # the latest log time of messages that went on
        self._back = 0  # how many such messages were far behind it, one after the other
        self._ahead: list[Message] = []
        """Messages far ahead of it, which wait until there are enough."""
        self._mended: Counter[str] = Counter()
        self._left_out: Counter[str] = Counter()

    def right(self, messages: Arriving) -> Arriving:
        """Yield messages with right log times, without those that are far ahead alone."""
        for message in messages:
            place = None if message is None else self._place(message.channel_id)
            if message is None or place is None:
                yield message
                continue
            message = self._retimed(message, stamp_of(message, place))
            time = message.log_time
            if time - self._newest > _APART:
                self._ahead.append(message)
                if len(self._ahead) == _FOLLOW:
                    yield from self._followed()
                continue
            if self._newest - time <= _APART:
                self._leave_out(self._ahead)
                self._ahead = []
            self._newest = max(self._newest, time)
            yield message
            if self._begins_anew(time):
                return
        yield from self._followed()

    def _followed(self) -> list[Message]:
        """Return the messages that wait, without those far ahead of most: time goes on there."""
        waiting, self._ahead = self._ahead, []
        times = [message.log_time for message in waiting]
        end = median_low(times) + _APART if times else 0
        self._newest = max([self._newest, *(time for time in times if time <= end)])
        self._leave_out(m for m in waiting if m.log_time > end)
        return [m for m in waiting if m.log_time <= end]

    def _leave_out(self, messages: Iterable[Message]) -> None:
        self._left_out.update(self._reader.channels[m.channel_id].topic for m in messages)

    def _place(self, ident: int) -> StampPlace | None:
        """Return where the stamps of a channel's messages lie; None if their times all count."""
        if ident not in self._places:
            self._places[ident] = place_of(self._reader, info_of(self._reader, ident))
        return self._places[ident]

    def _retimed(self, message: Message, stamp: int) -> Message:
        """Return a message at the time that its stamp, ns, tells where its log time is wrong."""
        ident, logged, right = message.channel_id, message.log_time, message.log_time
        delay = self._delays.get(ident, self._delay)
        if logged == 0:
            due = max(stamp + delay, 0) if stamp else self._last
            right = due if due > EARLY else 0
        elif stamp and abs(logged - self._newest) > FAR:
            due = stamp + delay
            right = due if abs(due - self._newest) <= _APART else logged
        if stamp:
            self._delay = self._delays[ident] = right - stamp
            self._last = right
        if right == logged:
            return message
        self._mended[self._reader.channels[ident].topic] += 1
        return replace(message, log_time=right)

    def _begins_anew(self, logged: int) -> bool:
        """Notice that time goes on from an earlier one, and end there."""
        self._back = self._back + 1 if self._newest - logged > _APART else 0
        if self._back == _STAY:
            self._reader.end(
                f"time went back by {(self._newest - logged) * 1e-9:.0f} s, and hiros ended there: "
                "a clock was set back, a recording is played again, or a file is not in order of "
                "time; start hiros again, or name the file instead of a pipe"
            )
        return self._back == _STAY

    def remarks(self) -> Iterator[str]:
        """Say how many messages were mended, and how many were left out."""
        yield from remarks(self._mended)
        for topic, n in sorted(self._left_out.items()):
            yield (
                f"{topic}: {quantity(n, 'message')} neither read nor copied, logged more than "
                f"{_APART // 10**9} s ahead of all others"
            )
