"""Several processes that work through a list of tasks, and stop when they are told to.

A Ctrl-C reaches every process of a terminal. Here the first process alone decides: it stops the
others, which clean up after themselves and say nothing.
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

_PATIENCE_S = 10.0
_AGAIN_S = 2.0
_NAMES = ("SIGINT", "SIGTERM", "SIGHUP")
_told_to_leave: list[int] = []
"""The exit code, in a process that the first one has stopped."""
_STOPPING = [getattr(signal, name) for name in _NAMES if hasattr(signal, name)]
_HELD = [*_STOPPING, *([signal.SIGALRM] if hasattr(signal, "SIGALRM") else [])]
"""Those, and that by which a program may put what they mean off."""


def run_tasks(
    function: Callable[..., Result], tasks: Sequence[tuple[Any, ...]], jobs: int = 0
) -> Iterator[tuple[int, Result]]:
    """Yield (number of the task, what the function gives for it) as they get ready.

    Parameters
    ----------
    function : of a module, so that other processes find it. tasks : its arguments.
    jobs : processes at once; 0 = one per core that this process may use. With one, everything
        happens in this process.

    Raises
    ------
    HirosError
        A process was killed. What ``function`` raises is raised here, and the others are stopped.
    """
    n = min(jobs or _cores(), len(tasks))
    if n <= 1:
        for k, task in enumerate(tasks):
            yield k, function(*task)
        return
    crew = _Crew()
    try:
        crew.hire(n)
        yield from crew.work(function, tasks)
    except BaseException:
        crew.stop()
        raise
    finally:
        crew.dismiss()


def _cores() -> int:
    """Return how many cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


class _Crew:
    """The processes, each with the pipe to it."""

    def __init__(self) -> None:
        self._workers: dict[Connection, SpawnProcess] = {}

    def hire(self, n: int) -> None:
        """Start ``n`` processes."""
        context = get_context("spawn")
        with _safe_path():
            if os.name == "posix":
                # Started later, it would lift the block of the signals.
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
        """Hand out the tasks in order, a new one to whoever is ready."""
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
            raise self._lost(connection) from None

    def _receive(self, connection: Connection) -> Any:
        try:
            succeeded, result = connection.recv()
        except (EOFError, OSError):
            raise self._lost(connection) from None
        if not succeeded:
            raise result
        return result

    def _lost(self, connection: Connection) -> HirosError:
        worker = self._workers[connection]
        worker.join(_PATIENCE_S)
        code = worker.exitcode or 0
        how = f"was killed by signal {-code}" if code < 0 else f"ended with code {code}"
        return HirosError(f"a process {how}; is there enough memory? --jobs 1 takes the least")

    def stop(self) -> None:
        """Interrupt whoever is at work."""
        for worker in self._workers.values():
            worker.terminate()

    def dismiss(self) -> None:
        """Wait until all have ended, but not for ever."""
        for connection in self._workers:
            connection.close()
        for worker in self._workers.values():
            worker.join(_PATIENCE_S)
            if worker.is_alive():
                worker.kill()
                worker.join()


@contextmanager
def _safe_path() -> Iterator[None]:
    """Have processes that are started in the block not take modules from the current folder.

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
    """Put signals off, also for processes that are started in the block, for as long as they like.

    A process that begins cannot handle a signal yet: it would end with a traceback.
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
    _obey()
    try:
        function = connection.recv()
        while True:
            _answer(connection, function, connection.recv())
    except (EOFError, OSError):
        return  # the first process has no more tasks, or is gone
    except Exception:
        # Python turns what is raised while it makes a class into an error of its own.
        if _told_to_leave:
            raise SystemExit(_told_to_leave[0]) from None
        raise


def _obey() -> None:
    """Leave Ctrl-C to the first process, and end quietly when that says so."""
    sys.unraisablehook = _only_faults
    for signum in _STOPPING:
        if signum == signal.SIGINT:
            signal.signal(signum, signal.SIG_IGN)
        elif signal.getsignal(signum) is not signal.SIG_IGN:
            signal.signal(signum, _leave)
    if hasattr(signal, "SIGALRM"):
        signal.signal(signal.SIGALRM, _insist)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _HELD)


def _leave(signum: int, _: FrameType | None) -> None:
    # Nothing shall interrupt the cleaning up. SIG_IGN would make Python complain about a signal
    # that has already come and waits for its handler.
    for each in _STOPPING:
        signal.signal(each, _go_on)
    _told_to_leave.append(128 + signum)
    _insist_after(_AGAIN_S)
    raise SystemExit(_told_to_leave[0])


def _insist_after(seconds: float) -> None:
    """Leave once more then: some libraries drop the exception, or catch it and go on."""
    if hasattr(signal, "setitimer"):
        signal.setitimer(signal.ITIMER_REAL, seconds)


def _insist(_: int, __: FrameType | None) -> None:
    _insist_after(_AGAIN_S)
    raise SystemExit(_told_to_leave[0])


def _go_on(_: int, __: FrameType | None) -> None:
    """Do nothing."""


def _only_faults(unraisable: Any) -> None:
    """Keep quiet about a ``SystemExit`` that Python dropped, and about what comes of it."""
    if _told_to_leave and isinstance(unraisable.exc_value, SystemExit):
        _insist_after(0.01)
    elif not (_told_to_leave or isinstance(unraisable.exc_value, SystemExit)):
        sys.__unraisablehook__(unraisable)


def _answer(connection: Connection, function: Callable[..., Any], task: tuple[Any, ...]) -> None:
    try:
        answer = True, function(*task)
    except Exception as error:  # raised again by whoever asked for the task
        if _told_to_leave:
            raise
        error.add_note(f"in a process of its own:\n{traceback.format_exc()}")
        answer = False, error
    connection.send(answer)
