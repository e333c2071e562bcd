"""Our own system and the published ones, each a table of stages.

Ours follow Hi-ROS (Guidolin et al. 2023): tracker, merger, optimizer, filter. The published ones
are Malaguti et al. (2019) with its baselines, and Lee et al. (2022). Malaguti's paper associates by
centroids (III-A); its baselines do so, too. Lee's follows one person with cameras that a wire
synchronises. Here the tracker of Hi-ROS comes first, and each person is merged as the paper's one
person. Its variants A1 to A5 (section 3.1) are the same stages with other parameters
(``systems/presets``).

Packages bring others by an entry point of the group ``hiros.systems``, which names a
:class:`System`; docs/own-system.md shows one.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from functools import cache, partial
from typing import Any

from hiros_mcap import plugins
from hiros_mcap.body.limb_table import LimbTable
from hiros_mcap.config import PRESETS, Config
from hiros_mcap.defaults import DEFAULT_SYSTEM
from hiros_mcap.errors import ConfigError
from hiros_mcap.events import Events
from hiros_mcap.frames import BlockStage, by_block
from hiros_mcap.params import Params
from hiros_mcap.skeletons import STATE, Floats, SkeletonModel
from hiros_mcap.stages.known_cameras import KnownCameras
from hiros_mcap.stages.merge.merge_params import MergeParams
from hiros_mcap.wording import instead

Stages = Mapping[str, BlockStage]
"""Output channel -> the stage that fills it, in order; ``frames.by_frame`` takes frames."""


@dataclass(frozen=True, slots=True)
class Run:
    """One run over one log."""

    model: SkeletonModel
    config: Config = field(default_factory=Config)
    events: Events = field(default_factory=Events)
    limbs: LimbTable = field(default_factory=LimbTable)
    """Limb lengths known from before; filled on the way."""
    known: KnownCameras = field(default_factory=KnownCameras)
    """Where the cameras stand and how their clocks go."""
    fixed_frame: str = ""
    system: str = DEFAULT_SYSTEM  # name of the system that is run
    derivatives: Collection[str] | None = None
    """Channels whose velocities and accelerations somebody takes; None = all."""

    @property
    def cameras(self) -> Mapping[str, Floats]:
        """Camera -> (3,) position in the fixed frame, m."""
        return self.known.places

    def widths(self, channel: str, least: tuple[int, int]) -> tuple[int, int]:
        """Return the columns of markers, and of links, of a channel; the stages need ``least``."""
        takes_all = self.derivatives is None or channel in self.derivatives
        return (STATE, STATE) if takes_all else least

    def stage(self, stage: Callable[..., Any], params: Params, **more: Any) -> partial[Any]:
        """Return a stage with what every stage takes (model, parameters, events), and more."""
        return partial(stage, model=self.model, params=params, events=self.events, **more)


@dataclass(frozen=True, slots=True)
class System:
    """A way from detections to clean skeletons: a table of stages."""

    text: str  # one line for a list of systems
    stages: Callable[[Run], Stages]
    """Sets up the stages of a run. It imports their modules: the kernels of a system that nobody
    runs are neither compiled nor loaded."""
    chains: tuple[str, ...]
    """Legal selections of the stages by their letters (T M O F); the last one is all of them."""
    sections: tuple[str, ...]  # sections of the configuration that its stages read
    of: str = ""
    """Name of the system that this is with other parameters (``presets``), "" if there is none."""


def hiros(run: Run) -> Stages:
    """Output channel -> the stage that fills it, in the order of the paper (Fig. 2)."""
    from hiros_mcap.stages.filter.filter import filter_blocks
    from hiros_mcap.stages.merge.merge import merge_blocks
    from hiros_mcap.stages.optimize.optimize import optimize_blocks

    config = run.config
    mended = _mended_views(run, guesses=True)
    merge = run.stage(merge_blocks, _merging(run), fixed_frame=run.fixed_frame, cameras=run.cameras)
    return {
        "tracked": _tracker(run),  # 3.1
        "merged": lambda blocks: merge(mended(blocks)),  # 3.2
        "optimized": run.stage(optimize_blocks, config.optimize, limbs=run.limbs),  # 3.3
        "filtered": run.stage(filter_blocks, config.filter),  # 3.4
    }


def fuse(run: Run) -> Stages:
    """All cameras fused by one smoother per joint: output channel -> the stage that fills it."""
    from hiros_mcap.stages.filter.filter import filter_blocks
    from hiros_mcap.stages.fuse.constrain import constrain_blocks
    from hiros_mcap.stages.fuse.fuse import fuse_blocks
    from hiros_mcap.stages.fuse.gathering import VIEW_WIDTHS

    config = run.config
    mended = _mended_views(run, guesses=False)
    smooth = run.stage(
        fuse_blocks, config.fuse, merging=config.merge, fixed_frame=run.fixed_frame,
        known=run.known,
    )  # fmt: skip
    return {
        "tracked": _tracker(run, widths=run.widths("tracked", VIEW_WIDTHS)),
        "merged": lambda blocks: smooth(mended(blocks)),
        # lengths and prior
        "optimized": run.stage(constrain_blocks, config.constrain, limbs=run.limbs),
        # velocities and accelerations
        "filtered": run.stage(filter_blocks, config.filter, keep_positions=True),
    }


def _tracker(run: Run, **more: Any) -> BlockStage:
    """Return the stage that tracks people."""
    from hiros_mcap.stages.track.track import track_blocks

    known = run.known
    return run.stage(
        track_blocks, run.config.track, cameras=known.places, misplaced=known.misplaced, **more
    )


def _mended_views(run: Run, *, guesses: bool) -> BlockStage:
    """Return what comes between the tracker and the merger or fuser.

    Detections that contradict the person's own body count less; then left and right are decided;
    then joints that a camera does not see count less. With ``guesses``, so do those that its
    detector says it guesses.
    """
    from hiros_mcap.stages.detections.hidden import mend_hidden_blocks
    from hiros_mcap.stages.detections.plausible import drop_implausible_blocks
    from hiros_mcap.stages.detections.sides import decide_sides

    bodies = run.stage(drop_implausible_blocks, run.config.plausible, cameras=run.cameras)
    decide = run.stage(decide_sides, run.config.sides)
    hidden = run.stage(
        mend_hidden_blocks, run.config.plausible, cameras=run.cameras, guesses=guesses
    )
    return lambda blocks: hidden(decide(bodies(blocks)))


def _merging(run: Run) -> MergeParams:
    """Return the merger's parameters: it does not vote on sides that are decided (section 3.2)."""
    from hiros_mcap.stages.detections.sides import knows_sides

    if run.config.sides.over_time and knows_sides(run.model):
        return run.config.merge.model_copy(update={"max_facing_delta": 0.0})
    return run.config.merge


def merging_order(params: MergeParams) -> tuple[str, ...]:
    """Return what the merger does with the views of a person, in order (section 3.2)."""
    votes = params.max_position_delta > 0 or params.max_orientation_delta > 0
    steps = {"flips": params.max_facing_delta > 0, "outliers": votes, "mean": True}
    return tuple(name for name, is_on in steps.items() if is_on)


def raw(run: Run) -> Stages:
    """Leave detections as they are, and give them the ids of the association."""
    from hiros_mcap.stages.malaguti.associate import associate

    return {"tracked": by_block(run.stage(associate, run.config.associate))}


def average(run: Run) -> Stages:
    """Average what the cameras see at one time."""
    from hiros_mcap.stages.merge.merge import merge_blocks

    mean = run.stage(merge_blocks, run.config.merge, fixed_frame=run.fixed_frame)
    return {**raw(run), "merged": mean}


def maf(run: Run) -> Stages:
    """Average each person's last detections (IV)."""
    from hiros_mcap.stages.malaguti.moving_average import moving_average

    params = run.config.moving_average
    mean = run.stage(moving_average, params, fixed_frame=run.fixed_frame)
    return {**raw(run), "merged": by_block(mean)}


def openptrack(run: Run) -> Stages:
    """Filter each joint (III-B to III-D), with the numbers of ``presets/openptrack.toml``."""
    from hiros_mcap.stages.malaguti.kalman import kalman

    joints = run.stage(kalman, run.config.kalman, fixed_frame=run.fixed_frame, cameras=run.cameras)
    return {**raw(run), "merged": by_block(joints)}


def malaguti(run: Run) -> Stages:
    """Filter each person, and keep the lengths of the limbs (III-E, Fig. 1)."""
    from hiros_mcap.stages.malaguti.straighten import straighten

    lengths = run.stage(straighten, run.config.straighten, limbs=run.limbs)
    return {**openptrack(run), "optimized": by_block(lengths)}


def lee(run: Run) -> Stages:
    """Output channel -> the stage that fills it, in the order of the paper (Fig. 4)."""
    from hiros_mcap.stages.lee.cluster import cluster_blocks
    from hiros_mcap.stages.lee.predict import predict

    merge = run.stage(cluster_blocks, run.config.cluster, fixed_frame=run.fixed_frame)
    return {
        "tracked": _tracker(run),
        "merged": merge,  # 2.2.1, 2.2.2
        "filtered": by_block(run.stage(predict, run.config.predict)),  # 2.2.3
    }


LETTERS = {"T": "tracked", "M": "merged", "O": "optimized", "F": "filtered"}
"""Letter of a chain -> output channel."""

# Merging and filtering need the tracker's ids (Fig. 2).
_HIROS = ("T", "TM", "TO", "TF", "TMF", "TMO", "TMOF")
_FUSE = ("T", "TM", "TMO", "TMF", "TMOF")
_LEE = ("T", "TM", "TMF")
_LEE_UNFILTERED = _LEE[:2], ("track", "cluster")

_HIROS_SECTIONS = ("track", "plausible", "sides", "merge", "optimize", "filter")
_FUSE_SECTIONS = ("track", "plausible", "sides", "merge", "fuse", "constrain", "filter")

SYSTEMS: dict[str, System] = {
    "fuse": System(
        "ours, the default: a Kalman smoother per joint over all cameras, limb lengths",
        *(fuse, _FUSE, _FUSE_SECTIONS),
    ),
    "fuse-realtime": System(
        "without future frames, the default of live input; learns on the way",
        *(fuse, _FUSE, _FUSE_SECTIONS, "fuse"),
    ),
    "hiros": System("Hi-ROS 2023, extended for real logs", hiros, _HIROS, _HIROS_SECTIONS),
    "hiros-realtime": System(
        "with the preset realtime: no stage waits for future frames",
        *(hiros, _HIROS, _HIROS_SECTIONS, "hiros"),
    ),
    "malaguti": System(
        "Malaguti 2019: one Kalman filter per person, limb lengths",
        *(malaguti, ("T", "TM", "TMO"), ("associate", "kalman", "straighten")),
    ),
    "openptrack": System(
        "OpenPTrack's Kalman filters, a baseline of Malaguti 2019",
        *(openptrack, ("T", "TM"), ("associate", "kalman")),
    ),
    "maf": System(
        "moving average of each person's last detections",
        *(maf, ("T", "TM"), ("associate", "moving_average")),
    ),
    "average": System(
        "plain mean of the cameras' views at one time",
        *(average, ("T", "TM"), ("associate", "merge")),
    ),
    "raw": System(
        "unchanged detections, with ids of the association by centroids",
        *(raw, ("T",), ("associate",)),
    ),
    "lee": System(
        "Lee 2022, its A5: sides re-arranged, joints clustered, Kalman filter",
        *(lee, _LEE, ("track", "cluster", "predict")),
    ),
    "lee-a1": System("A1: mean of the cameras", lee, *_LEE_UNFILTERED, of="lee"),
    "lee-a2": System("A2: sides re-arranged, mean of the cameras", lee, *_LEE_UNFILTERED, of="lee"),
    "lee-a3": System("A3: sides re-arranged, DBSCAN", lee, *_LEE_UNFILTERED, of="lee"),
    "lee-a4": System("A4: A3 with the previous position", lee, *_LEE_UNFILTERED, of="lee"),
}


def system_names() -> tuple[str, ...]:
    """Return the names of all systems, ours first; ConfigError if two packages bring one name."""
    others = plugins.installed(plugins.SYSTEMS)
    return (*SYSTEMS, *(name for name in others if name not in SYSTEMS))


def system(name: str) -> System:
    """Return a system by its name.

    Raises ConfigError if there is none, two have this name, or the package that brings it is
    faulty.
    """
    if name in plugins.installed(plugins.SYSTEMS):
        return _installed(name)
    if name not in SYSTEMS:
        raise ConfigError(f"no system {name!r}{instead(name, system_names())}")
    return SYSTEMS[name]


@cache
def _installed(name: str) -> System:
    point = plugins.installed(plugins.SYSTEMS)[name]
    if name in SYSTEMS or name in PRESETS:
        raise plugins.faulty(point, "has the name of a system or preset of hiros")
    found = plugins.load(point)
    if not isinstance(found, System):
        raise plugins.faulty(point, "is no hiros_mcap.systems.System")
    unknown = [section for section in found.sections if section not in Config.model_fields]
    if unknown:
        raise plugins.faulty(point, f"reads {unknown[0]!r}, which is no section of parameters")
    if not (found.chains and all(re.fullmatch("TM?O?F?", chain) for chain in found.chains)):
        chains = ", ".join(found.chains) or "of no stage"
        raise plugins.faulty(
            point, f"has the chains {chains}; T, M, O and F are right, in this order"
        )
    return found


def sections_of(name: str) -> tuple[str, ...]:
    """Return the sections of the configuration that a system reads; ConfigError as in system."""
    return ("input", "clock", "output", *system(name).sections)


def chain_of(name: str, stages: str = "") -> tuple[str, ...]:
    """Return the output channels of a system's chain; "" is the whole system.

    Raises ConfigError if there is no such system, or it has no such chain.
    """
    chains = system(name).chains
    chain = stages.upper() or chains[-1]
    if chain not in chains:
        raise ConfigError(
            f"system {name} cannot run the stages {stages!r} (there are: {', '.join(chains)})"
        )
    return tuple(LETTERS[letter] for letter in chain)
