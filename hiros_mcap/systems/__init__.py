"""Our own system and the published ones, each a table of stages."""

from __future__ import annotations

from hiros_mcap.errors import ConfigError
from hiros_mcap.systems.hiros import fuse, hiros
from hiros_mcap.systems.hiros import merging_order as merging_order
from hiros_mcap.systems.published import average, lee, maf, malaguti, openptrack, raw
from hiros_mcap.systems.run import Run as Run
from hiros_mcap.systems.run import Stages as Stages
from hiros_mcap.systems.run import System

LETTERS = {"T": "tracked", "M": "merged", "O": "optimized", "F": "filtered"}
"""Letter of a chain -> output channel."""

# Merging and filtering need the tracker's ids (Fig. 2).
_HIROS = ("T", "TM", "TO", "TF", "TMF", "TMO", "TMOF")
_FUSE = ("T", "TM", "TMO", "TMF", "TMOF")
_LEE = ("T", "TM", "TMF")
_UNFILTERED = _LEE[:2], ("track", "cluster")

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
    "lee-a1": System("A1: mean of the cameras", lee, *_UNFILTERED, of="lee"),
    "lee-a2": System("A2: sides re-arranged, mean of the cameras", lee, *_UNFILTERED, of="lee"),
    "lee-a3": System("A3: sides re-arranged, DBSCAN", lee, *_UNFILTERED, of="lee"),
    "lee-a4": System("A4: A3 with the previous position", lee, *_UNFILTERED, of="lee"),
}


def system(name: str) -> System:
    """Return a system by its name; raises ConfigError if there is none."""
    if name not in SYSTEMS:
        raise ConfigError(f"no system {name!r} (there are: {', '.join(SYSTEMS)})")
    return SYSTEMS[name]


def sections_of(name: str) -> tuple[str, ...]:
    """Return the sections of the configuration that a system reads; ConfigError as in system."""
    sections = system(name).sections
    return ("input", "clock", *(("noise",) if "fuse" in sections else ()), "output", *sections)


def chain_of(name: str, stages: str = "") -> tuple[str, ...]:
    """Return the output channels of a system's chain; "" is the whole system.

    Raises ConfigError if there is no such system, or it has no such chain.
    """
    chains = system(name).chains
    chosen = stages.upper() or chains[-1]
    if chosen not in chains:
        raise ConfigError(
            f"system {name} cannot run the stages {stages!r} (there are: {', '.join(chains)})"
        )
    return tuple(LETTERS[letter] for letter in chosen)
