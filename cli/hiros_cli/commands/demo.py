"""``hiros demo``: a sample log for who has none."""

from __future__ import annotations

import shlex
from pathlib import Path

from hiros_cli.options import FORCE, QUIET, argument

SECONDS = 10.0


def demo(
    output: Path = argument("OUT", "Log to write.", default=Path("demo.mcap")),
    force: bool = FORCE,
    quiet: bool = QUIET,
) -> None:
    """Write a sample log: two people cross before three cameras.

    It is simulated: skeletons with noise, flips and gaps, the cameras' poses, and the truth.
    """
    from hiros_cli.compiling import prepare
    from hiros_cli.output import check_outputs

    check_outputs((output, "log"), inputs=(), force=force)
    prepare(quiet=quiet)
    from hiros_cli.commands.process import SUFFIX
    from hiros_mcap.running.progress_bar import bar
    from hiros_mcap.simulate import SimulateParams
    from hiros_mcap.simulate.write_log import write_log

    params = SimulateParams(people=2, cameras=3, action="cross", seconds=SECONDS)
    with bar(f"simulating {output.name}", quiet=quiet) as progress:
        write_log(output, params, progress)
    if not quiet:
        log, result = (shlex.quote(str(p)) for p in (output, output.with_suffix(SUFFIX)))
        print(f"wrote {output}; go on with\n    hiros process {log}\n    hiros view {result}")
