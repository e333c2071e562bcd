"""Which way a person faces, by the past alone: the forward pass of the model in ``facing.py``.

A module of its own, since only live input needs it: a run of a log need not compile it.
"""

from __future__ import annotations

from hiros_mcap.body.forward_cues import FacingMarkers
from hiros_mcap.kernels.array_types import F1, I1
from hiros_mcap.kernels.compile import entry, inlined
from hiros_mcap.skeletons import Floats, People
from hiros_mcap.stages.detections.facing import (
    Facings,
    decide,
    mean_direction,
    multiply,
    starts_anew,
    turn,
)
from hiros_mcap.stages.detections.facing_evidence import (
    BINS,
    TOES,
    FacingPast,
    FacingTables,
    MeasuredViews,
    measure_view,
    write_view_evidence,
)


@inlined
def _open_cell(
    measured: MeasuredViews, i: int, past: FacingPast, tables: FacingTables, work: Floats
) -> None:
    """Start a person's next cell, unless view ``i`` lies in the current one."""
    row, cell, start = measured.rows[i], measured.cells[i], measured.starts[i]
    anew = starts_anew(start, past, row)
    if not anew and cell <= past.cells[row]:
        return
    multiply(past.beliefs[row], past.evidence[row], work)
    turn(work, 0 if anew else cell - past.cells[row], tables, past.beliefs[row])
    past.cells[row], past.belief_starts[row] = max(cell, past.cells[row]), start
    past.evidence[row, :] = 0.0


@entry
def follow(
    people: People, views: I1, markers: FacingMarkers, measured: MeasuredViews, past: FacingPast,
    tables: FacingTables, work: F1, out: Facings,
) -> None:  # fmt: skip
    """Measure and decide on one view after the other, by the past alone: the forward pass.

    Parameters
    ----------
    people, views, markers, measured : as in facing_evidence.measure; views of anybody, in order.
    past : brought to the last view.
    work : (2 * BINS,) scratch.
    """
    here, belief = work[:BINS], work[BINS:]
    for i in range(len(views)):
        row = measured.rows[i]
        measure_view(people, views[i], markers, measured, i, past, tables)
        _open_cell(measured, i, past, tables, here)
        write_view_evidence(measured, i, past, tables, here)
        for b in range(BINS):
            past.evidence[row, b] += here[b]
        multiply(past.beliefs[row], past.evidence[row], belief)
        mean_direction(belief, tables, out.facing[i])
        decide(measured, i, past, tables, out)
        out.toes[i] = tables.agreement[TOES, 0] / tables.agreement[TOES, 1]
