"""Fuser: what all cameras measured of a joint becomes one smooth trajectory.

1. Messages are gathered to instants, and each view's sides are corrected, as in the merger.
2. Every measurement gets a variance: of its camera, joint and distance, larger for a guess.
3. Each joint has an asynchronous Kalman filter with a slow offset per camera, and a smoother that
   looks ahead (:mod:`hiros_mcap.kernels.fusing`). Nothing is resampled.
4. The standard deviation of a marker is that of the smoother and of the cameras' poses together.
   It gives the confidence.

A log of any length is smoothed in overlapping windows. Link orientations are those of the merger.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

from pydantic import Field

from hiros_mcap.body.rotations import Rigid
from hiros_mcap.events import Events
from hiros_mcap.frames import Block
from hiros_mcap.params import Params, advanced
from hiros_mcap.skeletons import Floats, SkeletonModel
from hiros_mcap.stages.merge import MergeParams

if TYPE_CHECKING:
    from hiros_mcap.stages.fusion_noise import FusionNoise


class FuseParams(Params):
    """Parameters of the fuser."""

    lookahead: float = Field(
        3.0,
        ge=0,
        description="How far into the future each estimate looks at least, s. A camera's offset "
        "wanders over some seconds, so less is worse. 0.1 costs about 1 % of accuracy.",
    )
    window: float = advanced(
        10.0,
        ge=0,
        description="Seconds that are smoothed at once. Results do not depend on it as long as the "
        "look-ahead is long; 0 = every instant as soon as it has its look-ahead.",
    )
    max_lag: float = Field(
        math.inf,
        gt=0,
        description="Longest time, s, from the cameras' mean time to the result's log time. A "
        "result that would be later if it waited for the cameras' next messages has less "
        "look-ahead.",
    )
    follow_noise: bool = advanced(
        False,
        description="Learn on the way which cameras are noisier than others.",
    )
    acceleration: float = advanced(
        3.0,
        gt=0,
        description="Spectral density of the acceleration of a joint at rest, m2/s3. Joints that "
        "move faster have 10 or 100 times as much, as their measurements show. 3 to 10 differ by "
        "less than 1 % on simulated logs.",
    )
    offset: float = advanced(
        0.01,
        ge=0,
        description="Standard deviation of the slow offset of a camera, per joint, m. 0 = cameras "
        "have none; then the error is larger and its estimate far too small.",
    )
    offset_time: float = advanced(
        1.7, gt=0, description="Time constant, s, with which such an offset wanders."
    )
    freedom: float = advanced(
        4.0,
        gt=0,
        description="Degrees of freedom of the noise (Student's t). With fewer, outliers count "
        "less. 4 to 20 differ by 0 to 4 %.",
    )
    pose_angle: float = advanced(
        0.3,
        ge=0,
        description="Standard deviation of a camera's orientation, degrees, assumed until cameras "
        "show how far they disagree. It and pose_shift enter the standard deviation of the result "
        "only.",
    )
    pose_shift: float = advanced(
        0.006, ge=0, description="Standard deviation of a camera's position along each axis, m."
    )


def fuse_blocks(
    blocks: Iterable[Block],
    model: SkeletonModel,
    params: FuseParams | None = None,
    events: Events | None = None,
    *,
    merging: MergeParams | None = None,
    fixed_frame: str = "",
    cameras: Mapping[str, Floats] | None = None,
    noise: FusionNoise | None = None,
) -> Iterator[Block]:
    """Fuse the tracked skeletons of all cameras.

    Parameters
    ----------
    blocks : tracked frames in the fixed frame, roughly in time order.
    model, params : the skeleton; see :class:`FuseParams`.
    events : counts as :func:`hiros_mcap.stages.merge.merge_blocks` does.
    merging : how instants are made and sides corrected.
    cameras : source -> (3,) position, m, as far as known.
    noise : of cameras and joints; None = the defaults.

    Yields
    ------
    One frame per instant, with positions, m, velocities, m/s, and their uncertainty. Each is logged
    when its window was complete.
    """
    from hiros_mcap.stages.pose_error import PoseError
    from hiros_mcap.stages.residuals import ResidualMeter
    from hiros_mcap.stages.sightings import SightingGatherer
    from hiros_mcap.stages.window_smoother import WindowSmoother, WindowTimes

    events = Events() if events is None else events
    views = SightingGatherer(model, merging or MergeParams(), cameras)  # instants and sides
    params = params or FuseParams()
    noise = noise or noise_of(model, params)
    if params.follow_noise:
        from hiros_mcap.stages.running_noise import RunningNoise

        noise = RunningNoise.of(noise)
    # variances, filters, smoother, confidences
    waiting = WindowTimes(params.window, params.lookahead, params.max_lag)
    angle = math.radians(params.pose_angle)
    pose_error = PoseError(angle, params.pose_shift, cameras or {}, noise.to_given)
    smoother = WindowSmoother(model, waiting, noise, params.freedom, pose_error, cameras or {})
    causal = params.window == 0
    residuals = ResidualMeter(model, noise, cameras or {}, events, causal=causal)
    for block, sightings, names in views.run(blocks, events, fixed_frame):
        residuals.expect(len(block), sightings, names)
        for fused in smoother.update(block, sightings, names):
            residuals.compare(fused)
            yield residuals.scaled(fused)
    for fused in smoother.rest():
        residuals.compare(fused)
        yield residuals.scaled(fused)
    residuals.finish()
    smoother.displaced.tell(events)


def noise_of(
    model: SkeletonModel,
    params: FuseParams,
    measured: FusionNoise | None = None,
    to_given: Mapping[str, Rigid] | None = None,
) -> FusionNoise:
    """Return what is assumed of cameras and joints, or ``measured``, and how poses were refined."""
    from hiros_mcap.stages.fusion_noise import FusionNoise

    noise = measured or FusionNoise.default(
        model, params.acceleration, params.offset, params.offset_time
    )
    return replace(noise, to_given=to_given or {})
