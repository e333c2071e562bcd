"""``hiros systems``: the published systems and the baselines."""

from __future__ import annotations


def systems() -> None:
    """List the systems for --system, their stages and variants."""
    from hiros_cli.compiling import prepare

    prepare(quiet=False)
    from hiros_cli.run_report import page, table
    from hiros_mcap.systems import SYSTEMS

    rows = []
    for base in (name for name, system in SYSTEMS.items() if not system.of):
        rows.append((base, SYSTEMS[base].text, ", ".join(SYSTEMS[base].chains)))
        rows += [(f"  {name}", row.text, "") for name, row in SYSTEMS.items() if row.of == base]
    page((), table("System", "What it is", "Stages", rows=rows))
