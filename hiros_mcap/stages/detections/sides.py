"""Left and right, decided over time: views of a person are brought to their right sides.

Detectors mirror people, some whenever these turn their backs. A vote of the cameras cannot mend
that where most of them are wrong. So the facing of each person is the state of a hidden Markov
model (facing.py). It is measured across the trunk, in axes that are carried along with the
body (body_axes.py), so people may lie, crawl, roll and spin. Every view tells of it:

- the line through shoulders and hips: the facing is at a right angle to it;
- the labels left and right: which of the two sides of the line is in front;
- physical cues, whatever the labels are: head, elbows, knees, toes (body.forward_cues);
- the walking direction of people who are upright.

The log itself says how far each of them is trusted. Where two cameras contradict each other in
left and right, a physical cue still points the same way in both views; one that follows the label
does not, and is left out. A detector whose toes follow its labels assumes that everybody faces it:
its labels count for nothing.

With ``lookahead``, the facing at each moment follows from what comes before and after it: the
forward-backward algorithm, in windows that overlap. Without, it follows from the past alone. A view
that contradicts the facing is mirrored: its left and right are exchanged. If the line of a view is
far from the facing, whatever the labels, shoulders and hips are turned towards it, unless the
detector is known to be honest. Where nothing is known of a person's trunk, labels stay, and the
model starts anew when the trunk is seen again.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hiros_mcap.body.forward_cues import FacingMarkers
from hiros_mcap.events import Events
from hiros_mcap.frames import Block, CameraNumbers
from hiros_mcap.kernels.array_types import chosen, joined
from hiros_mcap.skeletons import UNTRACKED, Floats, SkeletonModel, Stamps
from hiros_mcap.stages.bank import Bank
from hiros_mcap.stages.detections import facing
from hiros_mcap.stages.detections.detection_params import SidesParams
from hiros_mcap.stages.detections.facing_evidence import (
    BINS,
    CELL,
    TOES,
    FacingPast,
    FacingTables,
    MeasuredViews,
    measure,
    write_evidence,
)
from hiros_mcap.stages.detections.views import views_of

_SLAVED = 0.3  # toes that point the same way less often than this follow the label
_MOST = 1000  # views that become one block, about: 10 MB


def knows_sides(model: SkeletonModel) -> bool:
    """Whether the names of the markers tell left from right, and which way the trunk is."""
    markers = FacingMarkers.of(model)
    return bool(len(markers.lateral) and len(markers.trunk) + len(markers.upper))


def decide_sides(
    blocks: Iterable[Block], model: SkeletonModel, params: SidesParams | None = None,
    events: Events | None = None,
) -> Iterator[Block]:  # fmt: skip
    """Bring the views of every person to their right sides.

    Parameters
    ----------
    blocks : tracked frames of all cameras in the fixed frame, roughly in time order.
    model : names and hierarchy of the skeleton. Without names of left and right nothing is done.
    params : see :class:`SidesParams`.
    events : counts "flip" by camera: views whose left and right were exchanged.

    Yields
    ------
    Tables of views (:mod:`.views`) with the same frames in the same order. Left and right of
    mirrored views are exchanged. Links of views that are changed are unknown. People without an id
    stay as they are.
    """
    params = params or SidesParams()
    if not (params.over_time and knows_sides(model)):
        yield from (views_of([block]) for block in blocks)
        return
    decide = _Sides(model, params, events or Events())
    for block in blocks:
        yield from decide.take(block)
    yield from decide.rest()


@dataclass(frozen=True, slots=True, eq=False)
class _Piece:
    """Neighbouring frames of a block, and what their views show."""

    block: Block
    views: Stamps  # (N,) rows in the block's arrays, of people with an id who are not distorted
    owners: Stamps  # (N,) the frame of each view
    measured: MeasuredViews
    evidence: Floats  # (N, BINS), or (0, BINS) before they were weighed

    def cut(self, k: int) -> tuple[_Piece, _Piece]:
        """Return the first ``k`` frames, and the others."""
        n = int(np.searchsorted(self.owners, k))
        return self._part(slice(0, k), slice(0, n)), self._part(slice(k, None), slice(n, None))

    def _part(self, frames: slice, views: slice) -> _Piece:
        measured, owners = chosen(self.measured, views), self.owners[views] - (frames.start or 0)
        return _Piece(
            self.block.select(frames), self.views[views], owners, measured, self.evidence[views]
        )

    def logged_from(self, log_time: int) -> _Piece:
        """Return the same frames, logged at ``log_time``, ns, or later."""
        times = np.maximum(self.block.log_times, log_time)
        return replace(self, block=self.block.logged_at(times))


def _split(pieces: Sequence[_Piece], until: int) -> tuple[list[_Piece], list[_Piece]]:
    """Return the frames before the cell ``until``, and the others."""
    for k, piece in enumerate(pieces):
        late = piece.block.stamps // CELL >= until
        if late.any():
            n = int(late.argmax())
            first, kept = piece.cut(n)
            return [*pieces[:k], *([first] if n else [])], [kept, *pieces[k + 1 :]]
    return [*pieces], []


class _Sides:
    """Memory of people, and the frames that are not decided yet."""

    def __init__(self, model: SkeletonModel, params: SidesParams, events: Events) -> None:
        self._markers = FacingMarkers.of(model)
        self._ahead = round(params.lookahead * 1e9 / CELL)
        self._events = events
        self._bank = Bank(FacingPast.empty(), forget_after=10 + 2 * params.lookahead)
        self._tables = FacingTables.make()
        self._cameras = CameraNumbers()
        self._held: list[_Piece] = []
        self._decided = 0  # cell before which everything is decided; 0 = nothing was seen yet

    def take(self, block: Block) -> Iterator[Block]:
        """Take frames; yield those that are decided."""
        piece = self._piece(block)
        if not self._ahead:
            yield self._mirrored([piece], self._follow(piece))
            return
        while len(piece.block):
            cells = piece.block.stamps // CELL
            self._decided = self._decided or int(cells[0])
            due = cells >= self._decided + 2 * self._ahead
            if not due.any():
                self._held.append(piece)
                return
            last = int(due.argmax())
            first, piece = piece.cut(last + 1)
            self._held.append(first)
            yield from self._decide(int(cells[last]) - self._ahead)

    def rest(self) -> Iterator[Block]:
        """Yield the frames that are still held, now that nothing more comes."""
        if self._held:
            yield from self._decide(np.iinfo(np.int64).max)

    def _piece(self, block: Block) -> _Piece:
        """Find the views of a block, and whose they are."""
        views, owners = block.everybody()
        counts = block.people.ids[views] != UNTRACKED
        if block.doubts:
            counts &= ~block.doubts.distorted[views]
        views, owners = views[counts], owners[counts]
        measured = MeasuredViews.allocate(len(views))
        measured.stamps[:] = block.stamps[owners]
        measured.cells[:] = measured.stamps // CELL
        measured.cameras[:] = self._cameras.of(block)[owners]
        measured.rows[:] = self._bank.rows_of(block.people.ids[views], measured.stamps)
        return _Piece(block, views, owners, measured, np.empty((0, BINS)))

    # Decisions

    def _follow(self, piece: _Piece) -> facing.Facings:
        """Decide by the past alone."""
        from hiros_mcap.stages.detections.facing_live import follow

        out = facing.Facings.allocate(len(piece.views))
        people, past, work = piece.block.people, self._bank.past, np.empty(2 * BINS)
        follow(people, piece.views, self._markers, piece.measured, past, self._tables, work, out)
        return out

    def _decide(self, until: int) -> Iterator[Block]:
        """Decide on everything that is held; yield the frames before the cell ``until``."""
        self._add_evidence()
        held, self._held = self._held, []
        measured = joined([piece.measured for piece in held])
        out = facing.Facings.allocate(len(measured.cells))
        order = np.lexsort((measured.stamps, measured.rows))  # each person's views, by time
        ends = np.append(np.flatnonzero(np.diff(measured.rows[order], prepend=-1)), len(order))
        evidence = np.concatenate([piece.evidence for piece in held])
        work = facing.SmoothWork.of(int(np.diff(ends).max(initial=0)))
        past, tables = self._bank.past, self._tables
        facing.smooth(measured, order, ends, evidence, until, past, tables, work, out)
        out.toes[:] = self._tables.reliability(TOES)
        self._decided = until
        now = int(held[-1].block.log_times.max())
        done, self._held = _split(held, until)
        pieces = deque(piece.logged_from(now) for piece in done)
        del held, done
        yield from self._mirrored_blocks(pieces, out)

    def _add_evidence(self) -> None:
        """Measure the views that are new, learn from all of them, then weigh them."""
        new = [k for k, piece in enumerate(self._held) if len(piece.evidence) < len(piece.views)]
        if not new:
            return
        parts = [self._held[k] for k in new]
        for part in parts:
            people, past = part.block.people, self._bank.past
            measure(people, part.views, self._markers, part.measured, past, self._tables)
        measured = joined([part.measured for part in parts])
        evidence = np.empty((len(measured.cells), BINS))
        write_evidence(measured, self._bank.past, self._tables, evidence)
        ends = np.cumsum([len(part.views) for part in parts])
        for k, of_piece in zip(new, np.split(evidence, ends[:-1]), strict=True):
            self._held[k] = replace(self._held[k], evidence=of_piece)

    # The result

    def _mirrored_blocks(self, pieces: deque[_Piece], facings: facing.Facings) -> Iterator[Block]:
        """Yield all frames of the pieces. What was yielded lies in memory no longer."""
        first = 0
        while pieces:
            joined_pieces = [pieces.popleft()]
            while pieces and sum(len(piece.views) for piece in joined_pieces) < _MOST:
                joined_pieces.append(pieces.popleft())
            last = first + sum(len(piece.views) for piece in joined_pieces)
            block, first = self._mirrored(joined_pieces, chosen(facings, slice(first, last))), last
            del joined_pieces
            yield block
            del block

    def _mirrored(self, pieces: Sequence[_Piece], facings: facing.Facings) -> Block:
        """Return a table of views: sides of swapped ones are exchanged, and trunks turned.

        Several pieces become one table: later stages cost a call per block.
        """
        measured = joined([piece.measured for piece in pieces])
        swapped, turned = np.flatnonzero(facings.swapped), np.flatnonzero(facings.turns)
        block = views_of([piece.block for piece in pieces])
        shifts = block.rows[:, 0] - np.concatenate([piece.block.rows[:, 0] for piece in pieces])
        ends = np.cumsum([len(piece.block) for piece in pieces])
        parts = zip(pieces, np.split(shifts, ends[:-1]), strict=True)
        views = np.concatenate([piece.views + shift[piece.owners] for piece, shift in parts])
        directions = facings.facing[swapped]
        directions[facings.toes[swapped] >= _SLAVED] = np.nan
        axes = measured.axes
        facing.exchange_sides(
            block.people, views[swapped], directions, axes[swapped], self._markers
        )
        if block.doubts:
            variances = block.doubts.variances
            variances[views[swapped]] = variances[views[swapped]][:, self._markers.mirror]
        angles = facings.turns[turned]
        facing.turn_trunks(block.people, views[turned], angles, axes[turned], self._markers)
        by_camera = np.bincount(measured.cameras[swapped], minlength=len(self._cameras))
        for source, n in zip(self._cameras, by_camera.tolist(), strict=True):
            self._events.count("flip", source, n)
        return block
