"""The program ``hiros``: what surrounds every command.

Exit codes: 0 done, 2 bad input or usage (one line, nothing written), 3 recovered with losses,
70 a bug of ours, and 128 + signal when stopped. The module imports nothing heavy, so that a Ctrl-C
during the imports of a command already finds its handler.
"""

from __future__ import annotations

import logging
import math
import os
import signal
import sys
import time
import warnings
from contextlib import nullcontext
from types import FrameType
from typing import NoReturn

from hiros_cli.exit_codes import BAD_INPUT, BUG

AGAIN_S = 1.0
"""A signal within this time of another one says nothing new."""

# One thread of linear algebra: the arrays are small, and threads that wait for each other cost
# hundreds of times what they win. Read by numpy's libraries when they are first imported.
SINGLE_THREADED = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


class Interrupted(BaseException):
    """A signal asked us to stop. Not a KeyboardInterrupt: libraries turn that into other things."""


def main() -> NoReturn:
    """Run the program with the arguments of the process and exit."""
    if "--debug" not in sys.argv:
        _silence_libraries()
    sys.exit(run(sys.argv[1:]))


def _silence_libraries() -> None:
    """Keep warnings of libraries from the user, here and in the processes that work for us."""
    warnings.simplefilter("ignore")
    sys.warnoptions.append("ignore")
    logging.lastResort = None


def run(arguments: list[str]) -> int:
    """Run one command and return the exit code; every fault ends here, as one line on stderr."""
    stop = Stop()
    debug = "--debug" in arguments
    try:
        stop.catch()
        try:
            code = _run(arguments)
        except Exception as error:
            if stop.exit_code is not None:
                raise
            code = _report(error, debug=debug)
        stop.end_with(code)
    except BaseException as error:
        # A signal strikes anywhere, also between a lock and its release or while an error is
        # reported. Whatever is raised after it came is neither an answer nor a fault.
        if stop.exit_code is None:
            raise
        code = stop.exit_code
        stop.end_with(code)
        if debug:
            _show_traceback(error)
    return code


def _run(arguments: list[str]) -> int:
    open_missing_streams()
    for variable in SINGLE_THREADED:
        os.environ.setdefault(variable, "1")
    from hiros_cli.common_options import VERBOSE, of_ros, steps_shown, without_common
    from hiros_cli.compiling import importing

    with importing():
        from hiros_cli.commands import dispatch

    with steps_shown() if VERBOSE in arguments else nullcontext():
        code = dispatch(of_ros(without_common(arguments)))
    sys.stdout.flush()
    return code


def _report(error: Exception, *, debug: bool) -> int:
    """Print one line about ``error`` and return the exit code that belongs to it."""
    if isinstance(error, BrokenPipeError):
        # The reader has seen enough. Python flushes stdout once more when it exits.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 128 + 13  # as after SIGPIPE
    from hiros_cli.output import error_line, lacks_memory, left_out
    from hiros_mcap.errors import HirosError
    from hiros_mcap.plugins import failed

    if debug:
        _show_traceback(error)
    if not isinstance(error, HirosError | OSError):
        error = failed(error) or error
    bug = not (isinstance(error, HirosError | OSError) or lacks_memory(error) or left_out(error))
    print(error_line(error, bug=bug), file=sys.stderr)
    return BUG if bug else BAD_INPUT


class Stop:
    """Turns SIGINT, SIGTERM and SIGHUP into an exception, so that every ``finally`` runs.

    A signal that the parent chose to ignore (``nohup``) stays ignored. A second signal within a
    second is part of the first (an impatient Ctrl-C must not interrupt the cleaning up); a later
    one raises again.

    The exception waits until Python has left the code that takes and gives back locks: raised
    there, it leaves a lock taken that another thread needs, and the program would hang. Where it
    is lost because Python cannot pass it on, as in a ``__del__``, it is raised once more.

    Attributes
    ----------
    exit_code : what the first signal asks for, None as long as there was none.
    """

    def __init__(self) -> None:
        self.exit_code: int | None = None
        self._signum = 0
        self._last = -math.inf
        self._code: int | None = None
        self._report_lost = sys.unraisablehook

    def catch(self) -> None:
        """Handle the signals from now on."""
        sys.unraisablehook = self._lost
        if hasattr(signal, "SIGALRM"):
            signal.signal(signal.SIGALRM, self._raise)
        for name in ("SIGINT", "SIGTERM", "SIGHUP"):
            signum = getattr(signal, name, None)
            if signum is not None and signal.getsignal(signum) is not signal.SIG_IGN:
                signal.signal(signum, self._stop)

    def end_with(self, code: int) -> None:
        """Say how the program ends: a signal does not change it, but may hurry it."""
        self._code = code
        self._last = time.monotonic()

    def _stop(self, signum: int, frame: FrameType | None) -> None:
        now = time.monotonic()
        if now - self._last <= AGAIN_S:
            return
        if self._code is not None:
            # All is done and cleaned up; something that Python waits for at its end hangs.
            os._exit(self._code)
        self._last = now
        self._signum = self._signum or signum
        self.exit_code = 128 + self._signum
        self._raise(signum, frame)

    def _raise(self, _: int, frame: FrameType | None) -> None:
        if self._code is not None:
            return
        patient = time.monotonic() - self._last < AGAIN_S
        if not (patient and _may_hold_a_lock(frame) and _soon()):
            raise Interrupted(self._signum)

    def _lost(self, unraisable: sys.UnraisableHookArgs) -> None:
        if isinstance(unraisable.exc_value, Interrupted):
            _soon()
        elif self.exit_code is None:
            self._report_lost(unraisable)


_DELICATE = ("threading", "concurrent.futures", "llvmlite")


def _may_hold_a_lock(frame: FrameType | None) -> bool:
    """Whether it is in the midst of Python's code for threads, or of finding a module, or of LLVM.

    What LLVM has half made, it stumbles over when the process ends.
    """
    if frame is not None and frame.f_globals.get("__name__") == "importlib._bootstrap":
        return True
    while frame is not None:
        if str(frame.f_globals.get("__name__")).startswith(_DELICATE):
            return True
        frame = frame.f_back
    return False


def _soon() -> bool:
    """Have SIGALRM sent in a few milliseconds; False where the system cannot."""
    if not hasattr(signal, "setitimer"):
        return False
    signal.setitimer(signal.ITIMER_REAL, 0.005)
    return True


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


def _show_traceback(error: BaseException) -> None:
    import traceback

    traceback.print_exception(error)
