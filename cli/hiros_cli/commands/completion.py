"""``hiros completion``: what a shell needs to complete command lines."""

from __future__ import annotations

import typer

from hiros_cli.options import argument
from hiros_mcap.errors import ConfigError


def completion(
    context: typer.Context,
    shell: str = argument("SHELL", "bash, zsh or fish."),
) -> int:
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
