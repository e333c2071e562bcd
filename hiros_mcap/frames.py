"""Several frames at once: what makes a run fast.

A call into a compiled kernel costs as much as the kernel needs for a skeleton or two. So a log is
read chunk by chunk, the frames of a chunk go from stage to stage as one :class:`Block`, and a stage
makes one call for all of them. Results do not depend on how the frames are cut into blocks.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Concatenate, NamedTuple, ParamSpec, TypeVar

import numpy as np

from hiros_mcap.kernels.array_types import B1, F2, I1, I2, arrays, chosen
from hiros_mcap.kernels.people_rows import gather
from hiros_mcap.skeletons import Floats, Frame, People, Stage, Stamps, Uncertainty


class Doubts(NamedTuple):
    """Why P detections count less than they say: what the stages before the merger find out.

    A block with these columns is a table of views: a row is what a camera shows of a person.
    Plausible and hidden write variances, and plausible which views are distorted.
    """

    variances: F2
    """(P, M) m2, by which the variance of a marker is larger, because its camera cannot see it or
    it contradicts the body."""
    distorted: B1
    """(P,) whether a detection is left out as a whole; it still tells that the person is there."""

    @classmethod
    def none(cls, n_people: int, n_markers: int) -> Doubts:
        """Return columns of people whom nobody doubts yet."""
        return arrays(cls, (n_people, n_markers), n_people)

    def at(self, rows: Any) -> Doubts:
        """Return some people: views if ``rows`` is a slice, copies if it is a mask or indices."""
        return chosen(self, rows)


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """N frames whose people are rows of common arrays. Nobody writes into the rows of a block."""

    stamps: Stamps  # (N,) time of each frame, ns
    log_times: Stamps  # (N,) ns
    sources: Stamps  # (N,) number of each camera among ``names``
    frame_ids: Stamps  # (N,) number of each coordinate frame among ``names``
    names: tuple[str, ...]  # of cameras and coordinate frames
    rows: Stamps  # (N, 2) first row of each frame's people, and the row after the last
    people: People
    uncertainty: Uncertainty | None = None  # of the same rows; None = no stage has said anything
    doubts: Doubts | None = None  # of the same rows; None = no stage has looked

    def __repr__(self) -> str:
        return f"<Block {len(self)} frames, {int(self.sizes.sum())} people>"

    def __len__(self) -> int:
        """N."""
        return len(self.stamps)

    @classmethod
    def of(cls, frame: Frame) -> Block:
        """Block of one frame, whose arrays it shares."""
        return cls(
            np.array([frame.stamp], np.int64),
            np.array([frame.log_time], np.int64),
            np.array([0]),
            np.array([1]),
            (frame.source, frame.frame_id),
            np.array([[0, frame.n_people]], np.int64),
            frame.people,
            frame.uncertainty,
        )

    @property
    def sizes(self) -> Stamps:
        """(N,) people of each frame."""
        return np.asarray(self.rows[:, 1] - self.rows[:, 0])

    def source(self, i: int) -> str:
        """Name of the camera of frame ``i``."""
        return self.names[int(self.sources[i])]

    def frame(self, i: int) -> Frame:
        """Frame ``i``; its arrays are views."""
        rows = slice(*self.rows[i].tolist())
        stamp, log_time = int(self.stamps[i]), int(self.log_times[i])
        uncertainty = self.uncertainty and self.uncertainty.at(rows)
        frame_id = self.names[int(self.frame_ids[i])]
        return Frame(stamp, log_time, self.source(i), frame_id, self.people.at(rows), uncertainty)

    def messages(self) -> Iterator[tuple[int, str, int]]:
        """Stamp, source and log time of every frame, in order."""
        names = [self.names[k] for k in self.sources.tolist()]
        return zip(self.stamps.tolist(), names, self.log_times.tolist(), strict=True)

    def everybody(self) -> tuple[Stamps, Stamps]:
        """Rows of all people, (P,) in the order of the frames, and (P,) the frame of each."""
        owners = np.repeat(np.arange(len(self)), self.sizes)
        return rows_between(self.rows), owners

    def doubt_columns(self) -> Doubts:
        """Return the doubts; new columns without any where no stage has looked."""
        return self.doubts or Doubts.none(*self.people.markers.shape[:2])

    def select(self, frames: slice | Sequence[int] | Stamps) -> Block:
        """Return some of the frames, of the same arrays."""
        chosen = frames if isinstance(frames, slice) else np.asarray(frames, np.int64)
        return Block(
            self.stamps[chosen], self.log_times[chosen], self.sources[chosen],
            self.frame_ids[chosen], self.names, self.rows[chosen],
            self.people, self.uncertainty, self.doubts,
        )  # fmt: skip

    def logged_at(self, log_times: Stamps | Sequence[int]) -> Block:
        """Return the same frames with other log times, (N,) ns."""
        return replace(self, log_times=np.asarray(log_times, np.int64))

    def restamped(self, stamps: Stamps) -> Block:
        """Return the same frames at other times, (N,) ns; people's times change with them."""
        if np.array_equal(stamps, self.stamps):
            return self
        times, (rows, owners) = self.people.stamps.copy(), self.everybody()
        times[rows] += np.where(times[rows] > 0, (stamps - self.stamps)[owners], 0)
        return replace(self, stamps=stamps, people=self.people._replace(stamps=times))

    def without_empty(self) -> Block:
        """Return the same frames without people of whom no marker is known."""
        rows, owners = self.everybody()
        known = ~np.isnan(self.people.markers[rows, :, 0]).all(axis=1)
        if known.all():
            return self
        rows, counts = rows[known], np.bincount(owners[known], minlength=len(self))
        ends = np.cumsum(counts)
        sure = self.uncertainty and self.uncertainty.at(rows)
        doubts = self.doubts and self.doubts.at(rows)
        spans, people = np.stack([ends - counts, ends], axis=1), self.people.at(rows)
        return replace(self, rows=spans, people=people, uncertainty=sure, doubts=doubts)

    def frames(self) -> Iterator[Frame]:
        """Every frame, in order."""
        for i in range(len(self)):
            yield self.frame(i)


P = ParamSpec("P")
Columns = TypeVar("Columns", Uncertainty, Doubts)

BlockStage = Callable[[Iterable[Block]], Iterator[Block]]
"""A step of a system: a generator over blocks, whose frames are those of a Stage."""


class CameraMessages(NamedTuple):
    """K messages in order of time, as kernels take them."""

    stamps: I1  # (K,) ns
    cameras: I1  # (K,) number of each camera
    spans: I2  # (K, 2) first row of each message's people, and the row after the last


class CameraNumbers(dict[str, int]):
    """Numbers the cameras of some blocks in the order in which their first frames come."""

    def __init__(self) -> None:
        super().__init__()
        self._table: tuple[tuple[str, ...], Stamps] = (), np.empty(0, np.int64)
        """Names of the last block, and the numbers of those that were cameras; -1 of the others."""

    def of(self, block: Block) -> Stamps:
        """(N,) Number of the camera of each frame."""
        names, table = self._table
        if names != block.names or (table[block.sources] < 0).any():
            self._number(block)
        return np.asarray(self._table[1][block.sources])

    def messages(self, block: Block) -> CameraMessages:
        """Return the frames of a block with the numbers of their cameras."""
        return CameraMessages(block.stamps, self.of(block), block.rows)

    def _number(self, block: Block) -> None:
        """Give numbers to the cameras of a block; keep those of all its names."""
        codes, first = np.unique(block.sources, return_index=True)
        for code in codes[np.argsort(first)].tolist():
            self.setdefault(block.names[code], len(self))
        numbers = [self.get(name, -1) for name in block.names]
        self._table = block.names, np.array(numbers, np.int64)


def places_of(names: Iterable[str], places: Mapping[str, Floats]) -> Floats:
    """(C, 3) Positions of cameras, m; NaN where ``places`` has none."""
    return np.array([places.get(name, 3 * [np.nan]) for name in names]).reshape(-1, 3)


def join(
    blocks: Sequence[Block], order: Stamps | None = None, widths: tuple[int, int] = (0, 0)
) -> Block:
    """Return copies of the frames of blocks, one block behind the other.

    ``order`` : which frames, counted through all blocks, come in which order; None = all.
    ``widths`` : columns that markers, and links, get at least; those that are new are NaN.
    """
    widths = (
        max(widths[0], *(block.people.markers.shape[2] for block in blocks)),
        max(widths[1], *(block.people.links.shape[2] for block in blocks)),
    )
    is_all = order is None or len(order) == len(blocks[0]) == 1
    if len(blocks) == 1 and is_all and (span := _span_of(blocks[0], widths)):
        block, rows = blocks[0], np.arange(*span)  # a live input has one such frame after the other
        sure = block.uncertainty and block.uncertainty.at(rows)
        doubts = block.doubts and block.doubts.at(rows)
        people, begins = block.people.at(slice(*span)).copy(), block.rows - span[0]
        return replace(block, rows=begins, people=people, uncertainty=sure, doubts=doubts)
    of_block = np.repeat(np.arange(len(blocks)), [len(block) for block in blocks])
    wanted = np.arange(len(of_block)) if order is None else order
    of_block, rows = of_block[wanted], np.concatenate([block.rows for block in blocks])[wanted]
    ends = np.cumsum(rows[:, 1] - rows[:, 0])
    targets = ends - (rows[:, 1] - rows[:, 0])
    slots = blocks[0].people.markers.shape[1], blocks[0].people.links.shape[1]
    people = People.allocate(int(ends[-1]), *slots, *widths)
    for k, block in enumerate(blocks):
        mask = of_block == k
        gather(rows[mask], targets[mask], block.people, people)
    names, sources, frame_ids = _common_names(blocks)
    return Block(
        np.concatenate([block.stamps for block in blocks])[wanted],
        np.concatenate([block.log_times for block in blocks])[wanted],
        sources[wanted],
        frame_ids[wanted],
        names,
        np.stack([targets, ends], axis=1),
        people,
        _join_columns([block.uncertainty for block in blocks], of_block, rows),
        _join_columns([block.doubts for block in blocks], of_block, rows),
    )


def together(blocks: Sequence[Block]) -> Block:
    """Return the frames of blocks as one: a single one shares its arrays, others are copied."""
    return blocks[0] if len(blocks) == 1 else join(blocks)


def _span_of(block: Block, widths: tuple[int, int]) -> tuple[int, int] | None:
    """First row, and the row after the last, of frames that follow each other in their arrays.

    None if they do not, or have not as many columns.
    """
    bounds = block.rows.ravel().tolist()
    have = block.people.markers.shape[2], block.people.links.shape[2]
    if not bounds or have != widths or bounds[1:-1:2] != bounds[2::2]:
        return None
    return bounds[0], bounds[-1]


class HeldFrames:
    """Frames that wait, numbered as they come."""

    def __init__(self) -> None:
        self._blocks: list[tuple[Stamps, Block]] = []
        """Numbers of the frames that wait in a block, and these frames."""
        self.count = 0  # frames so far: the number of the next one

    def add(self, block: Block) -> int:
        """Hold the frames of a block; return the number of the first."""
        first, self.count = self.count, self.count + len(block)
        if len(block):
            self._blocks.append((np.arange(first, self.count), block))
        return first

    def take(self, numbers: Sequence[int] | Stamps) -> Block:
        """Return the frames with these numbers, in this order; of several blocks, their copies."""
        wanted = np.asarray(numbers)
        first, last = wanted.min(), wanted.max()
        held = [pair for pair in self._blocks if first <= pair[0][-1] and pair[0][0] <= last]
        places = np.searchsorted(np.concatenate([ids for ids, _ in held]), wanted)
        blocks = [block for _, block in held]
        return blocks[0].select(places) if len(blocks) == 1 else join(blocks, places)

    def keep(self, numbers: Sequence[int] | Stamps) -> None:
        """Let go of all frames but these."""
        kept, blocks = np.sort(np.asarray(numbers, np.int64)), self._blocks
        self._blocks = []
        for ids, block in blocks:
            begin, end = np.searchsorted(kept, [ids[0], ids[-1] + 1])
            if end - begin == len(ids):
                self._blocks.append((ids, block))
            elif end > begin:
                places = np.searchsorted(ids, kept[begin:end])
                self._blocks.append((ids[places], block.select(places)))


def _common_names(blocks: Sequence[Block]) -> tuple[tuple[str, ...], Stamps, Stamps]:
    """Return names for all blocks, and the numbers of the sources and of the frame_ids of all."""
    if all(block.names == blocks[0].names for block in blocks):
        sources = np.concatenate([block.sources for block in blocks])
        return blocks[0].names, sources, np.concatenate([block.frame_ids for block in blocks])
    numbers = dict[str, int]()
    tables = [np.array([numbers.setdefault(n, len(numbers)) for n in b.names]) for b in blocks]
    pairs = list(zip(tables, blocks, strict=True))
    sources = np.concatenate([table[block.sources] for table, block in pairs])
    return tuple(numbers), sources, np.concatenate([table[b.frame_ids] for table, b in pairs])


def rows_between(rows: Stamps) -> Stamps:
    """(P,) All rows of frames (N, 2), in their order."""
    sizes = rows[:, 1] - rows[:, 0]
    skipped = rows[:, 0] - (np.cumsum(sizes) - sizes)
    return np.asarray(np.repeat(skipped, sizes) + np.arange(sizes.sum()))


def _join_columns(
    tables: Sequence[Columns | None], of_block: Stamps, rows: Stamps
) -> Columns | None:
    """Return what stages say of frames with these ``rows`` of blocks; None if a block has none."""
    known = [table for table in tables if table is not None]
    if len(known) < len(tables):
        return None
    whole, parts = _used(of_block, rows, [len(table[0]) for table in known])
    cut: Any = [table.at(part) for table, part in zip(known, parts, strict=True)]
    columns: Columns = cut[0]._make(
        # What is no array are the names of cameras: later ones are added at the end.
        np.concatenate(field)[whole] if isinstance(field[0], np.ndarray) else max(field, key=len)
        for field in zip(*cut, strict=True)
    )
    return columns


def _used(of_block: Stamps, rows: Stamps, sizes: Sequence[int]) -> tuple[Stamps, list[slice]]:
    """Return the part of each block's rows that frames lie in, and their rows among these parts.

    A stage takes a few frames at a time out of a block of many; the others need not be copied.
    """
    begins, ends = np.array(sizes, np.int64), np.zeros(len(sizes), np.int64)
    np.minimum.at(begins, of_block, rows[:, 0])
    np.maximum.at(ends, of_block, rows[:, 1])
    ends = np.maximum(begins, ends)  # of a block without frames: none
    shifts = np.cumsum(ends - begins) - ends
    whole = rows_between(rows + shifts[of_block, None])
    return whole, list(map(slice, begins.tolist(), ends.tolist()))


def frames_of(blocks: Iterable[Block]) -> Iterator[Frame]:
    """Yield the frames of blocks one by one."""
    for block in blocks:
        yield from block.frames()


def by_frame(
    stage: Callable[Concatenate[Iterable[Block], P], Iterator[Block]],
) -> Callable[Concatenate[Iterable[Frame], P], Iterator[Frame]]:
    """Make a stage of frames of a stage of blocks; nothing comes out later than it can."""

    def run(frames: Iterable[Frame], /, *args: P.args, **parameters: P.kwargs) -> Iterator[Frame]:
        yield from frames_of(stage(map(Block.of, frames), *args, **parameters))

    return run


def by_block(stage: Stage) -> BlockStage:
    """Make a stage of blocks of a stage that looks at one frame after the other."""

    def run(blocks: Iterable[Block]) -> Iterator[Block]:
        yield from map(Block.of, stage(frames_of(blocks)))

    return run
