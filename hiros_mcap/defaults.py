"""Which system runs if none is named."""

from __future__ import annotations

DEFAULT_SYSTEM, LIVE_SYSTEM = "fuse", "fuse-realtime"
"""Live input cannot wait for later frames."""
_PRESET_SYSTEM, _LIVE_PRESET_SYSTEM = "hiros", "hiros-realtime"
NO_PRESET = "default"


def default_system(preset: str = NO_PRESET, *, live: bool = False) -> str:
    """Return the system that runs if none is named: hiros with a preset, since those change it."""
    if preset == NO_PRESET:
        return LIVE_SYSTEM if live else DEFAULT_SYSTEM
    return _LIVE_PRESET_SYSTEM if live else _PRESET_SYSTEM


def takes_presets(system: str) -> bool:
    """Whether presets mean something to a system: they change hiros and what shares its stages."""
    return system not in (DEFAULT_SYSTEM, LIVE_SYSTEM)
