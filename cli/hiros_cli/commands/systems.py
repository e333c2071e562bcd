"""``hiros systems``: the published systems and the baselines."""

from __future__ import annotations


def systems() -> None:
    """List the systems for --system, with their stages."""
    from hiros_cli.compiling import prepare

    prepare(quiet=False)
    from hiros_mcap.systems import SYSTEMS

    width = max(map(len, SYSTEMS))
    for name, system in SYSTEMS.items():
        print(f"{name:{width}}  {system.text}\n{'':{width}}  stages: {', '.join(system.chains)}")
