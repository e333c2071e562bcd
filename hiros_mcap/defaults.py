"""Defaults that the command line shows without loading what uses them."""

from __future__ import annotations

DEFAULT_SYSTEM, LIVE_SYSTEM = "fuse", "fuse-realtime"
"""Live input cannot wait for later frames."""
_PRESET_SYSTEM, _LIVE_PRESET_SYSTEM = "hiros", "hiros-realtime"
NO_PRESET = "default"

LEAST_CONFIDENCE = 0.1
"""A marker that is less certain is a gap.

In results of `fuse`, its standard deviation is above 6 cm, the width of a joint: no camera saw it
for a while. In those of `hiros`, it is in the last tenth of ``merge.carry``.
"""


def default_system(preset: str = NO_PRESET, *, live: bool = False) -> str:
    """Return the system that runs if none is named: hiros with a preset, since those change it."""
    if preset == NO_PRESET:
        return LIVE_SYSTEM if live else DEFAULT_SYSTEM
    return _LIVE_PRESET_SYSTEM if live else _PRESET_SYSTEM
