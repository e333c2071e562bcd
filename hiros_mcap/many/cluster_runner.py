"""Tasks on a cluster of Dask: one that runs already, or one of this machine."""

from __future__ import annotations

import logging
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from hiros_mcap._version import __version__
from hiros_mcap.errors import ConfigError, HirosError
from hiros_mcap.io import remote
from hiros_mcap.threads import cores
from hiros_mcap.workers import ATTEMPTS

if TYPE_CHECKING:
    from hiros_mcap.many.run_logs import Runner

Answer = TypeVar("Answer")

LOCAL = "local"
_PATIENCE_S = 60.0
"""How long a cluster may be without any worker."""
_CONNECT_S = 10.0
_WAKE_S = 5.0
_AHEAD = 4
"""Tasks per thread of the cluster that are handed over: enough for one that grows on demand."""


def on_cluster(address: str, paths: Sequence[str], jobs: int = 0) -> Runner:
    """Return a runner that works on a cluster.

    Parameters
    ----------
    address : of the scheduler, or its scheduler file (.json), or "local": a cluster of processes
        on this machine that ends with the run.
    paths : what every worker must see under the same path; addresses of stores are not checked.
    jobs : processes of a local cluster; 0 = one per core.
    """

    def run(
        function: Callable[..., Answer],
        tasks: Sequence[tuple[Any, ...]],
        *,
        lost: Callable[[int, str], Answer],
    ) -> Iterator[tuple[int, Answer]]:
        if not tasks:
            return
        with _client(address, jobs or cores()) as client:
            _check_workers(client, [path for path in paths if not remote.is_remote(path)])
            yield from _work(client, function, tasks, lost)

    return run


@contextmanager
def _client(address: str, n: int) -> Iterator[Any]:
    """Connect to a cluster, or start one. Raises ConfigError."""
    try:
        import dask
        from distributed import Client, LocalCluster
    except ImportError as error:
        raise ConfigError(
            f'--cluster needs further libraries: pip install "dask[distributed]" ({error})'
        ) from None
    # The libraries report what the caller gets as an answer or an exception, too.
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    with ExitStack() as stack:
        if address == LOCAL:
            # A worker that dies takes one task with it; the scheduler counts how often.
            failures = {"distributed.scheduler.allowed-failures": ATTEMPTS - 1}
            stack.enter_context(dask.config.set(failures))
            cluster = LocalCluster(
                n_workers=n,
                threads_per_worker=1,
                host="127.0.0.1",
                dashboard_address=None,
                preload=__name__,
                silence_logs=logging.CRITICAL,
            )
            address = stack.enter_context(cluster)
        keyword = "scheduler_file" if str(address).endswith(".json") else "address"
        try:
            client = stack.enter_context(Client(**{keyword: address}, timeout=_CONNECT_S))
        except (OSError, ValueError) as error:
            raise ConfigError(
                f"--cluster {address}: no scheduler answers there; start one with `dask scheduler` "
                f"({error})"
            ) from None
        yield client


def dask_setup(_: Any) -> None:
    """Let a worker of a local cluster ignore Ctrl-C, which reaches every process of a terminal.

    The first process stops it. Dask calls this by its name when a worker starts.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _check_workers(client: Any, paths: Sequence[str]) -> None:
    """Refuse a cluster without workers, with another hiros, or that does not see the paths."""
    try:
        client.wait_for_workers(1, timeout=_PATIENCE_S)
    except TimeoutError:
        raise ConfigError(
            "the cluster has no workers; start some with `dask worker ADDRESS --nthreads 1`"
        ) from None
    for worker, seen in client.run(_seen, list(paths), on_error="return").items():
        if isinstance(seen, Exception):
            raise ConfigError(f"worker {worker} has no hiros that runs ({seen}); install it there")
        version, missing = seen
        if version != __version__:
            raise ConfigError(
                f"worker {worker} has hiros {version}, and this is {__version__}; install the same "
                "version everywhere"
            )
        if missing:
            raise ConfigError(
                f"worker {worker} does not see {missing[0]}; logs and results must be in folders "
                "that all workers have under the same path, or at addresses such as s3://..."
            )


def _seen(paths: Sequence[str]) -> tuple[str, list[str]]:
    """Return the version of a worker, and the paths that it does not see."""
    from hiros_mcap import __version__ as version

    return version, [path for path in paths if not Path(path).exists()]


def _work(
    client: Any,
    function: Callable[..., Answer],
    tasks: Sequence[tuple[Any, ...]],
    lost: Callable[[int, str], Answer],
) -> Iterator[tuple[int, Answer]]:
    """Hand out the tasks in order, some ahead of time, and collect the answers.

    A task that lost its workers may only have waited beside one that killed them. Such tasks run
    again at the end, one at a time.
    """
    from distributed import KilledWorker

    waiting, running = list(reversed(range(len(tasks)))), dict[Any, int]()
    suspects: list[int] = []
    try:
        while waiting or running:
            threads = sum(client.nthreads().values())
            while waiting and len(running) < max(1, _AHEAD * threads):
                k = waiting.pop()
                running[client.submit(function, *tasks[k], pure=False)] = k
            for future in _finished(client, list(running)):
                if future.status in {"lost", "pending"}:
                    continue  # the worker died with the answer: the cluster does the task again
                k = running.pop(future)
                if future.status == "error" and isinstance(future.exception(), KilledWorker):
                    suspects.append(k)
                else:
                    yield k, _answer(future, k, lost)
        for k in suspects:
            future = client.submit(function, *tasks[k], pure=False)
            running[future] = k
            _finished(client, [future])
            del running[future]
            yield k, _answer(future, k, lost)
    finally:
        client.cancel(list(running), force=True)


def _finished(client: Any, futures: Sequence[Any]) -> list[Any]:
    """Return the futures that are over, at least one. Raises HirosError if no worker is left."""
    from distributed import wait

    last_seen = time.monotonic()
    while True:
        try:
            return list(wait(futures, timeout=_WAKE_S, return_when="FIRST_COMPLETED").done)
        except TimeoutError:
            pass
        if client.status != "running":
            raise HirosError("the connection to the cluster is lost; the same command goes on")
        if client.nthreads():
            last_seen = time.monotonic()
        elif time.monotonic() - last_seen > _PATIENCE_S:
            raise HirosError("the cluster has no workers any more; the same command goes on")


def _answer(future: Any, k: int, lost: Callable[[int, str], Answer]) -> Answer:
    """Return what a task gave; raises its error, or HirosError if the cluster dropped it."""
    from distributed.scheduler import KilledWorker

    if future.status == "finished":
        answer: Answer = future.result()
        return answer
    if future.status != "error":
        raise HirosError("the connection to the cluster is lost; the same command goes on")
    error = future.exception()
    if isinstance(error, KilledWorker):
        return lost(k, "the cluster gave it up; is there enough memory on the workers?")
    raise error
