"""Several processes that work through a list of tasks.

A Ctrl-C reaches every process of a terminal. The workers never notice it: the first process ends
them, and removes what they had in temporary folders.
"""

from __future__ import annotations

import os
import shutil
import signal
import tempfile
import threading
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import active_children, get_context, parent_process, resource_tracker
from queue import SimpleQueue
from typing import Any, TypeVar

from hiros_mcap.errors import HirosError
from hiros_mcap.threads import cores, share_heap

Result = TypeVar("Result")

ATTEMPTS = 2
"""Times that a task is tried which kills its process: memory may be short only for a while."""
_BLOCKED = {getattr(signal, n) for n in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, n)}


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

    Raises HirosError if a process was killed, and there is no ``lost``. Errors of ``function`` are
    raised here, and the others are stopped.
    """
    n = min(jobs or cores(), len(tasks))
    if n <= 1:
        for k, task in enumerate(tasks):
            yield k, function(*task)
        return
    with tempfile.TemporaryDirectory(prefix="hiros-") as folder:
        pool: list[_Worker] = []
        try:
            pool += (_Worker(folder) for _ in range(n))
            yield from _work(pool, function, tasks, lost)
        except BaseException:
            for worker in pool:
                worker.kill()
            raise
        finally:
            for worker in pool:
                worker.close()


def _work(
    pool: Sequence[_Worker],
    function: Callable[..., Result],
    tasks: Sequence[tuple[Any, ...]],
    lost: Callable[[int, str], Result] | None,
) -> Iterator[tuple[int, Result]]:
    """Hand out the tasks in order, the next one to the first process that is ready."""
    waiting, deaths = deque(range(len(tasks))), Counter[int]()
    idle, busy = deque(pool), dict[Future[Result], tuple[int, _Worker]]()
    ready: SimpleQueue[Future[Result]] = SimpleQueue()

    def hand_out() -> None:
        while idle and waiting:
            k, worker = waiting.popleft(), idle.popleft()
            future = worker.submit(function, *tasks[k])
            busy[future] = k, worker
            future.add_done_callback(ready.put)

    hand_out()
    while busy:
        future = ready.get()
        k, worker = busy.pop(future)
        idle.append(worker)
        try:
            result = future.result()
        except BrokenProcessPool:
            why = worker.restart()
            deaths[k] += 1
            if lost is None:
                raise HirosError(why) from None
            if deaths[k] < ATTEMPTS:
                waiting.append(k)
                hand_out()
                continue
            result = lost(k, why)
        hand_out()  # before whoever asks takes their time with the result
        yield k, result


class _Worker:
    """A process with a pool of its own: if it is killed, no other task is lost with it."""

    def __init__(self, folder: str) -> None:
        self._folder = folder
        self._start()

    def _start(self) -> None:
        before = active_children()
        with _starting():
            self._pool = ProcessPoolExecutor(1, get_context("spawn"), _set_up, (self._folder,))
            self.submit(int)
        (self._process,) = set(active_children()) - set(before)

    def submit(self, function: Callable[..., Result], *task: Any) -> Future[Result]:
        try:
            return self._pool.submit(function, *task)
        except BrokenProcessPool as error:  # it was killed between two tasks
            future: Future[Result] = Future()
            future.set_exception(error)
            return future

    def restart(self) -> str:
        """Start another process after the end of the first; return how that ended."""
        self._pool.shutdown()
        code = self._process.exitcode or 0
        self._start()
        how = f"was killed by signal {-code}" if code < 0 else f"ended with code {code}"
        return f"a process {how}; is there enough memory? --jobs 1 needs the least"

    def kill(self) -> None:
        self._process.kill()

    def close(self) -> None:
        """Wait until the process has ended; kill it if that takes too long."""
        self._pool.shutdown(wait=False, cancel_futures=True)
        self._process.join(10.0)
        self._process.kill()


@contextmanager
def _starting() -> Iterator[None]:
    """Let a new process import nothing from the current folder, and have the signals blocked.

    It gets this process's path afterwards.
    """
    safe_path, masks = os.environ.get("PYTHONSAFEPATH"), hasattr(signal, "pthread_sigmask")
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _BLOCKED) if masks else set()
    os.environ["PYTHONSAFEPATH"] = "1"
    try:
        if masks:
            resource_tracker.ensure_running()  # unblocks some of them
            signal.pthread_sigmask(signal.SIG_BLOCK, _BLOCKED)
        yield
    finally:
        del os.environ["PYTHONSAFEPATH"]
        if safe_path is not None:
            os.environ["PYTHONSAFEPATH"] = safe_path
        if masks:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _set_up(folder: str) -> None:
    """Prepare a worker: its temporary files, and its end if the first process is killed."""
    share_heap()
    tempfile.tempdir = folder
    threading.Thread(target=_end_with_parent, args=(folder,), daemon=True).start()


def _end_with_parent(folder: str) -> None:
    parent = parent_process()
    if parent is not None:
        parent.join()
        shutil.rmtree(folder, ignore_errors=True)
        os._exit(1)
