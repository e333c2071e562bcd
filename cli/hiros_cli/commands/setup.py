"""Commands that need no log: ``hiros systems``, ``config`` and ``warmup``."""

from __future__ import annotations

import time
from dataclasses import replace

from hiros_cli.compiling import prepare
from hiros_cli.options import GROUP, QUIET, Parameters, argument, flag, grouped
from hiros_mcap.errors import ConfigError


def systems() -> None:
    """List the systems for --system, their stages and variants."""
    prepare(quiet=False)
    from hiros_cli.run_report import page, table
    from hiros_mcap.systems import system, system_names

    table_of, rows = {name: system(name) for name in system_names()}, []
    for base in (name for name, row in table_of.items() if row.of not in table_of):
        rows.append((base, table_of[base].text, ", ".join(table_of[base].chains)))
        rows += [(f"  {name}", row.text, "") for name, row in table_of.items() if row.of == base]
    page((), table("System", "What it is", "Stages", rows=rows))


@grouped
def config(
    name: str | None = argument("SYSTEM", "As --system.", None),
    parameters: Parameters = GROUP,
    everything: bool = flag("--all", "Also print the advanced parameters."),
) -> None:
    """Print the parameters of a system as TOML for --config."""
    prepare(quiet=False)
    from hiros_mcap.config import to_toml
    from hiros_mcap.systems import sections_of

    if name is not None and parameters.system not in (None, name):
        raise ConfigError(f"name one system: {name} or --system {parameters.system}")
    settings = replace(parameters, system=name or parameters.system).settings()
    sections = sections_of(settings.system)
    print(to_toml(settings.load(), sections, everything=everything, fixed=False), end="")


def warmup(quiet: bool = QUIET) -> None:
    """Compile the kernels now, to make the first run fast."""
    from hiros_mcap import kernels

    started = time.perf_counter()
    prepare(quiet=quiet)
    kernels.load(list(kernels.sources()))
    if not quiet:
        print(f"kernels ready after {time.perf_counter() - started:.1f} s")
