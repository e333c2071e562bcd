"""Options of a run: its input, its output, and who follows it."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Literal, Protocol, TypedDict, get_args

from hiros_mcap.defaults import DEFAULT_SYSTEM
from hiros_mcap.errors import ConfigError
from hiros_mcap.events import Events
from hiros_mcap.io.log import Log
from hiros_mcap.skeletons import Frame

Calibration = Literal["off", "auto", "require"]
"""off: the log's poses. auto: better ones where the people prove them. require: refuse a log in
which the people do not confirm every camera's pose."""


@dataclass(frozen=True, slots=True)
class ProcessOptions:
    """Input, stages and output of a run, besides the parameters of the stages.

    A file may be given as text, a single glob without its tuple. Raises ConfigError for a choice
    that does not exist, and for a value of another type.
    """

    system: str = DEFAULT_SYSTEM
    """A key of :data:`hiros_mcap.systems.SYSTEMS`."""
    stages: str = ""
    """One of the system's chains of T tracker, M merger, O optimizer, F filter; "" = all."""
    topics: tuple[str, ...] = ()
    """Globs of the detection channels; empty = every SkeletonGroup channel."""
    keep: tuple[str, ...] | None = None
    """Globs of the input channels to copy; None = those read, the transforms and a /truth."""
    settings: Path | None = None
    """File that the parameters come from, for the summary."""
    extrinsics: Path | None = None
    """File with the cameras' poses. It replaces the log's transforms."""
    limbs_in: Path | None = None
    """File with limb lengths of an earlier session."""
    limbs_out: Path | None = None
    """Where to save the limb lengths."""
    calibrate: Calibration = "auto"
    """Whether the cameras' poses are refined: before the run, in a causal one as it goes on."""
    strict: bool = False
    """Refuse a log if any of its messages has to be skipped."""
    recover: bool = False
    """Run on what can be read of a damaged log."""
    memory: float = 1.0
    """GiB that a run may take, about."""
    markers: bool = False
    """Also write the last stage as MarkerArray and JointState, and the events as Log."""
    compression: str = "zstd"
    """Of the output: zstd, lz4 or "" for none."""

    def __post_init__(self) -> None:
        for name in ("topics", "keep"):
            if (globs := getattr(self, name)) is not None:
                many = isinstance(globs, Iterable) and not isinstance(globs, str)
                several = tuple(globs) if many else (globs,)
                if not all(isinstance(glob, str) for glob in several):
                    raise ConfigError(f"{name}: {globs!r} is neither a glob nor a list of globs")
                object.__setattr__(self, name, several)
        for name in ("settings", "extrinsics", "limbs_in", "limbs_out"):
            if (path := getattr(self, name)) is not None:
                if not isinstance(path, str | os.PathLike):
                    raise ConfigError(f"{name}: {path!r} is no name of a file")
                object.__setattr__(self, name, Path(path))
        for field in fields(self):
            kinds, value = _KINDS.get(str(field.type)), getattr(self, field.name)
            if kinds is not None and not isinstance(value, kinds):
                raise ConfigError(f"{field.name}: {value!r} is no {kinds[0].__name__}")
        for name, choices in _CHOICES.items():
            if (value := getattr(self, name)) not in choices:
                raise ConfigError(f"{name}: {value!r} is none of {', '.join(map(repr, choices))}")
        if not 0 < self.memory < math.inf:
            raise ConfigError(f"memory: {self.memory!r} is no number of GiB above 0")


_KINDS: dict[str, tuple[type, ...]] = {"str": (str,), "bool": (bool,), "float": (float, int)}
_CHOICES = {"calibrate": get_args(Calibration), "compression": ("zstd", "lz4", "")}


class ProcessChoices(TypedDict, total=False):
    """The fields of :class:`ProcessOptions`, as keywords of ``process``."""

    system: str
    stages: str
    topics: str | Sequence[str]
    keep: str | Sequence[str] | None
    settings: str | Path | None
    extrinsics: str | Path | None
    limbs_in: str | Path | None
    limbs_out: str | Path | None
    calibrate: Calibration
    strict: bool
    recover: bool
    memory: float
    markers: bool
    compression: Literal["zstd", "lz4", ""]


class Watcher(Protocol):
    """Sees every frame while a run goes on, such as a live view."""

    def begin(self, log: Log, chain: Sequence[str]) -> None:
        """Take note of the log that is read, and of the output channels."""

    def frame(self, channel: str, frame: Frame) -> None:
        """Show a frame of "detections", in the fixed frame, or of a stage. Not to be changed."""

    def end(self, events: Events) -> None:
        """Show what happened, after the last frame."""
