"""Bytes of SkeletonGroup messages to Frames and back, by the kernels of ``kernels.cdr``.

Decoding is exact: numbers keep their bits, ids and stamps their values. :func:`clean` is the
separate step that takes out numbers that cannot be true.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import accumulate, count, pairwise
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from hiros_mcap.body.rotations import Rigid, to_matrix
from hiros_mcap.errors import LogError
from hiros_mcap.frames import Block
from hiros_mcap.io.layout import PUBLISHED, Bytes, Layout, check_schema
from hiros_mcap.kernels import batch as batch_kernels
from hiros_mcap.kernels import cdr, cleaning, encode
from hiros_mcap.skeletons import (
    BOX,
    ORIENTATION,
    STATE,
    Floats,
    Frame,
    People,
    SkeletonModel,
    Stamps,
)

__all__ = [
    "PUBLISHED",
    "Batch",
    "BatchDecoder",
    "Decoder",
    "Encoder",
    "Layout",
    "ModelBuilder",
    "Poses",
    "Said",
    "check_schema",
    "clean",
]

_FAULTS = {
    cdr.TRUNCATED: "message ends in the middle, or claims more elements than it has bytes for",
    cdr.TRAILING: f"message has more than {cdr.MAX_PADDING} bytes after its last field",
    cdr.STRING_LENGTH: f"message has a string longer than {cdr.MAX_STRING} bytes",
    cdr.STRING_END: "message has a string without its final NUL",
    cdr.NANOSEC: "message has a time of 1e9 or more nanoseconds",
    cdr.TOO_MANY: f"message has more than {cdr.MAX_PEOPLE} skeletons",
}
_ENCAPSULATIONS = {
    0x0002: "PL_CDR_BE (parameter list)",
    0x0003: "PL_CDR_LE (parameter list)",
    0x0006: "CDR2_BE (XCDR2)",
    0x0007: "CDR2_LE (XCDR2)",
    0x0008: "D_CDR2_BE (XCDR2)",
    0x0009: "D_CDR2_LE (XCDR2)",
    0x000A: "PL_CDR2_BE (XCDR2)",
    0x000B: "PL_CDR2_LE (XCDR2)",
}
_CLEANED = (
    "absurd number",
    "incomplete vector",
    "quaternion of length 0",
    "quaternion normalised",
    "confidence above 1",
)
_NEGATIVE = "negative confidence"
_NOTHING: Mapping[str, int] = {}
Precision = Literal["micrometre", "full"]
_DROPPED = 32  # of the 52 bits of a mantissa: 20 are left


def clean(frame: Frame) -> tuple[Frame, Mapping[str, int]]:
    """Take out numbers that cannot be true; return the frame and how often, by kind.

    - "absurd number": infinite or beyond 1e4 (m, m/s, ...): its whole vector becomes NaN;
    - "incomplete vector": some of its numbers are NaN: all become NaN;
    - "quaternion of length 0": becomes NaN;
    - "quaternion normalised": its length was off by more than 1e-3 (smaller errors, beyond the
      rounding of float32, are put right without a word);
    - "confidence above 1": becomes 1; an infinite one is an absurd number;
    - "negative confidence": becomes NaN, since detectors mean by -1 that they give none.

    A frame in which nothing is wrong is returned itself; the given frame never changes.
    """
    counts = np.empty(cleaning.COUNTS, np.int64)
    if not cleaning.clean(counts, False, *_measured(frame)):
        return frame, _NOTHING
    fixed = frame.replace(
        confidences=frame.confidences.copy(),
        markers=frame.markers.copy(),
        marker_confidences=frame.marker_confidences.copy(),
        links=frame.links.copy(),
        link_confidences=frame.link_confidences.copy(),
        boxes=frame.boxes.copy(),
    )
    negative = _drop_negative(fixed) if counts[cleaning.CONFIDENCE] else 0
    cleaning.clean(counts, True, *_measured(fixed))
    found = _by_kind(counts.tolist())
    return fixed, {**found, _NEGATIVE: negative} if negative else found


def _drop_negative(frame: Frame) -> int:
    """Make negative confidences NaN, in place; return how many."""
    total = 0
    for confidences in (frame.confidences, frame.marker_confidences, frame.link_confidences):
        negative = (confidences < 0) & np.isfinite(confidences)
        confidences[negative] = np.nan
        total += int(negative.sum())
    return total


def _by_kind(counts: Iterable[int]) -> Mapping[str, int]:
    return {kind: n for kind, n in zip(_CLEANED, counts, strict=True) if n}


class ModelBuilder:
    """Learns the skeleton model of a log from some of its messages."""

    def __init__(self) -> None:
        self._markers: dict[int, tuple[str, str]] = {}
        self._links: dict[int, tuple[tuple[str, int, int], str]] = {}
        self._max_markers = 0
        self._max_links = 0

    def add(self, data: Bytes, topic: str, layout: Layout = PUBLISHED) -> None:
        """Take note of a message's markers and links.

        Raises :class:`LogError` if the message is damaged, or gives an id another name or a link
        other ends than a former one did.
        """
        data = layout(data, topic)
        rows = np.empty((len(data) // cdr.MIN_MARKER + 1, cdr.OUTLINE), np.int64)
        report = np.zeros(cdr.REPORT, np.int64)
        code = cdr.outline(_as_array(data), rows, report)
        if code != cdr.OK:
            raise _fault(code, report, data, topic)
        self._max_markers = max(self._max_markers, int(report[cdr.MOST_MARKERS]))
        self._max_links = max(self._max_links, int(report[cdr.MOST_LINKS]))
        for is_link, key, start, end, parent, child in rows[: report[cdr.ROWS]].tolist():
            name = _text(data, start, end, topic)
            if is_link:
                self._add_link(key, (name, parent, child), topic)
            else:
                self._add_marker(key, name, topic)

    def _add_marker(self, key: int, name: str, topic: str) -> None:
        known, where = self._markers.setdefault(key, (name, topic))
        if known != name:
            raise LogError(f"marker {key} is {name!r} here and {known!r} on {where}", topic=topic)

    def _add_link(self, key: int, link: tuple[str, int, int], topic: str) -> None:
        known, where = self._links.setdefault(key, (link, topic))
        if known != link:
            raise LogError(
                f"link {key} is {link[0]!r} from marker {link[1]} to {link[2]} here "
                f"and {known[0]!r} from {known[1]} to {known[2]} on {where}",
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


class _Tables(NamedTuple):
    """A model as the kernels want it (see ``kernels.cdr``)."""

    markers: npt.NDArray[np.int64]
    links: npt.NDArray[np.int64]
    words: npt.NDArray[np.uint64]

    @classmethod
    def of(cls, model: SkeletonModel) -> _Tables:
        """Prepare the tables of a model; ids must increase."""
        words = bytearray()
        markers = _prepare(words, model.marker_ids, model.marker_names)
        links = _prepare(words, model.link_ids, model.link_names)
        unused = next(key for key in count(-1, -1) if key not in model.marker_ids)
        ids = (*model.marker_ids, cdr.ABSENT + unused)  # for slot -1
        ends = [
            (*row, ids[parent], ids[child])
            for row, parent, child in zip(
                links, model.link_parents, model.link_children, strict=True
            )
        ]
        return cls(
            np.array(markers, np.int64).reshape(-1, 3),
            np.array(ends, np.int64).reshape(-1, 5),
            np.frombuffer(bytes(words), np.uint64).copy(),
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


class Decoder:
    """Turns the messages of one channel into Frames of one model.

    Keeps no state from one message to the next that a result depends on.
    """

    def __init__(
        self, model: SkeletonModel, *, topic: str | None = None, layout: Layout = PUBLISHED
    ) -> None:
        self.model = model
        self._topic = topic
        self._layout = layout
        self._tables = _Tables.of(model)
        self._report = np.zeros(cdr.REPORT, np.int64)
        self._sources = np.empty((cdr.MAX_PEOPLE, 2), np.int64)
        self._scratch: tuple[Any, ...] = (
            np.empty(model.n_markers + model.n_links, np.int64),
            self._report,
            self._sources,
        )
        self._slots = model.n_markers, model.n_links
        self._most_likely = 1  # people; corrected when a message has another number of them

    def decode(self, data: Bytes, log_time: int) -> Frame:
        """Read a message, exactly.

        ``stamp`` is header.stamp, ``stamps`` are the skeletons' src_time (0 = not given).
        ``source`` is their src_frame where all have the same, else the header's frame_id;
        ``frame_id`` is the header's, or where that is empty the common src_frame.

        Raises :class:`LogError` for damaged bytes, for an encapsulation other than plain CDR, and
        for markers and links that are not in the model, have another name or ends than there, or
        come twice in one skeleton.
        """
        return self._decode(
            data if self._layout is PUBLISHED else self._layout(data, self._topic), log_time
        )

    def decode_all(self, data: Bytes, log_time: int) -> list[Frame]:
        """Read a message as one Frame per distinct src_frame, in the order of their appearance.

        For a channel on which several cameras' skeletons share a message. A message whose
        skeletons have one src_frame, or that has none, is one Frame, as :meth:`decode` gives it.
        """
        if self._layout is not PUBLISHED:
            data = self._layout(data, self._topic)
        frame = self._decode(data, log_time)
        if not self._report[cdr.MIXED]:
            return [frame]
        header = frame.frame_id  # without a common src_frame it is the header's
        people: dict[str, list[int]] = {}
        for person, source in enumerate(self._names(data, frame.n_people)):
            people.setdefault(source, []).append(person)
        return [
            frame.select(rows).replace(source=source or header, frame_id=header or source)
            for source, rows in people.items()
        ]

    def _decode(self, data: Bytes, log_time: int) -> Frame:
        buffer = _as_array(data)
        arrays = People.room(self._most_likely, *self._slots)
        code = cdr.decode(buffer, *self._tables, *self._scratch, *arrays)
        if code == cdr.PEOPLE:
            self._most_likely = int(self._report[cdr.COUNT])
            arrays = People.room(self._most_likely, *self._slots)
            code = cdr.decode(buffer, *self._tables, *self._scratch, *arrays)
        if code != cdr.OK:
            raise _fault(code, self._report, data, self._topic)
        *_, stamp, header, header_end, source, source_end, mixed = self._report.tolist()
        frame_id = _text(data, header, header_end, self._topic)
        common = _text(data, source, source_end, self._topic)
        if mixed:
            self._names(data, len(arrays[0]))  # for the fault, if one is no text
            common = ""
        return Frame(stamp, log_time, common or frame_id, frame_id or common, *arrays)

    def _names(self, data: Bytes, n_people: int) -> list[str]:
        """Return each person's src_frame."""
        places = self._sources[:n_people].tolist()
        return [_text(data, start, end, self._topic) for start, end in places]


class Said(NamedTuple):
    """What a message of a :class:`Batch` says besides its people's arrays."""

    stamp: int
    """header.stamp, ns."""
    times: list[int]
    """Source time of each person, ns."""
    source: str
    frame_id: str
    cleaned: Mapping[str, int]
    """How many numbers were taken out, by kind."""


class Batch:
    """What the messages of some chunks say, cleaned; their people share one set of arrays."""

    def __init__(
        self,
        people: People,
        first: Stamps,
        codes: Stamps,
        reports: Stamps,
        cleaned: Stamps,
        moved_to: list[str],
        texts: list[tuple[str | None, str | None]],
    ) -> None:
        """All but the lists is as ``decode_batch`` fills it.

        ``moved_to`` name the frame that each message's people were moved to; "" = they are as they
        were measured. ``texts`` are its frame_id and src_frame; None = is not UTF-8.
        """
        self.people = people
        self.rows: list[tuple[int, int]] = list(pairwise(first.tolist()))
        """First row of each message's people, and the row after the last."""
        times, stamps = people.stamps.tolist(), reports[:, cdr.HEADER_STAMP].tolist()
        usable = codes == cdr.OK
        usable &= (reports[:, cdr.MIXED] == 0) & (cleaned[:, cleaning.CONFIDENCE] == 0)
        kinds: dict[int, Mapping[str, int]] = {
            i: _by_kind(cleaned[i].tolist()) for i in np.flatnonzero(cleaned.any(axis=1)).tolist()
        }
        self._said: list[Said | None] = [None] * len(codes)
        for i in np.flatnonzero(usable).tolist():
            frame_id, common = texts[i]
            if frame_id is not None and common is not None:
                self._said[i] = Said(
                    stamps[i],
                    times[slice(*self.rows[i])],
                    common or frame_id,
                    moved_to[i] or frame_id or common,
                    kinds.get(i, _NOTHING),
                )

    def said(self, row: int) -> Said | None:
        """Return what a message says, whose people are rows of ``people``.

        None = it needs a closer look: it is damaged, or holds several cameras' skeletons, or
        confidences out of range, of which :func:`clean` tells the negative ones apart.
        """
        return self._said[row]

    def frame(self, row: int, log_time: int) -> tuple[Frame, Mapping[str, int]] | None:
        """Return what :meth:`Decoder.decode` and :func:`clean` would of a message, in that order.

        None = as :meth:`said`.
        """
        said = self._said[row]
        if said is None:
            return None
        people = self.people.at(slice(*self.rows[row]))
        return Frame(said.stamp, log_time, said.source, said.frame_id, *people), said.cleaned


class Poses:
    """Poses at rest of frames in the fixed frame, found out by name as they are asked for."""

    def __init__(
        self, fixed: str = "", lookup: Callable[[str], Rigid | None] | None = None
    ) -> None:
        self.fixed = fixed
        self._lookup = lookup
        self._rows: dict[bytes, int] = {}
        self.arrays: tuple[Floats, Floats, Floats] = (
            np.empty((0, 4)),
            np.empty((0, 3, 3)),
            np.empty((0, 3)),
        )
        """Quaternions (K, 4), matrices (K, 3, 3) and translations (K, 3), m."""

    def find(self, name: bytes) -> int:
        """Row of a frame's pose; -1 if it has none, or is the fixed frame itself."""
        row = self._rows.get(name)
        if row is None:
            row = self._rows[name] = self._learn(name)
        return row

    def _learn(self, name: bytes) -> int:
        frame = name.decode(errors="replace").lstrip("/")
        pose = self._lookup(frame) if self._lookup and frame not in ("", self.fixed) else None
        if pose is None:
            return -1
        turns, matrices, places = self.arrays
        self.arrays = (
            np.concatenate([turns, pose.xyzw[None]]),
            np.concatenate([matrices, to_matrix(pose.xyzw)[None]]),
            np.concatenate([places, pose.translation[None]]),
        )
        return len(turns)


class BatchDecoder:
    """Decodes the messages of chunks at once; for logs, where :class:`Decoder` is for streams."""

    _MOST = 64 * 2**20  # bytes of arrays; what needs more is decoded message by message

    def __init__(self, model: SkeletonModel) -> None:
        self._tables = _Tables.of(model)
        self._slots = model.n_markers, model.n_links
        self._scratch = np.empty(sum(self._slots), np.int64)

    def decode(
        self, parts: Sequence[tuple[Bytes, Stamps]], poses: Poses | None = None
    ) -> Batch | None:
        """Read messages of the published layout that lie in data at places (N, 2), part by part.

        People whose message names a frame of ``poses`` are moved by its pose. None = the messages
        would need too much memory at once.
        """
        buffers = [_as_array(data) for data, _ in parts]
        cuts = [0, *accumulate(len(places) for _, places in parts)]
        n = cuts[-1]
        first, reports = np.zeros(n + 1, np.int64), np.zeros((n, cdr.REPORT), np.int64)
        for buffer, (_, places), (a, b) in zip(buffers, parts, pairwise(cuts), strict=True):
            batch_kernels.read_headers(buffer, places, reports[a:b], first[a : b + 1])
        rows = int(first[-1])
        if rows * 8 * (sum(self._slots) * (STATE + 1) + BOX) > self._MOST:
            return None
        people = People.room(rows, *self._slots)
        poses = poses or Poses()
        codes, cleaned = np.empty(n, np.int64), np.zeros((n, cleaning.COUNTS), np.int64)
        sources = np.empty((rows, 2), np.int64)
        moved_to: list[str] = []
        texts: list[tuple[str | None, str | None]] = []
        known: dict[bytes, str | None] = {}
        for buffer, (data, places), (a, b) in zip(buffers, parts, pairwise(cuts), strict=True):
            spans = (places[:, :1] + reports[a:b, [cdr.FRAME, cdr.FRAME_END]]).tolist()
            names = [bytes(data[start:end]) for start, end in spans]
            pose_of = [poses.find(name) for name in names]
            moved_to += [poses.fixed if pose >= 0 else "" for pose in pose_of]
            batch_kernels.decode_batch(
                buffer, places, *self._tables, self._scratch, reports[a:b], cleaned[a:b],
                codes[a:b], first[a : b + 1], sources, *people, np.array(pose_of, np.int64),
                *poses.arrays,
            )  # fmt: skip
            spans = (places[:, :1] + reports[a:b, [cdr.SOURCE, cdr.SOURCE_END]]).tolist()
            for name, (start, end) in zip(names, spans, strict=True):
                texts.append((_decoded(name, known), _decoded(bytes(data[start:end]), known)))
        return Batch(people, first, codes, reports, cleaned, moved_to, texts)


def _decoded(data: bytes, known: dict[bytes, str | None]) -> str | None:
    """Return a text, None for bytes that are none; the same object for the same text."""
    if data not in known:
        try:
            known[data] = data.decode()
        except UnicodeDecodeError:
            known[data] = None
    return known[data]


class Encoder:
    """Turns Frames of one model into messages.

    Parameters
    ----------
    model : of the frames.
    derivatives : write velocities and accelerations; else they are NaN in every message.
    precision : "full" keeps every bit; "micrometre" rounds to 20 bits of mantissa, a relative
        error of at most 2**-21 (0.5 um at 1 m, 1 um at 2 m), which halves the compressed size.
    """

    def __init__(
        self,
        model: SkeletonModel,
        *,
        derivatives: bool = True,
        precision: Precision = "full",
    ) -> None:
        self.model = model
        self._hierarchy = encode.Hierarchy(
            np.array([model.max_markers, model.max_links], np.int64), *_Tables.of(model)
        )
        columns = STATE if derivatives else ORIENTATION.stop
        self._format = encode.Format(columns, 0 if precision == "full" else _DROPPED)
        self._out = np.empty(0, np.uint8)

    def encode(self, frame: Frame, source: str | None = None) -> bytes:
        """Write a message, little-endian; absent markers and links are left out.

        ``source`` becomes every skeleton's src_frame; if None, ``frame.source`` does.

        Raises :class:`LogError` if a stamp lies beyond the years 1901 to 2038 that messages can
        express, and :class:`ValueError` for arrays that do not fit each other or the model.
        """
        block = Block.of(frame if source is None else frame.replace(source=source))
        while isinstance(ends := self.encode_into(block, self._out), int):
            self._out = np.empty(2 * ends, np.uint8)
        return self._out[: ends[0]].tobytes()

    def encode_into(
        self,
        block: Block,
        out: npt.NDArray[np.uint8],
        first: int = 0,
        gap: int = 0,
        limit: int = 1,
    ) -> list[int] | int:
        """Write the messages of a block from frame ``first`` on to the front of ``out``.

        Each comes ``gap`` bytes behind the one before it, the first too. It ends with the first
        message that reaches byte ``limit``, or for which there is no room. Returns where each
        message ends, or how many bytes are enough if there is no room for one. Raises as
        :meth:`encode` does.
        """
        messages = _messages(block, first)
        ends = np.empty(len(messages.stamps), np.int64)
        n = encode.encode(
            out, gap, limit, messages, self._hierarchy, block.people, self._format, ends
        )
        if n == -encode.SHAPE:
            raise ValueError("the arrays of the frame do not fit each other or the model")
        if n == -encode.STAMP:
            raise LogError("a stamp lies outside the years 1901 to 2038")
        return -int(n) if n < 0 else ends[:n].tolist()


def _messages(block: Block, first: int) -> encode.Messages:
    """Return what the messages of a block from frame ``first`` on hold besides people."""
    texts: dict[str, tuple[int, int]] = {}
    joined = b""
    places = []
    for pair in zip(block.frame_ids[first:], block.sources[first:], strict=True):
        for text in pair:
            if text not in texts:
                data = text.encode()
                texts[text] = len(joined), len(joined) + len(data)
                joined += data
        places.append((*texts[pair[0]], *texts[pair[1]]))
    return encode.Messages(
        _as_array(joined), np.array(places, np.int64), block.stamps[first:], block.rows[first:]
    )


def _measured(frame: Frame) -> tuple[Any, ...]:
    """Return the numbers of a frame in the order that the kernels take them."""
    return (
        frame.confidences,
        frame.markers,
        frame.marker_confidences,
        frame.links,
        frame.link_confidences,
        frame.boxes,
    )


def _as_array(data: Bytes) -> npt.NDArray[np.uint8]:
    return np.frombuffer(data, np.uint8)


def _text(data: Bytes, start: int, end: int, topic: str | None) -> str:
    try:
        return str(data[start:end], "utf-8")
    except UnicodeDecodeError as error:
        raise LogError("message has a string that is not UTF-8", topic=topic) from error


def _fault(code: int, report: npt.NDArray[np.int64], data: Bytes, topic: str | None) -> LogError:
    """Say what is wrong with a message and where."""
    at, person, key, start, end, *_ = report.tolist()
    if code == cdr.ENCAPSULATION:
        number = int.from_bytes(data[:2], "big")
        kind = _ENCAPSULATIONS.get(number, "unknown")
        return LogError(f"message encapsulation 0x{number:04x} {kind} is not CDR", topic=topic)
    if code in _FAULTS:
        where = f" (byte {at}, skeleton {person})" if person >= 0 else f" (byte {at})"
        return LogError(_FAULTS[code] + where, topic=topic)
    name = str(bytes(data[start : min(end, start + 80)]), "utf-8", "replace")
    return LogError(
        {
            cdr.UNKNOWN_MARKER: f"marker {key} {name!r} is not in the skeleton model",
            cdr.UNKNOWN_LINK: f"link {key} {name!r} is not in the skeleton model",
            cdr.MARKER_NAME: f"marker {key} has another name, {name!r}, than in the skeleton model",
            cdr.LINK_NAME: f"link {key} has another name, {name!r}, than in the skeleton model",
            cdr.LINK_ENDS: f"link {key} joins other markers than in the skeleton model",
            cdr.REPEATED_MARKER: f"marker {key} comes twice in skeleton {person}",
            cdr.REPEATED_LINK: f"link {key} comes twice in skeleton {person}",
        }[code],
        topic=topic,
    )
