"""Fuser: what all cameras measured of a joint becomes one smooth trajectory.

1. Messages are gathered to instants, and each view's sides are corrected, as in the merger.
2. Every measurement gets a variance: of its camera, joint and distance, larger for a guess.
3. Each joint has an asynchronous Kalman filter with a slow offset per camera, and a smoother that
   looks ahead (:mod:`hiros_mcap.stages.fuse.fusing`). Nothing is resampled.
4. The standard deviation of a marker is that of the smoother and of the cameras' poses together.
   It gives the confidence.

A log of any length is smoothed in overlapping windows. Link orientations are those of the merger.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping

from hiros_mcap.events import Events
from hiros_mcap.frames import Block
from hiros_mcap.skeletons import Floats, SkeletonModel
from hiros_mcap.stages.fuse.fuse_params import FuseParams
from hiros_mcap.stages.fuse.fusion_noise import FusionNoise, RunningNoise
from hiros_mcap.stages.fuse.pose_error import PoseError
from hiros_mcap.stages.fuse.residuals import ResidualMeter
from hiros_mcap.stages.fuse.sightings import SightingGatherer
from hiros_mcap.stages.fuse.window_smoother import WindowSmoother
from hiros_mcap.stages.merge.merge_params import MergeParams


def fuse_blocks(
    blocks: Iterable[Block], model: SkeletonModel, params: FuseParams | None = None,
    events: Events | None = None, *, merging: MergeParams | None = None, fixed_frame: str = "",
    cameras: Mapping[str, Floats] | None = None, noise: FusionNoise | None = None,
) -> Iterator[Block]:  # fmt: skip
    """Fuse the tracked skeletons of all cameras.

    Parameters
    ----------
    blocks : tracked frames in the fixed frame, roughly in time order.
    model, params : the skeleton; see :class:`FuseParams`.
    events : counts as :func:`hiros_mcap.stages.merge.merge.merge_blocks` does.
    merging : how instants are made and sides corrected.
    cameras : source -> (3,) position, m, as far as known.
    noise : of cameras and joints; None = the defaults.

    Yields
    ------
    One frame per instant, with positions, m, velocities, m/s, and their uncertainty. Each is logged
    when its window was complete.
    """
    events = Events() if events is None else events
    views = SightingGatherer(model, merging or MergeParams(), cameras)  # instants and sides
    params = params or FuseParams()
    noise = noise or noise_of(model, params)
    if params.follow_noise:
        noise = RunningNoise.of(noise)
    # variances, filters, smoother, confidences
    angle = math.radians(params.pose_angle)
    pose_error = PoseError(angle, params.pose_shift, cameras or {}, noise.to_given)
    smoother = WindowSmoother(model, params, noise, pose_error)
    causal = params.window == 0
    residuals = ResidualMeter(model, noise, events, causal=causal)

    for block, sightings, names in views.run(blocks, events, fixed_frame):
        residuals.expect(len(block), sightings, names)
        yield from residuals.compared(smoother.update(block, sightings, names))
    yield from residuals.compared(smoother.rest())
    residuals.finish()
    smoother.displaced.warn(events)


def noise_of(
    model: SkeletonModel, params: FuseParams, measured: FusionNoise | None = None
) -> FusionNoise:
    """Return what is assumed of cameras and joints, or ``measured``."""
    return measured or FusionNoise.default(
        model, params.acceleration, params.offset, params.offset_time
    )
