"""``hiros systems`` and ``hiros config``: the systems, and the parameters of each."""

from __future__ import annotations

from pathlib import Path

from hiros_cli.compiling import prepare
from hiros_cli.options import ASSIGNMENTS, CONFIG, PRESET, SYSTEM, chosen_system, flag


def systems() -> None:
    """List the systems for --system, their stages and variants."""
    prepare(quiet=False)
    from hiros_cli.run_report import page, table
    from hiros_mcap.systems import SYSTEMS

    rows = []
    for base in (name for name, system in SYSTEMS.items() if not system.of):
        rows.append((base, SYSTEMS[base].text, ", ".join(SYSTEMS[base].chains)))
        rows += [(f"  {name}", row.text, "") for name, row in SYSTEMS.items() if row.of == base]
    page((), table("System", "What it is", "Stages", rows=rows))


def config(
    system: str | None = SYSTEM,
    preset: str = PRESET,
    config: Path | None = CONFIG,
    assignments: list[str] | None = ASSIGNMENTS,
    everything: bool = flag("--all", "Also print the advanced parameters."),
) -> None:
    """Print the parameters of a system as TOML for --config."""
    prepare(quiet=False)
    from hiros_mcap.config import load_config, to_toml
    from hiros_mcap.systems import sections_of

    system = chosen_system(system, preset)
    effective = load_config(config, assignments or (), preset, system)
    shown = to_toml(effective, sections_of(system), everything=everything, fixed=False)
    print(shown, end="")
