"""``hiros systems`` and ``hiros config``: the systems, and the parameters of each."""

from __future__ import annotations

from hiros_cli.compiling import prepare
from hiros_cli.options import GROUP, Parameters, flag, grouped


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


@grouped
def config(
    parameters: Parameters = GROUP,
    everything: bool = flag("--all", "Also print the advanced parameters."),
) -> None:
    """Print the parameters of a system as TOML for --config."""
    prepare(quiet=False)
    from hiros_mcap.config import to_toml
    from hiros_mcap.systems import sections_of

    settings = parameters.settings()
    sections = sections_of(settings.system)
    print(to_toml(settings.load(), sections, everything=everything, fixed=False), end="")
