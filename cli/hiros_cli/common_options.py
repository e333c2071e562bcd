"""Options of every command, wherever they stand, and the arguments of ROS 2."""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from hiros_cli.output import printable

DEBUG, VERBOSE = "--debug", "--verbose"


def without_common(arguments: Sequence[str]) -> list[str]:
    """Return the arguments without the options of every command."""
    return [argument for argument in arguments if argument not in (DEBUG, VERBOSE)]


def of_ros(arguments: Sequence[str]) -> list[str]:
    """Return the arguments with those of ROS 2 each as the value of an option --ros-args.

    As in any node, they reach from ``--ros-args`` to ``--`` or to the end.
    """
    joined, inside = [], False
    for argument in arguments:
        if argument == "--ros-args":
            inside = True
        elif inside and argument == "--":
            inside = False
        else:
            joined.append(f"--ros-args={argument}" if inside else argument)
    return joined


class _Steps(logging.Handler):
    """Prints on stderr what the library does; its warnings are printed anyway."""

    def emit(self, record: logging.LogRecord) -> None:
        if record.levelno < logging.WARNING:
            print(f"hiros: {printable(record.getMessage())}", file=sys.stderr, flush=True)


@contextmanager
def steps_shown() -> Iterator[None]:
    """Show the library's steps as long as the block runs."""
    logger, handler = logging.getLogger("hiros_mcap"), _Steps(logging.INFO)
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(logging.NOTSET)
