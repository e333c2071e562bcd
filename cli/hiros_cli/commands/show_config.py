"""``hiros config``: the effective parameters, documented."""

from __future__ import annotations

from typing import Annotated

import typer

from hiros_cli.options import Assignments, ConfigFile, Preset, SystemName, chosen_system


def config(
    system: SystemName = None,
    preset: Preset = "default",
    config: ConfigFile = None,
    assignments: Assignments = None,
    everything: Annotated[
        bool, typer.Option("--all", help="Also print the advanced parameters.")
    ] = False,
) -> None:
    """Print the parameters of a system as TOML for --config."""
    from hiros_cli.compiling import prepare

    prepare(quiet=False)
    from hiros_mcap.config import load_config, to_toml
    from hiros_mcap.systems import sections_of

    system = chosen_system(system, preset)
    effective = load_config(config, assignments or (), preset, system)
    shown = to_toml(effective, sections_of(system), everything=everything, fixed=False)
    print(shown, end="")
