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
from hiros_mcap.frames import Block, places_of
from hiros_mcap.kernels.array_types import B1, F2, J1, chosen, joined
from hiros_mcap.kernels.averaging import BEGIN, CAMERA, END, TIME, Buffers
from hiros_mcap.kernels.compile import entry, kernel
from hiros_mcap.kernels.points import mean_position, norm3
from hiros_mcap.skeletons import Floats, People, SkeletonModel, Stamps
from hiros_mcap.stages.fuse.fuse_params import FuseParams
from hiros_mcap.stages.fuse.fusing import REFERENCE, Sightings
from hiros_mcap.stages.fuse.fusion_noise import FusionNoise, RunningNoise
from hiros_mcap.stages.fuse.pose_error import PoseError
from hiros_mcap.stages.fuse.residuals import ResidualMeter
from hiros_mcap.stages.fuse.window_smoother import WindowSmoother
from hiros_mcap.stages.known_cameras import KnownCameras
from hiros_mcap.stages.merge.instants import InstantMerger
from hiros_mcap.stages.merge.merge import ViewMerger
from hiros_mcap.stages.merge.merge_params import MergeParams
from hiros_mcap.stages.merge.unseen import Unseen

_NEAREST = 0.3  # m; noise is not assumed to fall any further nearer to a camera


def fuse_blocks(
    blocks: Iterable[Block], model: SkeletonModel, params: FuseParams | None = None,
    events: Events | None = None, *, merging: MergeParams | None = None, fixed_frame: str = "",
    known: KnownCameras | None = None, noise: FusionNoise | None = None,
) -> Iterator[Block]:  # fmt: skip
    """Fuse the tracked skeletons of all cameras.

    Parameters
    ----------
    blocks : tracked frames in the fixed frame, roughly in time order.
    model, params : the skeleton; see :class:`FuseParams`.
    events : counts as :func:`hiros_mcap.stages.merge.merge.merge_blocks` does.
    merging : how instants are made and sides corrected.
    known : of the cameras. noise : of cameras and joints; None = the defaults.

    Yields
    ------
    One frame per instant, with positions, m, velocities, m/s, and their uncertainty. Each is logged
    when its window was complete.
    """
    events = Events() if events is None else events
    params = params or FuseParams()
    known = known or KnownCameras()
    noise = noise or noise_of(model, params)
    if params.follow_noise:
        noise = RunningNoise.of(noise)
    # variances, filters, smoother, confidences
    angle = math.radians(params.pose_angle)
    pose_error = PoseError(angle, params.pose_shift, known.places, known.to_given, known.errors)
    smoother = WindowSmoother(model, params, noise, known, pose_error)
    residuals = ResidualMeter(noise, known.errors, events, causal=params.window == 0)

    merging = merging or MergeParams()
    gathered = merged_sightings(blocks, model, merging, events, known.places, fixed_frame)
    for block, sightings, names in gathered:  # instants and sides
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


def merged_sightings(
    blocks: Iterable[Block], model: SkeletonModel, params: MergeParams, events: Events,
    cameras: Mapping[str, Floats], fixed_frame: str,
) -> Iterator[tuple[Block, Sightings, tuple[str, ...]]]:  # fmt: skip
    """Yield merged people, the views of each instant (numbered in the block), the cameras.

    The parameters are those of :func:`fuse_blocks`.
    """
    merge_links = ViewMerger(model, params, only_orientations=True)
    parts: list[Sightings] = []
    instants = 0

    def merge(buffers: Buffers, people: People, views: int, out: People, counts: Stamps) -> None:
        """Merge links; keep what each camera saw. A ``MergeKernel`` of instants."""
        nonlocal instants
        merge_links(buffers, people, views, out, counts)
        most = int((buffers.messages[:, 1] - buffers.messages[:, 0]).sum())
        part = Sightings.allocate(most, model.n_markers)
        places = places_of(merger.cameras, cameras)
        n = gather_sightings(buffers, people, out.ids, merge_links.flipped, places, part)
        part = chosen(part, slice(n))
        parts.append(part._replace(instants=part.instants + instants))
        instants += len(buffers.stamps)

    merger = InstantMerger(
        model, merge, merge_links.bank, events, fixed_frame, ("outlier", "flip"),
        Unseen(params.bridge, params.carry, cameras), merge_links.widths,
    )  # fmt: skip
    for block in merger.run(blocks, params.cameras, params.max_delta_time, in_step=params.in_step):
        sightings, instants = joined(parts), 0
        parts.clear()
        yield block, sightings, merger.cameras


@kernel
def _distance(positions: Floats, place: Floats) -> float:
    """Distance, m, of the mean of the positions (M, 3) that are known from a camera's place."""
    x, y, z = mean_position(positions)
    away = norm3(x - place[0], y - place[1], z - place[2])
    return REFERENCE if math.isnan(away) else max(away, _NEAREST)


@entry
def gather_sightings(
    buffers: Buffers, people: People, ids: J1, flipped: B1, places: F2, out: Sightings
) -> int:
    """Write what the messages of buffers show of the people to be merged; return how many views.

    Parameters
    ----------
    ids : (P,) whom the buffers merge. flipped : rows of ``people`` that are left out.
    places : (C, 3) position of each camera, m; NaN = unknown. out : has room for all.
    """
    n = 0
    for q in range(len(buffers.stamps)):
        for k in range(buffers.message_ends[q], buffers.message_ends[q + 1]):
            for i in range(buffers.messages[k, BEGIN], buffers.messages[k, END]):
                wanted = False
                for p in range(buffers.people_ends[q], buffers.people_ends[q + 1]):
                    wanted = wanted or ids[p] == people.ids[i]
                if not wanted or flipped[i]:
                    continue
                out.instants[n] = q
                out.people[n] = people.ids[i]
                out.cameras[n] = buffers.messages[k, CAMERA]
                out.stamps[n] = buffers.messages[k, TIME]
                for m in range(people.markers.shape[1]):
                    given = people.marker_confidences[i, m]
                    out.confidences[n, m] = people.confidences[i] if math.isnan(given) else given
                    out.hidden[n, m] = buffers.hidden[i, m]
                    for c in range(3):
                        out.positions[n, m, c] = people.markers[i, m, c]
                out.distances[n] = _distance(out.positions[n], places[out.cameras[n]])
                n += 1
    return n
