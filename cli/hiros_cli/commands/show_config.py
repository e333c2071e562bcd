"""``hiros config``: the effective parameters, documented."""

from __future__ import annotations

from pathlib import Path

from hiros_cli.options import ASSIGNMENTS, CONFIG, PRESET, SYSTEM, chosen_system, flag


def config(
    system: str | None = SYSTEM,
    preset: str = PRESET,
    config: Path | None = CONFIG,
    assignments: list[str] | None = ASSIGNMENTS,
    everything: bool = flag("--all", "Also print the advanced parameters."),
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
