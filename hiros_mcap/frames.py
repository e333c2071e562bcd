"""Several frames at once: what makes a run fast.

A call into a compiled kernel costs as much as the kernel needs for a skeleton or two. So a log is
read chunk by chunk, the frames of a chunk go from stage to stage as one :class:`Block`, and a stage
makes one call for all of them. Results do not depend on how the frames are cut into blocks.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Concatenate, ParamSpec

import numpy as np

from hiros_mcap.kernels.gathering import gather
from hiros_mcap.skeletons import Frame, People, Stage, Stamps, Uncertainty


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """N frames whose people are rows of common arrays. Nobody writes into the rows of a block."""

    stamps: Stamps
    """(N,) time of each frame, ns."""
    log_times: Stamps
    """(N,) ns."""
    sources: Sequence[str]
    """N names."""
    frame_ids: Sequence[str]
    """N names of coordinate frames."""
    rows: Stamps
    """(N, 2) first row of each frame's people, and the row after the last."""
    people: People
    uncertainty: Uncertainty | None = None
    """Of the same rows; None = no stage has said anything."""

    def __repr__(self) -> str:
        return f"<Block {len(self)} frames, {int(np.ptp(self.rows, axis=1).sum())} people>"

    def __len__(self) -> int:
        """N."""
        return len(self.stamps)

    @classmethod
    def of(cls, frame: Frame) -> Block:
        """Block of one frame, whose arrays it shares."""
        return cls(
            np.array([frame.stamp], np.int64),
            np.array([frame.log_time], np.int64),
            (frame.source,),
            (frame.frame_id,),
            np.array([[0, frame.n_people]], np.int64),
            frame.people,
            frame.uncertainty,
        )

    def frame(self, i: int) -> Frame:
        """Frame ``i``; its arrays are views."""
        rows = slice(*self.rows[i].tolist())
        stamp, log_time = int(self.stamps[i]), int(self.log_times[i])
        known = self.uncertainty and self.uncertainty.at(rows)
        source, frame_id = self.sources[i], self.frame_ids[i]
        return Frame(stamp, log_time, source, frame_id, self.people.at(rows), known)

    def messages(self) -> Iterator[tuple[int, str, int, Part]]:
        """Stamp, source, log time and place of every frame, in order."""
        times = zip(self.stamps.tolist(), self.sources, self.log_times.tolist(), strict=True)
        for i, (stamp, source, log_time) in enumerate(times):
            yield stamp, source, log_time, (self, i)

    def select(self, places: Sequence[int], log_times: Sequence[int]) -> Block:
        """Return some of the frames, with other log times, of the same arrays."""
        chosen = np.array(places, np.int64)
        return Block(
            self.stamps[chosen],
            np.array(log_times, np.int64),
            [self.sources[i] for i in places],
            [self.frame_ids[i] for i in places],
            self.rows[chosen],
            self.people,
            self.uncertainty,
        )

    def restamped(self, stamps: Stamps) -> Block:
        """Return the same frames at other times, (N,) ns; people's times change with them."""
        if np.array_equal(stamps, self.stamps):
            return self
        times = self.people.stamps.copy()
        shifts = (stamps - self.stamps).tolist()
        for shift, (begin, end) in zip(shifts, self.rows.tolist(), strict=True):
            own = times[begin:end]
            own[own > 0] += shift
        return replace(self, stamps=stamps, people=self.people._replace(stamps=times))

    def frames(self) -> Iterator[Frame]:
        """Every frame, in order."""
        for i in range(len(self)):
            yield self.frame(i)


P = ParamSpec("P")

Part = tuple[Block, int]
"""A frame of a block."""

BlockStage = Callable[[Iterable[Block]], Iterator[Block]]
"""A step of a system: a generator over blocks, whose frames are those of a Stage."""


def join(parts: Sequence[Part]) -> Block:
    """Return a block of some frames of any blocks, in this order; arrays are copied."""
    sources: dict[int, tuple[People, list[tuple[int, int, int]]]] = {}
    rows, total = [], 0
    bounds: dict[int, list[list[int]]] = {}
    for block, i in parts:
        if id(block) not in bounds:
            bounds[id(block)] = block.rows.tolist()
        begin, end = bounds[id(block)][i]
        rows.append((total, total + end - begin))
        _, pieces = sources.setdefault(id(block.people), (block.people, []))
        if pieces and pieces[-1][1] == begin and pieces[-1][2] + begin - pieces[-1][0] == total:
            pieces[-1] = pieces[-1][0], end, pieces[-1][2]
        else:
            pieces.append((begin, end, total))
        total += end - begin
    some = parts[0][0].people
    joined = People.allocate(total, some.markers.shape[1], some.links.shape[1])
    for people, pieces in sources.values():
        gather(np.array(pieces, np.int64), people, joined)
    return Block(
        np.array([block.stamps[i] for block, i in parts], np.int64),
        np.array([block.log_times[i] for block, i in parts], np.int64),
        [block.sources[i] for block, i in parts],
        [block.frame_ids[i] for block, i in parts],
        np.array(rows, np.int64),
        joined,
        _join_uncertainty(parts),
    )


def _join_uncertainty(parts: Sequence[Part]) -> Uncertainty | None:
    """Return the uncertainty of some frames of any blocks; None if one of them has none."""
    known = [block.uncertainty for block, _ in parts if block.uncertainty is not None]
    if len(known) < len(parts):
        return None
    rows = [slice(*block.rows[i].tolist()) for block, i in parts]
    some = [each.at(own) for each, own in zip(known, rows, strict=True)]
    return Uncertainty(
        np.concatenate([each.deviations for each in some]),
        np.concatenate([each.cameras for each in some]),
        max((each.names for each in some), key=len),
        np.concatenate([each.shared for each in some]),
    )


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


def most_often(ids: list[int]) -> int:
    """How often the most frequent id of a frame comes: once, in any frame that makes sense."""
    return 1 if len(set(ids)) == len(ids) else max(map(ids.count, ids))
