"""Bytes of SkeletonGroup messages to frames and back, by the kernels of ``kernels.cdr``.

There is one decoder. It takes the messages of some chunks at once; a single message is a batch of
one. What makes a message odd is handled on the way:

- it cannot be decoded: its fault is kept, the others are not concerned;
- it holds the skeletons of several cameras: it becomes one frame for each.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import count, pairwise
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from hiros_mcap.body.rotations import Rigid
from hiros_mcap.body.transforms import pose_arrays
from hiros_mcap.errors import LogError
from hiros_mcap.frames import Block
from hiros_mcap.io.container import Batch, Keys, Records
from hiros_mcap.io.container.records import Bytes
from hiros_mcap.kernels import batch as batch_kernels
from hiros_mcap.kernels import cdr, encode
from hiros_mcap.kernels.record_index import CHANNEL, COLUMNS, LOG_TIME, START, STOP
from hiros_mcap.skeletons import (
    BOX,
    POSE,
    STATE,
    Flags,
    Floats,
    Frame,
    People,
    SkeletonModel,
)

_FAULTS = {
    cdr.TRUNCATED: "message ends in the middle, or claims more elements than it has bytes for",
    cdr.TRAILING: f"message has more than {cdr.MAX_PADDING} bytes after its last field",
    cdr.STRING_LENGTH: f"message has a string longer than {cdr.MAX_STRING} bytes",
    cdr.STRING_END: "message has a string without its final NUL",
    cdr.NANOSEC: "message has a time of 1e9 or more nanoseconds",
    cdr.TOO_MANY: f"message has more than {cdr.MAX_PEOPLE} skeletons",
}
_NOT_TEXT = "message has a string that is not UTF-8"
Precision = Literal["micrometre", "full"]
_DROPPED = 32  # of the 52 bits of a mantissa: 20 are left


class OtherSkeletonError(LogError):
    """A message, or a channel, whose markers or links have other names than the log's."""


class ModelBuilder:
    """Learns the skeleton model of a log from some of its messages."""

    def __init__(self) -> None:
        self._markers: dict[int, tuple[str, str]] = {}
        self._links: dict[int, tuple[tuple[str, int, int], str]] = {}
        self._max_markers = 0
        self._max_links = 0

    def add(self, data: Bytes, topic: str) -> bool:
        """Take note of a message's markers and links; say whether it has any.

        Raises :class:`LogError` if the message is damaged, or gives an id another name or a link
        other ends than a former one did.
        """
        rows = np.empty((len(data) // cdr.MIN_MARKER + 1, cdr.OUTLINE), np.int64)
        report = np.zeros(cdr.REPORT, np.int64)
        code = cdr.outline(_as_array(data), rows, report)
        if code != cdr.OK:
            raise LogError(_fault(code, report.tolist(), data), topic=topic)
        self._max_markers = max(self._max_markers, int(report[cdr.MOST_MARKERS]))
        self._max_links = max(self._max_links, int(report[cdr.MOST_LINKS]))
        own = dict[int, str]()
        for is_link, key, start, end, parent, child in rows[: report[cdr.ROWS]].tolist():
            try:
                name = str(data[start:end], "utf-8")
            except UnicodeDecodeError:
                raise LogError(_NOT_TEXT, topic=topic) from None
            if is_link:
                self._add_link(key, (name, parent, child), topic)
                continue
            if (other := own.setdefault(key, name)) != name:
                raise LogError(f"markers {other!r} and {name!r} have one id, {key}", topic=topic)
            first, where = self._markers.setdefault(key, (name, topic))
            if first != name:
                fault = f"marker {key} is {name!r} here and {first!r} on {where}"
                raise OtherSkeletonError(fault, topic=topic)
        return bool(report[cdr.ROWS])

    def _add_link(self, key: int, link: tuple[str, int, int], topic: str) -> None:
        first, where = self._links.setdefault(key, (link, topic))
        if first != link:
            raise OtherSkeletonError(
                f"link {key} is {link[0]!r} from marker {link[1]} to {link[2]} here "
                f"and {first[0]!r} from {first[1]} to {first[2]} on {where}",
                topic=topic,
            )

    @property
    def complete(self) -> bool:
        """Whether every marker and link that the detectors claim to know was seen."""
        return 0 < self._max_markers <= len(self._markers) and self._max_links <= len(self._links)

    def build(self) -> SkeletonModel:
        """Return the model of what was seen so far, ids increasing."""
        markers = sorted(self._markers)
        links = sorted(self._links)
        slots = {key: slot for slot, key in enumerate(markers)}
        ends = [self._links[key][0] for key in links]
        return SkeletonModel(
            marker_ids=tuple(markers),
            marker_names=tuple(self._markers[key][0] for key in markers),
            link_ids=tuple(links),
            link_names=tuple(name for name, _, _ in ends),
            link_parents=tuple(slots.get(parent, -1) for _, parent, _ in ends),
            link_children=tuple(slots.get(child, -1) for _, _, child in ends),
            max_markers=self._max_markers,
            max_links=self._max_links,
        )


def model_tables(model: SkeletonModel, *, is_open: bool = False) -> cdr.Tables:
    """Prepare a model for the kernels, see :class:`~.cdr.Tables`; its ids must increase."""
    words = bytearray()
    markers = _prepare(words, model.marker_ids, model.marker_names)
    links = _prepare(words, model.link_ids, model.link_names)
    unused = next(key for key in count(-1, -1) if key not in model.marker_ids)
    ids = (*model.marker_ids, cdr.ABSENT + unused)  # for slot -1
    ends = [
        (*row, ids[parent], ids[child])
        for row, parent, child in zip(links, model.link_parents, model.link_children, strict=True)
    ]
    return cdr.Tables(
        np.array(markers, np.int64).reshape(-1, 3),
        np.array(ends, np.int64).reshape(-1, 5),
        np.frombuffer(bytes(words), np.uint64).copy(),
        is_open,
    )


def _prepare(words: bytearray, ids: Iterable[int], names: Iterable[str]) -> list[tuple[int, ...]]:
    """Append the bytes that each slot's element starts with; return (id, first word, length)."""
    rows: list[tuple[int, ...]] = []
    for key, name in zip(ids, names, strict=True):
        if rows and key <= rows[-1][0]:
            raise ValueError("the ids of a skeleton model must increase")
        text = name.encode()
        element = struct.pack("<iI", key, len(text) + 1) + text + b"\0"
        rows.append((key, len(words) // 8, len(element)))
        words += element + bytes(-len(element) % 8)
    return rows


class RestPoses:
    """Poses in the fixed frame of frames that do not move, looked up by name when asked for."""

    def __init__(
        self, fixed: str = "", lookup: Callable[[str], Rigid | None] | None = None
    ) -> None:
        self.fixed = fixed
        self.arrays = pose_arrays([])
        self._poses: list[Rigid] = []
        self._lookup = lookup
        self._rows: dict[bytes, int] = {}

    def find(self, name: bytes) -> int:
        """Row of a frame's pose; -1 if it has none, or is the fixed frame itself."""
        row = self._rows.get(name)
        if row is None:
            row = self._rows[name] = self._add(name)
        return row

    def _add(self, name: bytes) -> int:
        frame = name.decode(errors="replace").lstrip("/")
        pose = self._lookup(frame) if self._lookup and frame not in ("", self.fixed) else None
        if pose is None:
            return -1
        self._poses.append(pose)
        self.arrays = pose_arrays(self._poses)
        return len(self._poses) - 1


MessagePart = tuple[str, str, int, int]
"""The people of a message that one camera saw: their src_frame, or the header's frame_id if it is
empty; the header's frame_id, or their src_frame if it is empty, or the fixed frame if they were
moved; the row of the first of them, and the one after the last."""


class Decoded(NamedTuple):
    """N messages, decoded. Their people are rows of common arrays."""

    people: People
    keys: Keys  # (N, 3) by which the messages are ordered (io.container.reader)
    channels: list[int]  # of each message
    stamps: list[int]  # header.stamp of each message, ns
    parts: list[list[MessagePart]]
    """Of each message: one, none if it cannot be decoded, several if several cameras share it."""
    cleaned: Mapping[int, Mapping[str, int]]
    """Message -> how many numbers were taken out, by kind; no entry if none were."""
    zeros: Mapping[int, npt.NDArray[np.int64]]
    """Message -> (M,) of how many people a marker was at exactly 0 0 0; no entry if of nobody."""
    faults: Mapping[int, str]  # message -> why it cannot be decoded
    until: int | None  # as in the batch


class Decoder:
    """Turns messages of one skeleton model into frames.

    Parameters
    ----------
    model : of the frames.
    poses : people whose message names one of these frames are moved to the fixed frame.
    exact : keep every bit. By default numbers that cannot be true are taken out
        (see :func:`hiros_mcap.kernels.batch.clean`), and so are markers at exactly 0 0 0, people
        without any marker and copies of people; a person's time before 1970 becomes 0.
    slim : leave out the columns of velocities and accelerations until a message holds one.
    own_frames : channel -> the frame of its detections, whatever frame its messages name.
    is_open : leave out markers and links that are not in the model. Who reads a log while it is
        written does not know all that will come.
    """

    _MOST = 64 * 2**20  # bytes of people; a larger batch is decoded in parts

    def __init__(
        self,
        model: SkeletonModel,
        *,
        poses: RestPoses | None = None,
        exact: bool = False,
        slim: bool = False,
        own_frames: Mapping[int, str] | None = None,
        is_open: bool = False,
    ) -> None:
        self.model = model
        self._beyond = ModelBuilder()  # of messages of which something was left out
        self._own_frames = {} if own_frames is None else own_frames
        self._poses = poses or RestPoses()
        self._exact = exact
        self._width = POSE if slim else STATE
        self._tables = model_tables(model, is_open=is_open)
        self._slots = model.n_markers, model.n_links
        self._scratch = np.empty(sum(self._slots), np.int64)

    @property
    def left_out(self) -> list[str]:
        """Names of the markers that were left out, in the order of their ids."""
        beyond, known = self._beyond.build(), self.model.marker_ids
        pairs = zip(beyond.marker_ids, beyond.marker_names, strict=True)
        return [name for ident, name in pairs if ident not in known]

    def decode_message(self, data: Bytes, log_time: int = 0) -> list[Frame]:
        """Read one message: a frame for each camera that saw somebody, in order of appearance.

        Raises :class:`LogError` for damaged bytes, for an encapsulation other than plain CDR, and
        for markers and links that are not in the model, have another name or ends than there, or
        come twice in one skeleton.
        """
        row = np.zeros((1, COLUMNS), np.uint64)
        row[0, [LOG_TIME, STOP]] = log_time, len(data)
        (decoded,) = self.decode(Batch([Records(data, row, 0)], None))
        if decoded.faults:
            raise LogError(decoded.faults[0])
        people, stamp = decoded.people, decoded.stamps[0]
        return [
            Frame(stamp, log_time, source, frame_id, people.at(slice(begin, end)))
            for source, frame_id, begin, end in decoded.parts[0]
        ]

    def decode(self, batch: Batch) -> Iterator[Decoded]:
        """Read the messages of a batch; in several parts if their people take much memory."""
        decoded = self._decoded(batch)
        if decoded is None:
            for half in batch.halves():
                yield from self.decode(half)
            return
        del batch  # else its bytes lie in memory until somebody wants what comes next
        yield decoded

    def _decoded(self, batch: Batch) -> Decoded | None:
        """Read the messages of a batch; None if their people take much memory."""
        n = sum(len(records.messages) for records in batch.records)
        first, reports = np.zeros(n + 1, np.int64), np.zeros((n, cdr.REPORT), np.int64)
        faults: dict[int, str] = {}
        sections = list(_sections(batch.records))
        for section in sections:
            batch_kernels.read_headers(*section, first, reports)
        if n > 1 and first[-1] * 8 * (sum(self._slots) * (STATE + 1) + BOX) > self._MOST:
            return None
        data = [part.data.data[a:b] for part in sections for a, b in part.places.tolist()]
        channels = np.concatenate([records.messages[:, CHANNEL] for records in batch.records])
        own = [self._own_frames.get(ident, "") for ident in channels.tolist()]
        people, results = self._people(sections, data, first, reports, own)
        for i in np.flatnonzero(reports[:, cdr.LEFT_OUT]).tolist():
            with suppress(LogError):
                self._beyond.add(data[i], "")
        return Decoded(
            people,
            np.concatenate([records.keys for records in batch.records]),
            channels.tolist(),
            reports[:, cdr.HEADER_STAMP].tolist(),
            list(self._parts(data, people, results, faults, own)),
            _by_kind(results.cleaned),
            {i: results.zeros[i] for i in np.flatnonzero(results.zeros.any(axis=1)).tolist()},
            faults,
            batch.until,
        )

    def read_times(self, batch: Batch) -> npt.NDArray[np.int64]:
        """(N, 4) of each message with a header: channel, log time, header.stamp and src_time, ns.

        src_time is that of the first person. A time is 0 if there is none, or nobody: an empty
        message may have any stamp. Messages whose log time is beyond int64 are left out.
        """
        rows, has_header, shows = self._times(batch)
        rows[~shows, 2] = 0
        return rows[has_header]

    def spaced(
        self, batch: Batch, kept: Callable[[int, cdr.Table, cdr.Table, Flags], Flags]
    ) -> tuple[Batch, cdr.Table]:
        """Return some messages of a batch, and the times of all, see :meth:`read_times`.

        ``kept(channel, times, log_times, shows)`` says which messages of a channel, by these times
        (n,) in ns: that of the first person, or header.stamp, or the log time; and the log time;
        and whether it shows anybody.
        """
        rows, has_header, shows = self._times(batch)
        logged, headers, sources = rows.T[1:]
        times = np.where(sources > 0, sources, np.where(headers > 0, headers, logged))
        chosen = ~has_header  # whoever decodes them says what is wrong
        for channel in np.unique(rows[:, 0]).tolist():
            stamped = np.flatnonzero(has_header & (rows[:, 0] == channel))
            chosen[stamped] = kept(channel, times[stamped], logged[stamped], shows[stamped])
        rows[~shows, 2] = 0  # as in read_times
        ends = np.cumsum([len(records.messages) for records in batch.records])[:-1]
        parts = zip(batch.records, np.split(chosen, ends), strict=True)
        records = [r._replace(messages=r.messages[flags]) for r, flags in parts]
        return batch._replace(records=records), rows[has_header]

    def _times(self, batch: Batch) -> tuple[cdr.Table, Flags, Flags]:
        """Return the rows of :meth:`read_times`, which have a header, and which show anybody."""
        n = sum(len(records.messages) for records in batch.records)
        first, reports = np.zeros(n + 1, np.int64), np.zeros((n, cdr.REPORT), np.int64)
        rows = np.zeros((n, 4), np.int64)
        for section, records in zip(_sections(batch.records), batch.records, strict=True):
            batch_kernels.read_headers(*section, first, reports)
            places = slice(section.message, section.message + len(records.messages))
            rows[places, :2] = records.messages[:, [CHANNEL, LOG_TIME]]
            rows[places, 3] = _source_times(section, reports[places])
        rows[:, 2] = reports[:, cdr.HEADER_STAMP]
        has_header: Flags = (reports[:, cdr.FRAME] > 0) & (rows[:, 1] >= 0)
        return np.maximum(rows, 0), has_header, np.diff(first) > 0

    def _people(
        self,
        sections: Sequence[_Section],
        data: Sequence[memoryview],
        first: cdr.Table,
        reports: cdr.Table,
        own: Sequence[str],
    ) -> tuple[People, batch_kernels.Results]:
        """Decode, clean and move the people of all messages, whose headers were read.

        ``own`` is the frame of each message whose name for it does not count.
        """
        n, n_people = len(data), int(first[-1])
        people = People.allocate(n_people, *self._slots, self._width)
        frames = reports[:, [cdr.FRAME, cdr.FRAME_END]].tolist()
        named = (bytes(d[a:b]) for d, (a, b) in zip(data, frames, strict=True))
        poses = [self._poses.find(o.encode() or n) for o, n in zip(own, named, strict=True)]
        results = batch_kernels.Results(
            first,
            np.empty(n, np.int64),
            reports,
            np.array(poses, np.int64),
            np.zeros((n, batch_kernels.COUNTS), np.int64),
            np.empty((n_people, 2), np.int64),
            np.zeros((n, self.model.n_markers), np.int64),
        )
        for section in sections:
            is_whole = batch_kernels.decode_messages(
                *section, self._tables, results, people, self._poses.arrays, self._scratch,
                self._exact,
            )  # fmt: skip
            if not is_whole:
                self._width = STATE
                return self._people(sections, data, first, reports, own)
        if not self._exact:
            np.maximum(people.stamps, 0, out=people.stamps)
        return people, results

    def _parts(
        self,
        data: Sequence[memoryview],
        people: People,
        results: batch_kernels.Results,
        faults: dict[int, str],
        own: Sequence[str],
    ) -> Iterator[list[MessagePart]]:
        """Yield the parts of each message, or note its fault and yield none."""
        columns = [cdr.FRAME, cdr.FRAME_END, cdr.SOURCE, cdr.SOURCE_END, cdr.MIXED]
        reports, first = results.reports[:, columns].tolist(), results.first.tolist()
        texts: dict[bytes, str] = {}
        left_out = [batch_kernels.NOBODY, batch_kernels.COPY]
        nobodies: list[bool] = np.any(results.cleaned[:, left_out], axis=1).tolist()
        for i, code in enumerate(results.codes.tolist()):
            if code != cdr.OK:
                faults.setdefault(i, _fault(code, results.reports[i].tolist(), data[i]))
                yield []
                continue
            (begin, end), (start, stop, *source, is_mixed) = first[i : i + 2], reports[i]
            spans = [(start, stop), source]
            if is_mixed:
                spans[1:] = results.sources[begin:end].tolist()
            if nobodies[i]:
                somebody = _put_in_front(people, begin, end)
                end = begin + len(somebody)
                if is_mixed:
                    spans[1:] = [spans[1 + k] for k in somebody] or spans[1:2]
            try:
                frame_id, *sources = [_text(bytes(data[i][a:b]), texts) for a, b in spans]
            except UnicodeDecodeError:
                faults[i] = _NOT_TEXT
                yield []
                continue
            fixed = self._poses.fixed if results.pose_of[i] >= 0 else ""
            yield [
                (name or frame_id, fixed or own[i] or frame_id or name, first_row, end_row)
                for name, first_row, end_row in _by_source(sources, people, begin, end)
            ]


class _Section(NamedTuple):
    """Messages in one array of bytes, as the kernels take them."""

    data: npt.NDArray[np.uint8]
    places: cdr.Table  # (n, 2) first byte of each message, and the one after its last
    message: int  # number of the first message in the batch


def _sections(chunks: Iterable[Records]) -> Iterator[_Section]:
    """Yield the messages of each chunk."""
    message = 0
    for data, table, _ in chunks:
        places = table[:, [START, STOP]].astype(np.int64, order="C")
        yield _Section(_as_array(data), places, message)
        message += len(table)


def _source_times(section: _Section, reports: cdr.Table) -> cdr.Table:
    """(n,) src_time of the first person of each message whose header was read, ns; 0 = none."""
    times = np.zeros(len(reports), np.int64)
    at = section.places[:, 0] + ((reports[:, cdr.AT] + 3) & ~3) + 4  # behind the id
    timed = np.flatnonzero((reports[:, cdr.COUNT] > 0) & (at + 8 <= section.places[:, 1]))
    places = at[timed, None] + np.arange(8)
    words = section.data[places].view("<u4").astype(np.int64)
    swap = section.data[section.places[timed, 0] + 1] == 0
    words[swap] = section.data[places[swap]].view(">u4")
    seconds = words[:, 0].astype(np.int32)  # it is signed
    times[timed] = seconds.astype(np.int64) * cdr.NANO + words[:, 1]
    return times


def _text(data: bytes, texts: dict[bytes, str]) -> str:
    """Decode a name, once for all messages that have it; UnicodeDecodeError if it is no text."""
    if data not in texts:
        texts[data] = str(data, "utf-8")
    return texts[data]


def _by_source(
    names: list[str], people: People, begin: int, end: int
) -> Iterator[tuple[str, int, int]]:
    """Yield each src_frame of a message's people, by first appearance, and the rows of those.

    People are put in that order. One name stands for all of them.
    """
    if len(names) == 1:
        yield names[0], begin, end
        return
    groups: dict[str, list[int]] = {}
    for person, name in enumerate(names):
        groups.setdefault(name, []).append(person)
    people.reorder(begin, [person for group in groups.values() for person in group])
    for name, group in groups.items():
        yield name, begin, begin + len(group)
        begin += len(group)


def _put_in_front(people: People, begin: int, end: int) -> list[int]:
    """Put those of whom a marker is there before the others; return which they were."""
    is_there = ~np.isnan(people.markers[begin:end, :, 0]).all(axis=1)
    somebody, nobody = np.flatnonzero(is_there).tolist(), np.flatnonzero(~is_there).tolist()
    people.reorder(begin, somebody + nobody)
    return somebody


def _by_kind(counts: cdr.Table) -> dict[int, Mapping[str, int]]:
    """Name the numbers that were taken out of each message that has some."""
    return {
        i: {kind: n for kind, n in zip(batch_kernels.KINDS, counts[i].tolist(), strict=True) if n}
        for i in np.flatnonzero(counts.any(axis=1)).tolist()
    }


def rounded(values: Floats, precision: Precision) -> Floats:
    """Return numbers as :class:`Encoder` writes them."""
    if precision == "full":
        return values
    words = np.ascontiguousarray(values, np.float64).view(np.uint64)
    sign, unit = np.uint64(1 << 63), np.uint64(1 << _DROPPED)
    half, kept = unit >> np.uint64(1), ~(unit - np.uint64(1))
    magnitude = ((words & ~sign) + half) & kept
    near = (magnitude | (words & sign)).view(np.float64)
    return np.where(np.isfinite(near), near, values)


class Encoder:
    """Turns Frames of one model into messages.

    Parameters
    ----------
    model : of the frames.
    derivatives : write velocities and accelerations; else they are NaN in every message.
    precision : "full" keeps every bit; "micrometre" rounds to 20 bits of mantissa, a relative
        error of at most 2**-21 (0.5 um at 1 m, 1 um at 2 m), which halves the compressed size.
    boxes : write everybody's bounding box anew: the smallest along the axes of the frame that
        holds all markers (Hi-ROS 2023, table 1). Its centre has the orientation of the frame;
        height is along z, length along x, width along y. A person without any marker keeps the
        box that was given. By default all boxes are written as given.
    """

    def __init__(
        self,
        model: SkeletonModel,
        *,
        derivatives: bool = True,
        precision: Precision = "full",
        boxes: bool = False,
    ) -> None:
        self.model = model
        self._tables = model_tables(model)
        columns = STATE if derivatives else POSE
        dropped = 0 if precision == "full" else _DROPPED
        self._format = encode.Format(
            columns, dropped, int(boxes), model.max_markers, model.max_links
        )
        self._out = np.empty(1 << 21, np.uint8)

    def encode(self, frame: Frame, source: str | None = None) -> bytes:
        """Write a message, little-endian; absent markers and links are left out.

        ``source`` becomes every skeleton's src_frame; if None, ``frame.source`` does.

        Raises :class:`LogError` if a stamp lies beyond the years 1901 to 2038 that messages can
        express, and :class:`ValueError` for arrays that do not fit each other or the model.
        """
        block = Block.of(frame if source is None else frame.replace(source=source))
        return bytes(next(self.encode_block(block)))

    def encode_block(self, block: Block) -> Iterator[memoryview]:
        """Yield the message of each frame, as :meth:`encode`; it is valid until the next one."""
        first = 0
        while first < len(block):
            messages = _messages(block, first)
            ends = np.empty(len(messages.stamps), np.int64)
            n = encode.encode(self._out, messages, self._tables, block.people, self._format, ends)
            if n == -encode.SHAPE:
                raise ValueError("the arrays of the frame do not fit each other or the model")
            if n == -encode.STAMP:
                raise LogError(
                    "a stamp lies outside the years 1901 to 2038, which messages cannot hold; "
                    "check the clocks of the cameras and --clock"
                )
            if n < 0:
                self._out = np.empty(2 * -int(n), np.uint8)
                continue
            places = [0, *ends[:n].tolist()]
            yield from (self._out.data[a:b] for a, b in pairwise(places))
            first += int(n)


def _messages(block: Block, first: int) -> encode.Messages:
    """Return what the messages of a block from frame ``first`` on hold besides people."""
    texts = [name.encode() for name in block.names]
    sizes = np.array([len(text) for text in texts], np.int64)
    places = np.stack([np.cumsum(sizes) - sizes, np.cumsum(sizes)], axis=1)
    spans = [places[block.frame_ids[first:]], places[block.sources[first:]]]
    return encode.Messages(
        _as_array(b"".join(texts)), np.concatenate(spans, axis=1), block.stamps[first:],
        block.rows[first:],
    )  # fmt: skip


def _as_array(data: Bytes) -> npt.NDArray[np.uint8]:
    return np.frombuffer(data, np.uint8)


def _fault(code: int, report: Sequence[int], data: Bytes) -> str:
    """Say what is wrong with a message and where."""
    at, person, key, start, end = report[: cdr.NAME_END + 1]
    if code == cdr.ENCAPSULATION:
        return f"message encapsulation 0x{bytes(data[:2]).hex()} is not that of CDR (XCDR1)"
    if code in _FAULTS:
        where = f" (byte {at}, skeleton {person})" if person >= 0 else f" (byte {at})"
        return _FAULTS[code] + where
    name = str(bytes(data[start : min(end, start + 80)]), "utf-8", "replace")
    return {
        cdr.UNKNOWN_MARKER: f"marker {key} {name!r} is not in the skeleton model",
        cdr.UNKNOWN_LINK: f"link {key} {name!r} is not in the skeleton model",
        cdr.MARKER_NAME: f"marker {key} has another name, {name!r}, than in the skeleton model",
        cdr.LINK_NAME: f"link {key} has another name, {name!r}, than in the skeleton model",
        cdr.LINK_ENDS: f"link {key} joins other markers than in the skeleton model",
        cdr.REPEATED_MARKER: f"marker {key} comes twice in skeleton {person}",
        cdr.REPEATED_LINK: f"link {key} comes twice in skeleton {person}",
    }[code]
