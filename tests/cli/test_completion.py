"""Completions for Tab are typer's; they load nothing slow."""

from __future__ import annotations

import os
import subprocess
import sys


def offered(line):
    """Press Tab in bash at the end of a line; fails if anything slow is imported."""
    code = (
        "import sys; from hiros_cli.app import run; code = run([]);"
        "slow = {'numba', 'numpy', 'pandas', 'scipy', 'rerun'} & set(sys.modules);"
        "sys.exit(f'{code} {slow}' if slow or code else 0)"
    )
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(sys.path),
        "_HIROS_COMPLETE": "complete_bash",
        "COMP_WORDS": line,
        "COMP_CWORD": str(line.count(" ")),
    }
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, env=environment, check=True, capture_output=True, text=True)
    return done.stdout.split()


def test_commands_and_options_are_completed():
    assert offered("hiros exp") == ["export"]
    assert offered("hiros export --mark") == ["--marker-set"]
