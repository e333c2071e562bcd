"""``hiros config``: the effective parameters, documented."""

from __future__ import annotations

from hiros_cli.options import Assignments, ConfigFile, Preset, SystemName


def config(
    system: SystemName = "hiros",
    preset: Preset = "default",
    config: ConfigFile = None,
    assignments: Assignments = None,
) -> None:
    """Print every parameter with its meaning and value, as TOML that --config reads back."""
    from hiros_cli.compiling import prepare

    prepare(quiet=False)
    from hiros_mcap.config import load_config, to_toml

    print(to_toml(load_config(config, assignments or (), preset, system)), end="")
