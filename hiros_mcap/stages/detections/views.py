"""The table of views: what cameras show of people, as the merger and the fuser take it.

It is a block of messages between the tracker and the merger. A view is a row of it; its columns are
those of People, and the :class:`~hiros_mcap.frames.Doubts`. Three steps write columns:

- plausible: by how much variances are larger, and which views are distorted;
- sides: left and right, and the turned trunk;
- hidden: by how much variances are larger, and where joints must be.

The tracker may still write ids into the arrays of its blocks. So the views are copied once, when
their sides are decided. From then on, the step that holds a table may write into it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hiros_mcap.frames import Block


def views_of(table: Block) -> Block:
    """Return the copy of tracked frames as a table of views, with doubts.

    Distorted views have no markers and no links in it.
    """
    people, doubts = table.people, table.doubt_columns()
    for array in people.markers, people.marker_confidences, people.links, people.link_confidences:
        array[doubts.distorted] = np.nan
    return replace(table, doubts=doubts)
