"""What a system needs to know of a run to set up its stages."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from hiros_mcap.config import Config
from hiros_mcap.events import Events
from hiros_mcap.limbs import LimbTable
from hiros_mcap.skeletons import Floats, SkeletonModel, Stage

Stages = Mapping[str, Stage]
"""Output channel -> the stage that fills it, in order."""


@dataclass(frozen=True, slots=True)
class Run:
    """One run over one log."""

    model: SkeletonModel
    config: Config = field(default_factory=Config)
    events: Events = field(default_factory=Events)
    limbs: LimbTable = field(default_factory=LimbTable)
    """Limb lengths known from before; filled on the way."""
    cameras: Mapping[str, Floats] = field(default_factory=dict)
    """Source -> (3,) position of the camera in the fixed frame, m."""
    fixed_frame: str = ""
