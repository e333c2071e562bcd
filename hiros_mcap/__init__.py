"""Turns a log of several cameras' skeletons into one clean, smooth skeleton per person."""

import logging
from typing import TYPE_CHECKING, Any

from hiros_mcap._version import __version__

if TYPE_CHECKING:
    from hiros_mcap.body.transforms import transform_to_fixed
    from hiros_mcap.config import Config, load_config
    from hiros_mcap.errors import ConfigError, HirosError, LogError
    from hiros_mcap.io.export.files import export
    from hiros_mcap.io.log import open_log
    from hiros_mcap.io.result import Motion, Result, open_result
    from hiros_mcap.running.pipeline import ProcessOptions, process
    from hiros_mcap.running.summary import Summary
    from hiros_mcap.skeletons import Frame, SkeletonModel

logging.getLogger(__name__).addHandler(logging.NullHandler())

__all__ = [
    "Config", "ConfigError", "Frame", "HirosError", "LogError", "Motion", "ProcessOptions",
    "Result", "SkeletonModel", "Summary", "__version__", "export", "load_config", "open_log",
    "open_result", "process", "transform_to_fixed",
]  # fmt: skip

_HOMES = {
    "body.transforms": ("transform_to_fixed",),
    "config": ("Config", "load_config"),
    "errors": ("ConfigError", "HirosError", "LogError"),
    "io.export.files": ("export",),
    "io.log": ("open_log",),
    "io.result": ("Motion", "Result", "open_result"),
    "running.pipeline": ("ProcessOptions", "process"),
    "skeletons": ("Frame", "SkeletonModel"),
    "running.summary": ("Summary",),
}


def __getattr__(name: str) -> Any:
    """Import on first use: ``hiros --version`` shall not wait for numba."""
    home = next((module for module, names in _HOMES.items() if name in names), None)
    if home is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    if name == "process":
        from hiros_mcap.kernels.shipped import announce

        announce()
    return getattr(import_module(f"hiros_mcap.{home}"), name)


def __dir__() -> list[str]:
    """List the public names, also those that were not used yet, for completion."""
    return sorted({*globals(), *__all__})
