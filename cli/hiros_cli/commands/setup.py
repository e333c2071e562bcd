"""``hiros warmup`` and ``hiros completion``: what is done once after an installation."""

from __future__ import annotations

import time

import typer

from hiros_cli.compiling import prepare
from hiros_cli.options import QUIET, argument
from hiros_mcap.errors import ConfigError


def warmup(quiet: bool = QUIET) -> None:
    """Compile the kernels now, to make the first run fast."""
    from hiros_mcap import kernels

    started = time.perf_counter()
    prepare(quiet=quiet)
    kernels.load(list(kernels.sources()))
    if not quiet:
        print(f"kernels ready after {time.perf_counter() - started:.1f} s")


def completion(context: typer.Context, shell: str = argument("SHELL", "bash, zsh or fish.")) -> int:
    """Print a script that completes commands, options and topics.

    Add one of these lines to your shell's start-up file:

    bash: eval "$(hiros completion bash)"

    zsh: eval "$(hiros completion zsh)"

    fish: hiros completion fish | source
    """
    from hiros_cli.completing import SHELLS, script_of

    if shell not in SHELLS:
        raise ConfigError(f"{shell!r} is none of {', '.join(SHELLS)}")
    return script_of(shell, context.find_root().command)
