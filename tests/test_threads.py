"""Calls that several threads share."""

from __future__ import annotations

import threading
import time

import pytest

from hiros_mcap import threads


@pytest.fixture(autouse=True)
def _three_cores(monkeypatch):
    monkeypatch.setattr(threads, "cores", lambda: 3)


def test_every_call_is_made_once_and_by_several_threads():
    made = []
    ready = threading.Barrier(3, timeout=60)

    def call(k):
        if k < 3:  # the first three wait for each other, each in its own thread
            ready.wait()
        made.append(k)

    threads.run_each([lambda k=k: call(k) for k in range(50)])
    assert sorted(made) == list(range(50))


@pytest.mark.parametrize("n", [1, 4])
def test_an_error_reaches_who_calls(n):
    def fail():
        raise ValueError("no")

    with pytest.raises(ValueError, match="no"):
        threads.run_each(n * [fail])


def test_their_cpu_is_that_of_the_thread_which_asked():
    used = []
    ready = threading.Barrier(3, timeout=60)

    def call():
        begin = time.thread_time()
        ready.wait()
        sum(range(10**6))
        used.append(time.thread_time() - begin)

    begin = threads.cpu_time()
    threads.run_each(3 * [call])
    assert threads.cpu_time() - begin >= sum(used)


def test_a_call_beside_this_thread_goes_on_until_its_result_is_wanted():
    go_on = threading.Event()

    def call():
        assert go_on.wait(60)  # this thread is not held up
        return threading.get_ident()

    wait = threads.beside(call)
    go_on.set()
    assert wait() != threading.get_ident()


def test_an_error_beside_this_thread_comes_with_the_result():
    def fail():
        raise ValueError("no")

    wait = threads.beside(fail)
    with pytest.raises(ValueError, match="no"):
        wait()


def test_the_cpu_beside_this_thread_counts_when_the_result_is_taken():
    used = []

    def call():
        begin = time.thread_time()
        sum(range(10**6))
        used.append(time.thread_time() - begin)

    begin = threads.cpu_time()
    threads.beside(call)()
    assert threads.cpu_time() - begin >= used[0]
