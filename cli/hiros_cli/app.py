"""The program ``hiros``: what surrounds every command.

Exit codes: 0 done, 2 bad input or usage (one line, nothing written), 70 a bug of ours, and
128 + signal when stopped. The module imports nothing heavy, so that a Ctrl-C during the imports
of a command already finds its handler.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from types import FrameType
from typing import NoReturn

BAD_INPUT = 2
BUG = 70
BROKEN_PIPE = 128 + 13

# One thread of linear algebra: the arrays are small, and threads that wait for each other cost
# hundreds of times what they win. Read by numpy's libraries when they are first imported.
SINGLE_THREADED = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


class Interrupted(BaseException):
    """A signal asked us to stop. Not a KeyboardInterrupt: libraries turn that into other things."""

    def __init__(self, signum: int) -> None:
        super().__init__(signum)
        self.exit_code = 128 + signum


def main() -> NoReturn:
    """Run the program with the arguments of the process and exit."""
    sys.exit(run(sys.argv[1:]))


def run(arguments: list[str]) -> int:
    """Run one command and return the exit code; every fault ends here, as one line on stderr."""
    catch_signals()
    open_missing_streams()
    for variable in SINGLE_THREADED:
        os.environ.setdefault(variable, "1")
    debug = "--debug" in arguments
    try:
        from hiros_cli.commands import dispatch

        code = dispatch([argument for argument in arguments if argument != "--debug"])
        sys.stdout.flush()
    except Interrupted as stop:
        return stop.exit_code
    except BrokenPipeError:
        # The reader has seen enough. Python flushes stdout once more when it exits.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return BROKEN_PIPE
    except Exception as error:  # noqa: BLE001  the boundary: nothing may escape as a traceback
        return fail(error, debug=debug)
    return code


def catch_signals() -> None:
    """Turn SIGINT, SIGTERM and SIGHUP into an exception, so that every ``finally`` runs.

    A signal that the parent chose to ignore (``nohup``) stays ignored. A second signal within a
    second is part of the first (an impatient Ctrl-C must not interrupt the cleaning up); a later
    one raises again, in case the first was lost in a place where Python drops exceptions.
    """
    last = -1.0

    def stop(signum: int, _: FrameType | None) -> None:
        nonlocal last
        now = time.monotonic()
        if last < 0 or now - last > 1.0:
            last = now
            raise Interrupted(signum)

    for name in ("SIGINT", "SIGTERM", "SIGHUP"):
        signum = getattr(signal, name, None)
        if signum is not None and signal.getsignal(signum) is not signal.SIG_IGN:
            signal.signal(signum, stop)


def open_missing_streams() -> None:
    """Make stdin, stdout and stderr usable whatever the parent closed or encodes.

    A closed descriptor would be given to the next file that we open, and a stray print would
    then go into an output file.
    """
    for descriptor in (0, 1, 2):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # the lowest free descriptor, i.e. this one
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115, PTH123
        elif hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")


def fail(error: Exception, *, debug: bool) -> int:
    """Print one line about ``error`` and return the exit code that belongs to it."""
    from hiros_cli.printable import error_line
    from hiros_mcap.errors import HirosError

    if debug:
        import traceback

        traceback.print_exception(error)
    bug = not isinstance(error, HirosError | OSError | MemoryError)
    print(error_line(error, bug=bug), file=sys.stderr)
    return BUG if bug else BAD_INPUT
