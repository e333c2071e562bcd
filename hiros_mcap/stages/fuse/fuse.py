"""Fuser: what all cameras measured of a joint becomes one smooth trajectory.

1. Views of the same time are gathered (:mod:`.gathering`): one instant has at most one message of
   each camera. Link orientations are their robust mean.
2. Every measurement z of a joint gets a variance: of its camera, joint and distance, larger for a
   guess and for a joint that is hidden (:mod:`.fusion_noise`). Of three cameras or more, most are
   right: a camera that is outvoted about a joint has no weight there (:mod:`.majority`).
3. Each joint has a filter with a slow offset b per camera, and a smoother that looks ahead
   (:mod:`.fusing`): x' = x + v dt; z = x + b + noise. Nothing is resampled. A camera that puts a
   limb to a wrong place counts little there until it agrees again (:mod:`.outliers`).
4. The mean residual z - x of a view tells a camera that is not where its pose says: it is named,
   and without a look-ahead it has no weight from then on (:mod:`.window_smoother`,
   :mod:`.displaced_views`).
5. Residuals say how much noise to assume from now on (:mod:`.residuals`).
6. The variance of a marker is that of the smoother and of the cameras' poses (:mod:`.pose_error`).

A log of any length is smoothed in overlapping windows. Bodies get their lengths, and poses that
they can have, in the next stage (:mod:`.constrain`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator

from hiros_mcap.body.symmetry import symmetry_of
from hiros_mcap.events import Events
from hiros_mcap.frames import Block
from hiros_mcap.skeletons import SkeletonModel
from hiros_mcap.stages.fuse.fuse_params import FuseParams
from hiros_mcap.stages.fuse.fusion_noise import FusionNoise
from hiros_mcap.stages.fuse.gathering import WIDTHS, ViewGatherer
from hiros_mcap.stages.fuse.pose_error import PoseError
from hiros_mcap.stages.fuse.residuals import ResidualMeter
from hiros_mcap.stages.fuse.window_smoother import WindowSmoother
from hiros_mcap.stages.known_cameras import KnownCameras
from hiros_mcap.stages.merge.instants import InstantMerger
from hiros_mcap.stages.merge.merge_params import MergeParams
from hiros_mcap.stages.merge.unseen import Unseen


def fuse_blocks(
    blocks: Iterable[Block], model: SkeletonModel, params: FuseParams | None = None,
    events: Events | None = None, *, merging: MergeParams | None = None, fixed_frame: str = "",
    known: KnownCameras | None = None,
) -> Iterator[Block]:  # fmt: skip
    """Fuse the tracked skeletons of all cameras.

    Parameters
    ----------
    blocks : tracked frames in the fixed frame, roughly in time order.
    model, params : the skeleton; see :class:`FuseParams`.
    events : counts as :func:`hiros_mcap.stages.merge.merge.merge_blocks` does.
    merging : how instants are made and sides corrected. fixed_frame : name of the fixed frame.
    known : where the cameras stand, and how well that is known.

    Yields
    ------
    One frame per instant, with positions, m, velocities, m/s, and their uncertainty. Each is logged
    when its window was complete.
    """
    events, params = events or Events(), params or FuseParams()
    merging, known = merging or MergeParams(), known or KnownCameras()
    noise = FusionNoise.default(model, params.acceleration, params.offset, params.offset_time)
    pose_error = PoseError(math.radians(params.pose_angle), params.pose_shift, known)
    gatherer = ViewGatherer(model, merging)
    instants = InstantMerger(
        model, gatherer, gatherer.bank, events, fixed_frame,
        unseen=Unseen(merging.bridge, merging.carry, known.places), widths=WIDTHS,
    )  # fmt: skip
    smoother = WindowSmoother(model, params, noise, known, pose_error)
    mirror = symmetry_of(model).mirror
    residuals = ResidualMeter(noise, events, mirror, causal=params.window == 0)

    times = merging.cameras, merging.max_delta_time
    for block in instants.run(blocks, *times, in_step=merging.in_step):  # 1
        views = gatherer.take(instants.cameras, known.places)
        smoothed = smoother.update(block, views, instants.cameras)  # 2, 3, 4, 6
        yield from residuals.compared(smoothed)  # 5
    yield from residuals.compared(smoother.rest())
    residuals.finish()
    smoother.displaced.warn(events)
