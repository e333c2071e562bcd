"""What a system is, and what it needs to know of a run to set up its stages."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any

from hiros_mcap.body.limb_table import LimbTable
from hiros_mcap.body.rotations import Rigid
from hiros_mcap.config import Config
from hiros_mcap.defaults import DEFAULT_SYSTEM
from hiros_mcap.events import Events
from hiros_mcap.frames import BlockStage
from hiros_mcap.params import Params
from hiros_mcap.skeletons import Floats, SkeletonModel

if TYPE_CHECKING:
    from hiros_mcap.stages.fuse.fusion_noise import FusionNoise

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
    cameras: Mapping[str, Floats] = field(default_factory=dict)
    """Source -> (3,) position of the camera in the fixed frame, m."""
    fixed_frame: str = ""
    system: str = DEFAULT_SYSTEM
    """Name of the system that is run."""
    noise: FusionNoise | None = None
    """What a first pass has shown of cameras and joints; None = there was none."""
    to_given: Mapping[str, Rigid] = field(default_factory=dict)
    """Source -> what takes its people back to the pose that was given, where it was refined."""
    pose_errors: Mapping[str, float] = field(default_factory=dict)
    """Source -> standard error, m, of a pose that the people gave; causal runs go on finding."""
    clocks: Mapping[str, float] = field(default_factory=dict)
    """Source -> s by which its clock was ahead of the middle one; causal runs do not say it."""

    def stage(self, stage: Callable[..., Any], params: Params, **more: Any) -> partial[Any]:
        """Return a stage with what every stage takes (model, parameters, events), and more."""
        return partial(stage, model=self.model, params=params, events=self.events, **more)


@dataclass(frozen=True, slots=True)
class System:
    """A way from detections to clean skeletons: a table of stages."""

    text: str
    """One line for a list of systems."""
    stages: Callable[[Run], Stages]
    """Sets up the stages of a run. It imports their modules: the kernels of a system that nobody
    runs are neither compiled nor loaded."""
    chains: tuple[str, ...]
    """Legal selections of the stages by their letters (T M O F); the last one is all of them."""
    sections: tuple[str, ...]
    """Sections of the configuration that its stages read."""
    of: str = ""
    """Name of the system that this is with other parameters (``presets``), "" if there is none."""
