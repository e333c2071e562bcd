"""The channel that says how well each marker of a result is known."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping
from functools import lru_cache
from pathlib import Path

import numpy as np

from hiros_mcap.frames import Block
from hiros_mcap.io.channels import OUTPUT_PREFIX
from hiros_mcap.io.container import McapReader
from hiros_mcap.io.ros_cdr import HEADER, TIME_SIZE, CdrWriter
from hiros_mcap.io.ros_messages import open_messages
from hiros_mcap.skeletons import Frame, SkeletonModel

UNCERTAINTY_TOPIC = f"{OUTPUT_PREFIX}/uncertainty"
UNCERTAIN_TOPIC = f"{OUTPUT_PREFIX}/filtered"
"""The channel whose markers it tells of."""
_CAMERAS = (1 << 32) - 1

Deviations = Mapping[tuple[int, int], Mapping[int, float]]
"""(Stamp in ns, person) -> marker id -> standard deviation along each axis, m."""


def uncertainty_messages(block: Block, model: SkeletonModel) -> Iterator[bytes]:
    """Yield a SkeletonGroupUncertainty in CDR for each frame; of nobody without an uncertainty."""
    uncertainty, n = block.uncertainty, model.n_markers
    names = uncertainty.names if uncertainty else ()
    people = np.full((len(block.people.ids), 3 + 2 * n), n, "<u4")  # id, n, deviations, n, cameras
    people[:, 0] = block.people.ids.astype("<i4").view("<u4")
    if uncertainty:
        people[:, 2 : 2 + n] = uncertainty.deviations.astype("<f4").view("<u4")
        people[:, 3 + n :] = uncertainty.cameras & _CAMERAS
    rows = block.rows.tolist() if uncertainty else [(0, 0)] * len(block)
    frames = zip(block.stamps.tolist(), block.frame_ids.tolist(), rows, strict=True)
    for stamp, frame_id, (begin, end) in frames:
        out = CdrWriter()
        out.time(stamp)
        out.raw(_head(block.names[frame_id], names, model.marker_ids))
        out.uint32(end - begin)
        out.raw(people[begin:end].tobytes())
        yield out.finish()


@lru_cache(maxsize=8)
def _head(frame_id: str, names: tuple[str, ...], markers: tuple[int, ...]) -> bytes:
    """Bytes between the time and the people: those of all messages of a log."""
    out = CdrWriter()
    out.header(0, frame_id)
    out.strings(names)
    out.uint32(len(markers))
    out.int32(*markers)
    return out.finish()[len(HEADER) + TIME_SIZE :]


def deviations_of(frames: Iterable[Frame], model: SkeletonModel) -> Deviations:
    """Return the standard deviations that the frames of a stage carry."""
    return {
        (frame.stamp, person): dict(zip(model.marker_ids, row, strict=True))
        for frame in frames
        if frame.uncertainty is not None
        for person, row in zip(
            frame.ids.tolist(), frame.uncertainty.deviations.tolist(), strict=True
        )
    }


def read_uncertainty(source: str | os.PathLike[str] | McapReader) -> Deviations:
    """Read the standard deviations of a result; empty if it states none.

    Raises LogError if the log cannot be read.
    """
    by_marker: dict[tuple[int, int], Mapping[int, float]] = {}
    log = source if isinstance(source, McapReader) else Path(source)
    with open_messages(log) as messages:
        if UNCERTAINTY_TOPIC not in messages.types:
            return by_marker
        for message in messages.read({UNCERTAINTY_TOPIC}):
            group = messages.decode(message)
            time, markers = group.header.stamp, np.asarray(group.markers).tolist()
            stamp = time.sec * 1_000_000_000 + time.nanosec
            for person in group.skeletons:
                deviations = np.asarray(person.deviations, np.float64).tolist()
                by_marker[stamp, person.id] = dict(zip(markers, deviations, strict=False))
    return by_marker
