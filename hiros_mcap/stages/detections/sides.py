"""Left and right, decided over time: views of a person are brought to their right sides.

Detectors mirror people, some whenever these turn their backs. A vote of the cameras cannot mend
that where most of them are wrong. So the facing of each person is the state of a hidden Markov
model (facing.py). It is measured across the trunk, in axes that are carried along with the
body (body_axes.py), so people may lie, crawl, roll and spin. Every view tells of it:

- the line through shoulders and hips: the facing is at a right angle to it;
- the labels left and right: which of the two sides of the line is in front;
- physical cues, whatever the labels are: head, elbows, knees, toes (body.forward_cues).

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

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from hiros_mcap.body.forward_cues import FacingMarkers
from hiros_mcap.events import Events
from hiros_mcap.frames import Block, CameraNumbers, join
from hiros_mcap.kernels.array_types import chosen, joined
from hiros_mcap.skeletons import UNTRACKED, SkeletonModel, Stamps
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
from hiros_mcap.stages.look_ahead import LookAhead

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
        yield from (views_of(join([block])) for block in blocks)
        return
    decide = _Sides(model, params, events or Events())
    for block in blocks:
        yield from decide.take(block)
    yield from decide.rest()


class _Sides:
    """Memory of people, and the frames that are not decided yet."""

    def __init__(self, model: SkeletonModel, params: SidesParams, events: Events) -> None:
        self._markers = FacingMarkers.of(model)
        self._ahead = round(params.lookahead * 1e9 / CELL)
        self._events = events
        self._bank = Bank(FacingPast.empty(), forget_after=10 + 2 * params.lookahead)
        self._tables = FacingTables.make()
        self._cameras = CameraNumbers()
        self._waiting, self._log_time = LookAhead(), 0
        self._new: list[tuple[Block, Stamps, MeasuredViews]] = []
        """Frames that were not measured yet, and their views."""
        self._measured, self._evidence = MeasuredViews.allocate(0), np.empty((0, BINS))
        """Of the N views that wait; evidence (N, BINS)."""
        self._frames = np.empty(0, np.int64)
        """(N,) number of the frame of each view that waits, counted through all frames."""
        self._decided = 0  # cell before which everything is decided; 0 = nothing was seen yet

    def take(self, block: Block) -> Iterator[Block]:
        """Take frames; yield those that are decided."""
        if not self._ahead:
            yield self._follow(block)
            return
        while len(block):
            cells = block.stamps // CELL
            self._decided = self._decided or int(cells[0])
            due = cells >= self._decided + 2 * self._ahead
            if not due.any():
                self._hold(block)
                return
            last = int(due.argmax())
            self._hold(block.select(slice(last + 1)))
            block = block.select(slice(last + 1, None))
            yield from self._decide(int(cells[last]) - self._ahead)

    def rest(self) -> Iterator[Block]:
        """Yield the frames that are still held, now that nothing more comes."""
        if len(self._waiting):
            yield from self._decide(np.iinfo(np.int64).max)

    def _hold(self, block: Block) -> None:
        """Let frames wait."""
        views, frames = _views_in(block)
        first = self._waiting.first + len(self._waiting)
        self._frames = np.concatenate([self._frames, first + frames])
        self._new.append((block, views, self._unmeasured(block, views, frames)))
        self._waiting.add(block)
        self._log_time = int(block.log_times.max())

    def _unmeasured(self, block: Block, views: Stamps, frames: Stamps) -> MeasuredViews:
        """Note whose the views of a block are, and when."""
        measured = MeasuredViews.allocate(len(views))
        measured.stamps[:] = block.stamps[frames]
        measured.cells[:] = measured.stamps // CELL
        measured.cameras[:] = self._cameras.of(block)[frames]
        measured.rows[:] = self._bank.rows_of(block.people.ids[views], measured.stamps)
        return measured

    # Decisions

    def _follow(self, block: Block) -> Block:
        """Decide by the past alone."""
        from hiros_mcap.stages.detections.facing_live import follow

        views, frames = _views_in(block)
        measured = self._unmeasured(block, views, frames)
        people, past, work = block.people, self._bank.past, np.empty(2 * BINS)
        out = facing.Facings.allocate(len(views))
        follow(people, views, self._markers, measured, past, self._tables, work, out)
        return self._mended(join([block]), measured, out)

    def _decide(self, until: int) -> Iterator[Block]:
        """Decide on all views that wait; yield the frames before the cell ``until``."""
        self._weigh()
        measured = self._measured
        out = facing.Facings.allocate(len(measured.cells))
        order = np.lexsort((measured.stamps, measured.rows))  # each person's views, by time
        ends = np.append(np.flatnonzero(np.diff(measured.rows[order], prepend=-1)), len(order))
        work = facing.SmoothWork.of(int(np.diff(ends).max(initial=0)))
        past, tables = self._bank.past, self._tables
        facing.smooth(measured, order, ends, self._evidence, until, past, tables, work, out)
        out.toes[:] = self._tables.reliability(TOES)
        self._decided = until
        late = self._waiting.stamps // CELL >= until
        yield from self._released(int(late.argmax()) if late.any() else len(late), out)

    def _weigh(self) -> None:
        """Measure the views that are new, learn from all of them, then weigh them."""
        for block, views, part in self._new:
            past = self._bank.past
            measure(block.people, views, self._markers, part, past, self._tables)
        measured = joined([MeasuredViews.allocate(0), *[part for *_, part in self._new]])
        evidence = np.empty((len(measured.cells), BINS))
        write_evidence(measured, self._bank.past, self._tables, evidence)
        self._measured = joined([self._measured, measured])
        self._evidence = np.concatenate([self._evidence, evidence])
        self._new = []

    # The result

    def _released(self, n: int, facings: facing.Facings) -> Iterator[Block]:
        """Yield the oldest ``n`` frames with what was decided on all views that wait.

        Neighbours become one table, since later stages cost a call per block.
        """
        while n:
            numbers = self._waiting.first + np.arange(1, n + 1)
            ends = np.searchsorted(self._frames, numbers)  # the views up to each frame
            frames = min(int(np.searchsorted(ends, _MOST)) + 1, n)
            n, done, left = n - frames, slice(ends[frames - 1]), slice(ends[frames - 1], None)
            measured, decided = chosen(self._measured, done), chosen(facings, done)
            self._measured, facings = chosen(self._measured, left), chosen(facings, left)
            self._evidence, self._frames = self._evidence[left], self._frames[left]
            yield self._mended(self._waiting.release(frames), measured, decided, self._log_time)

    def _mended(
        self, block: Block, measured: MeasuredViews, facings: facing.Facings, log_time: int = 0
    ) -> Block:
        """Make a table of views of a copy: sides are exchanged, and trunks turned.

        Its frames are logged at ``log_time``, ns, or later.
        """
        block = views_of(block.logged_at(np.maximum(block.log_times, log_time)))
        views, _ = _views_in(block)
        swapped, turned = np.flatnonzero(facings.swapped), np.flatnonzero(facings.turns)
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


def views_of(table: Block) -> Block:
    """Return the copy of tracked frames as a table of views, with doubts.

    The tracker may still write ids into the arrays of its blocks. From the copy on, the step that
    holds a table may write into it. Distorted views have no markers and no links in it.
    """
    people, doubts = table.people, table.doubt_columns()
    for array in people.markers, people.marker_confidences, people.links, people.link_confidences:
        array[doubts.distorted] = np.nan
    return replace(table, doubts=doubts)


def _views_in(block: Block) -> tuple[Stamps, Stamps]:
    """(N,) rows and (N,) frames of the views of people with an id that are not distorted."""
    views, frames = block.everybody()
    counts = block.people.ids[views] != UNTRACKED
    if block.doubts:
        counts &= ~block.doubts.distorted[views]
    return views[counts], frames[counts]
