"""Several processes that work through a list of tasks.

A Ctrl-C reaches every process of a terminal. The workers ignore it: the first process stops them,
and they clean up without a message.
"""

from __future__ import annotations

import os
import signal
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from multiprocessing import get_context, resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from types import FrameType
from typing import Any, TypeVar

from hiros_mcap.errors import HirosError

Result = TypeVar("Result")

_JOIN_S = 10.0
_RAISE_AGAIN_S = 2.0
_NAMES = ("SIGINT", "SIGTERM", "SIGHUP")
_exit_codes: list[int] = []
"""The exit code of a worker that the first process has stopped."""
_STOPPING = [getattr(signal, name) for name in _NAMES if hasattr(signal, name)]
_HELD = [*_STOPPING, *([signal.SIGALRM] if hasattr(signal, "SIGALRM") else [])]
"""Those, and the alarm that :func:`_raise_exit_after` sets."""


def run_tasks(
    function: Callable[..., Result], tasks: Sequence[tuple[Any, ...]], jobs: int = 0
) -> Iterator[tuple[int, Result]]:
    """Yield (number of the task, result of the function) as they get ready.

    Parameters
    ----------
    function : at the top level of a module. tasks : its arguments.
    jobs : processes at once; 0 = one per core that this process may use. With 1, this process
        does everything.

    Raises
    ------
    HirosError
        A process was killed. Errors of ``function`` are raised here, and the others are stopped.
    """
    n = min(jobs or _cores(), len(tasks))
    if n <= 1:
        for k, task in enumerate(tasks):
            yield k, function(*task)
        return
    pool = _Pool()
    try:
        pool.start(n)
        yield from pool.work(function, tasks)
    except BaseException:
        pool.stop()
        raise
    finally:
        pool.close()


def _cores() -> int:
    """Return how many cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


class _Pool:
    """The processes, each with the pipe to it."""

    def __init__(self) -> None:
        self._workers: dict[Connection, SpawnProcess] = {}

    def start(self, n: int) -> None:
        """Start ``n`` processes."""
        context = get_context("spawn")
        with _safe_path():
            if os.name == "posix":
                # If it were started later, it would unblock the signals.
                resource_tracker.ensure_running()
            with _signals_held():
                for _ in range(n):
                    ours, theirs = context.Pipe()
                    worker = context.Process(target=_work, args=(theirs,), daemon=True)
                    worker.start()
                    theirs.close()  # so that the pipe ends when the process does
                    self._workers[ours] = worker

    def work(
        self, function: Callable[..., Result], tasks: Sequence[tuple[Any, ...]]
    ) -> Iterator[tuple[int, Result]]:
        """Hand out the tasks in order, the next one to the first process that is ready."""
        waiting = iter(enumerate(tasks))
        busy: dict[Connection, int] = {}
        for connection, (k, task) in zip(self._workers, waiting, strict=False):
            self._send(connection, function)
            self._send(connection, task)
            busy[connection] = k
        while busy:
            ready = wait(list(busy))
            for connection in [each for each in busy if each in ready]:
                done, result = busy.pop(connection), self._receive(connection)
                following = next(waiting, None)
                if following is not None:
                    busy[connection], task = following
                    self._send(connection, task)
                yield done, result

    def _send(self, connection: Connection, item: object) -> None:
        try:
            connection.send(item)
        except OSError:
            raise self._ended(connection) from None

    def _receive(self, connection: Connection) -> Any:
        try:
            succeeded, result = connection.recv()
        except (EOFError, OSError):
            raise self._ended(connection) from None
        if not succeeded:
            raise result
        return result

    def _ended(self, connection: Connection) -> HirosError:
        worker = self._workers[connection]
        worker.join(_JOIN_S)
        code = worker.exitcode or 0
        how = f"was killed by signal {-code}" if code < 0 else f"ended with code {code}"
        return HirosError(f"a process {how}; is there enough memory? --jobs 1 needs the least")

    def stop(self) -> None:
        """Interrupt all processes."""
        for worker in self._workers.values():
            worker.terminate()

    def close(self) -> None:
        """Wait until all have ended; kill those that take too long."""
        for connection in self._workers:
            connection.close()
        for worker in self._workers.values():
            worker.join(_JOIN_S)
            if worker.is_alive():
                worker.kill()
                worker.join()


@contextmanager
def _safe_path() -> Iterator[None]:
    """Start processes that import nothing from the current folder.

    They get this process's path afterwards.
    """
    before = os.environ.get("PYTHONSAFEPATH")
    os.environ["PYTHONSAFEPATH"] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ["PYTHONSAFEPATH"]
        else:
            os.environ["PYTHONSAFEPATH"] = before


@contextmanager
def _signals_held() -> Iterator[None]:
    """Block signals, also in processes that are started meanwhile, until these unblock them.

    A process that is starting cannot handle a signal yet and would end with a traceback.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _HELD)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _work(connection: Connection) -> None:
    """Do tasks until there are no more, in a process of its own."""
    _handle_signals()
    try:
        function = connection.recv()
        while True:
            _answer(connection, function, connection.recv())
    except (EOFError, OSError):
        pass  # the first process has no more tasks, or has ended
    finally:
        # The exit may have struck a library in the midst of its setup. Such a library can crash
        # when Python takes it down, so Python does not.
        if _exit_codes:
            os._exit(_exit_codes[0])


def _handle_signals() -> None:
    """Ignore Ctrl-C, and end without a message when the first process asks for it."""
    sys.unraisablehook = _report_unraisable
    for signum in _STOPPING:
        if signum == signal.SIGINT:
            signal.signal(signum, signal.SIG_IGN)
        elif signal.getsignal(signum) is not signal.SIG_IGN:
            signal.signal(signum, _stop)
    if hasattr(signal, "SIGALRM"):
        signal.signal(signal.SIGALRM, _raise_exit)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _HELD)


def _stop(signum: int, _: FrameType | None) -> None:
    # Nothing may interrupt the cleaning up. With SIG_IGN, Python would complain about a signal
    # that has already arrived and waits for its handler.
    for each in _STOPPING:
        signal.signal(each, _ignore)
    _exit_codes.append(128 + signum)
    _raise_exit_after(_RAISE_AGAIN_S)
    raise SystemExit(_exit_codes[0])


def _raise_exit_after(seconds: float) -> None:
    """Raise the exit again then: some libraries drop the exception or catch it."""
    if hasattr(signal, "setitimer"):
        signal.setitimer(signal.ITIMER_REAL, seconds)


def _raise_exit(_: int, __: FrameType | None) -> None:
    _raise_exit_after(_RAISE_AGAIN_S)
    raise SystemExit(_exit_codes[0])


def _ignore(_: int, __: FrameType | None) -> None:
    """Do nothing."""


def _report_unraisable(unraisable: Any) -> None:
    """Do not report a ``SystemExit`` that Python dropped, nor its consequences."""
    if _exit_codes and isinstance(unraisable.exc_value, SystemExit):
        _raise_exit_after(0.01)
    elif not (_exit_codes or isinstance(unraisable.exc_value, SystemExit)):
        sys.__unraisablehook__(unraisable)


def _answer(connection: Connection, function: Callable[..., Any], task: tuple[Any, ...]) -> None:
    try:
        answer = True, function(*task)
    except Exception as error:  # the first process raises it again
        if _exit_codes:
            raise
        error.add_note(f"in a process of its own:\n{traceback.format_exc()}")
        answer = False, error
    connection.send(answer)
