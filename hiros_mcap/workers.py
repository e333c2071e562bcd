"""Several processes that work through a list of tasks.

A Ctrl-C reaches every process of a terminal. The workers ignore it: the first process stops them,
and they clean up without a message.
"""

from __future__ import annotations

import os
import signal
import sys
import traceback
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing import get_context, resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from types import FrameType
from typing import Any, TypeVar

from hiros_mcap.errors import HirosError

Result = TypeVar("Result")

ATTEMPTS = 2
"""Times that a task is tried which kills its process: memory may be short only for a while."""
_JOIN_S = 10.0
_RAISE_AGAIN_S = 2.0
_NAMES = ("SIGINT", "SIGTERM", "SIGHUP")
_exit_codes: list[int] = []
"""The exit code of a worker that the first process has stopped."""
_STOPPING = [getattr(signal, name) for name in _NAMES if hasattr(signal, name)]
_HELD = [*_STOPPING, *([signal.SIGALRM] if hasattr(signal, "SIGALRM") else [])]
"""Those, and the alarm that :func:`_raise_exit_after` sets."""


def run_tasks(
    function: Callable[..., Result],
    tasks: Sequence[tuple[Any, ...]],
    jobs: int = 0,
    lost: Callable[[int, str], Result] | None = None,
) -> Iterator[tuple[int, Result]]:
    """Yield (number of the task, result of the function) as they get ready.

    Parameters
    ----------
    function : at the top level of a module. tasks : its arguments.
    jobs : processes at once; 0 = one per core that this process may use. With 1, this process
        does everything.
    lost : gives the result of a task, by its number and what happened, that killed its process
        :data:`ATTEMPTS` times. The others go on in new processes.

    Raises
    ------
    HirosError
        A process was killed, and there is no ``lost``. Errors of ``function`` are raised here, and
        the others are stopped.
    """
    n = min(jobs or cores(), len(tasks))
    if n <= 1:
        for k, task in enumerate(tasks):
            yield k, function(*task)
        return
    pool = _Pool(function)
    try:
        pool.start(n)
        yield from pool.work(tasks, lost)
    except BaseException:
        pool.stop()
        raise
    finally:
        pool.close()


def cores() -> int:
    """Return how many cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


class _EndedError(HirosError):
    """A process ended before it gave its answer."""


class _Pool:
    """The processes, each with the pipe to it."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function
        self._workers: dict[Connection, SpawnProcess] = {}

    def start(self, n: int) -> list[Connection]:
        """Start ``n`` processes; return the pipes to them."""
        context = get_context("spawn")
        started = []
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
                    self._send(ours, self._function)
                    started.append(ours)
        return started

    def work(
        self, tasks: Sequence[tuple[Any, ...]], lost: Callable[[int, str], Any] | None
    ) -> Iterator[tuple[int, Any]]:
        """Hand out the tasks in order, the next one to the first process that is ready."""
        waiting, deaths = deque(range(len(tasks))), Counter[int]()
        idle, busy = list(self._workers), dict[Connection, int]()

        def hand_out() -> None:
            while idle and waiting:
                connection = idle.pop(0)
                busy[connection] = waiting.popleft()
                self._send(connection, tasks[busy[connection]])

        hand_out()
        while busy:
            ready = set(wait(list(busy)))
            for connection in [each for each in busy if each in ready]:
                k = busy.pop(connection)
                try:
                    result = self._receive(connection)
                except _EndedError as end:
                    if lost is None:
                        raise
                    deaths[k] += 1
                    idle += self._replace(connection)
                    if deaths[k] < ATTEMPTS:
                        waiting.append(k)
                        hand_out()
                        continue
                    result = lost(k, str(end))
                else:
                    idle.append(connection)
                hand_out()  # before whoever asks takes their time with the result
                yield k, result

    def _replace(self, connection: Connection) -> list[Connection]:
        """Forget a process that has ended, and start another one."""
        connection.close()
        del self._workers[connection]
        return self.start(1)

    def _send(self, connection: Connection, item: object) -> None:
        # Of a process that has ended, reading the answer will say so.
        with suppress(OSError):
            connection.send(item)

    def _receive(self, connection: Connection) -> Any:
        try:
            succeeded, result = connection.recv()
        except (EOFError, OSError):
            raise self._ended(connection) from None
        if not succeeded:
            raise result
        return result

    def _ended(self, connection: Connection) -> _EndedError:
        worker = self._workers[connection]
        worker.join(_JOIN_S)
        code = worker.exitcode or 0
        how = f"was killed by signal {-code}" if code < 0 else f"ended with code {code}"
        return _EndedError(f"a process {how}; is there enough memory? --jobs 1 needs the least")

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
