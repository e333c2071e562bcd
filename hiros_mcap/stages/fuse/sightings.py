"""What every camera saw of every person, gathered to instants.

Who is there at an instant, and how the links are oriented, is decided as in the merger.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from hiros_mcap.events import Events
from hiros_mcap.frames import Block, places_of
from hiros_mcap.kernels.array_types import chosen, joined
from hiros_mcap.kernels.averaging import Buffers
from hiros_mcap.skeletons import Floats, Ints, People, SkeletonModel, Stamps
from hiros_mcap.stages.fuse import fusing
from hiros_mcap.stages.fuse.fusing import Sightings
from hiros_mcap.stages.merge.instants import InstantMerger
from hiros_mcap.stages.merge.merge import ViewMerger
from hiros_mcap.stages.merge.merge_params import MergeParams
from hiros_mcap.stages.merge.unseen import Unseen


class SightingGatherer:
    """Instants, and what the cameras saw at them."""

    def __init__(
        self, model: SkeletonModel, params: MergeParams, cameras: Mapping[str, Floats] | None = None
    ) -> None:
        self._model, self._params = model, params
        self._cameras = cameras or {}
        self._merge = ViewMerger(model, params, only_orientations=True)
        self._gathered: list[Sightings] = []
        self._n_instants = 0

    def run(
        self, blocks: Iterable[Block], events: Events, fixed_frame: str = ""
    ) -> Iterator[tuple[Block, Sightings, tuple[str, ...]]]:
        """Yield merged people, the views of each instant (numbered in the block), the cameras."""

        def gather(*given: Any) -> None:
            self._gather(merger.cameras, *given)

        merger = InstantMerger(
            self._model, gather, self._merge.bank, events, fixed_frame, ("outlier", "flip"),
            Unseen(self._params.bridge, self._params.carry, self._cameras), self._merge.widths,
        )  # fmt: skip
        for block in merger.run(blocks, self._params.cameras, self._params.max_delta_time):
            gathered, self._gathered, self._n_instants = self._gathered, [], 0
            yield block, joined(gathered), merger.cameras

    def _gather(
        self, names: Sequence[str], buffers: Buffers, people: People, views: int, out: People,
        counts: Stamps,
    ) -> None:  # fmt: skip
        """Merge links; keep what each camera saw. A ``MergeKernel`` of instants."""
        self._merge(buffers, people, views, out, counts)
        n, m = int((buffers.messages[:, 1] - buffers.messages[:, 0]).sum()), self._model.n_markers
        some = Sightings.allocate(n, m)
        places = places_of(names, self._cameras)
        n = fusing.gather_sightings(buffers, people, out.ids, self._merge.flipped, places, some)
        some = chosen(some, slice(n))
        self._gathered.append(some._replace(instants=some.instants + self._n_instants))
        self._n_instants += len(buffers.stamps)


def rows_of(views: Sightings, instants: Stamps, people: Ints) -> Stamps:
    """(N,) Row of each view's person and instant among ``instants`` and ``people``; -1 = none."""
    if not len(people):
        return np.full(len(views.people), -1)
    keys = _key(instants, people)
    order = np.argsort(keys)
    wanted = _key(views.instants, views.people)
    rows = order[np.minimum(np.searchsorted(keys, wanted, sorter=order), len(keys) - 1)]
    return np.where(keys[rows] == wanted, rows, -1)


def _key(instants: Stamps, people: Stamps | Ints) -> Stamps:
    """One number for an instant and a person, whose id has 32 bits."""
    return instants * (1 << 32) + people
