"""Link orientations that agree with the bones, as far as the markers are surer.

Every detector has link axes of its own, and a link's orientation may be that of the bone before or
after it. So the direction in which a bone lies in a link's frame is measured: its mean over the
person's poses so far. The bone that lies most steadily turns with the link.

Where the fused bone deviates from that direction, either is wrong. The deviation has the variance
of the orientation and of the bone's direction together; the latter is known from the markers'. The
link turns by the rest, along the shortest way (Wiener's estimate). Markers stay where they are.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from hiros_mcap.frames import Block
from hiros_mcap.skeletons import UNTRACKED, Floats, Ints, SkeletonModel
from hiros_mcap.stages.bank import Bank
from hiros_mcap.stages.fuse import aligning
from hiros_mcap.stages.fuse.aligning import LinkPast
from hiros_mcap.stages.fuse.constrain import UNKNOWN_DEVIATION, unshared_variances

_FORGET = 10.0  # s
_CAREFUL = 1.2  # times the variance; to turn a link too far costs more than not far enough


def align_blocks(blocks: Iterable[Block], model: SkeletonModel) -> Iterator[Block]:
    """Turn the links of everybody; each pose is corrected by those before it.

    Parameters
    ----------
    blocks : with positions, m, and link orientations; the uncertainty of markers is used if known.
    model : the skeleton.

    Yields
    ------
    The same frames with other link orientations, at the same times.
    """
    bones = candidates(model)
    shape = model.n_links, bones.shape[1], 4
    bank = Bank(LinkPast(np.zeros((0, *shape))), _FORGET)
    for block in blocks:
        rows = np.full(len(block.people.ids), -1, np.int64)
        for stamp, (begin, end) in zip(block.stamps.tolist(), block.rows.tolist(), strict=True):
            bank.expire(stamp)
            for row in range(begin, end):
                person = int(block.people.ids[row])
                if person != UNTRACKED:
                    rows[row] = bank.row(person, stamp)
        people = block.people._replace(links=block.people.links.copy())
        aligning.align_links(people, rows, _variances(block), bones, bank.past)
        yield replace(block, people=people)
        del block, people  # else they lie in memory until the next block is made


def candidates(model: SkeletonModel) -> Ints:
    """(L, C, 2) Slots of the ends of the bones that may turn with each link; -1 = none.

    Its own first, then those that end where it begins and those that begin where it ends.
    """
    links = [tuple(ends) for ends in model.links.tolist()]
    bones_of_links = []
    for parent, child in links:
        before = [ends for ends in links if ends[1] == parent >= 0]
        after = [ends for ends in links if ends[0] == child >= 0]
        bones_of_links.append([(parent, child), *before, *after])
    most = max(map(len, bones_of_links), default=1)
    rows = [
        ends_of_link + [(-1, -1)] * (most - len(ends_of_link)) for ends_of_link in bones_of_links
    ]
    return np.array(rows, np.int32).reshape(len(links), most, 2)


def _variances(block: Block) -> Floats:
    """(P, M) Variance of each marker across a bone, m2: known lengths reduce that along it only."""
    if block.uncertainty is None:
        return _CAREFUL * unshared_variances(block)
    return _CAREFUL * np.nan_to_num(block.uncertainty.deviations, nan=UNKNOWN_DEVIATION) ** 2
