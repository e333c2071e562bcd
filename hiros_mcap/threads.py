"""Several threads, for kernels: these run without the interpreter."""

from __future__ import annotations

import ctypes
import os
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from typing import TypeVar

T = TypeVar("T")

_LOCAL = threading.local()
_ARENA_MAX = -8  # M_ARENA_MAX in malloc.h


def cores() -> int:
    """Return how many cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def share_heap() -> None:
    """Let all threads of this process take memory from one place, for programs and workers.

    What one thread gives back, another can use: 20 to 40 MB less, where the C library is glibc.
    """
    if "MALLOC_ARENA_MAX" not in os.environ:
        with suppress(AttributeError, TypeError):
            ctypes.CDLL(None).mallopt(_ARENA_MAX, 1)


def give_back() -> None:
    """Return free memory to the system before large arrays are made, where the C library is glibc.

    Else what lies free between others stays with the process: 240 MB of 1100 in a large window.
    """
    with suppress(AttributeError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)


def run_each(calls: Sequence[Callable[[], object]]) -> None:
    """Make independent calls on all cores. Their CPU time counts as that of this thread."""
    waiting = iter(calls)  # which gives each call to one thread only

    def work() -> float:
        begin = time.thread_time()
        for call in waiting:
            call()
        return time.thread_time() - begin

    n = min(cores(), len(calls)) - 1
    if n < 1:
        work()
        return
    with ThreadPoolExecutor(n, thread_name_prefix="hiros-people") as pool:
        others = [pool.submit(work) for _ in range(n)]
        work()
    _LOCAL.cpu_s = _others_cpu() + sum(other.result() for other in others)


def beside(call: Callable[[], T]) -> Callable[[], T]:
    """Begin a call beside this thread; return what waits for its result.

    Its CPU time counts as that of the thread that waits.
    """

    def work() -> tuple[T, float]:
        begun = time.thread_time()
        result = call()
        return result, time.thread_time() - begun

    pool = ThreadPoolExecutor(1, thread_name_prefix="hiros-beside")
    future = pool.submit(work)
    pool.shutdown(wait=False)

    def wait() -> T:
        result, cpu_s = future.result()
        _LOCAL.cpu_s = _others_cpu() + cpu_s
        return result

    return wait


def cpu_time() -> float:
    """Return the CPU of this thread and of those that worked for it, s."""
    return time.thread_time() + _others_cpu()


def _others_cpu() -> float:
    return getattr(_LOCAL, "cpu_s", 0.0)
