"""Tasks on a cluster of Dask that runs already."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from hiros_mcap._version import __version__
from hiros_mcap.errors import ConfigError, HirosError
from hiros_mcap.io import remote

if TYPE_CHECKING:
    from hiros_mcap.many.run_logs import Runner

Answer = TypeVar("Answer")

_PATIENCE_S = 60.0
"""How long to wait for the first worker."""
_CONNECT_S = 10.0


def on_cluster(address: str, paths: Sequence[str]) -> Runner:
    """Return a runner that works on a cluster.

    Parameters
    ----------
    address : of the scheduler, or its scheduler file (.json).
    paths : what every worker must see under the same path; addresses of stores are not checked.
    """

    def run(
        function: Callable[..., Answer],
        tasks: Sequence[tuple[Any, ...]],
        *,
        lost: Callable[[int, str], Answer],
    ) -> Iterator[tuple[int, Answer]]:
        if not tasks:
            return
        with _client(address) as client:
            _check_workers(client, [path for path in paths if not remote.is_remote(path)])
            yield from _work(client, function, tasks, lost)

    return run


@contextmanager
def _client(address: str) -> Iterator[Any]:
    """Connect to a cluster. Raises ConfigError."""
    try:
        from distributed import Client
    except ImportError as error:
        raise ConfigError(
            f'--cluster needs further libraries: pip install "dask[distributed]" ({error})'
        ) from None
    # The library reports what the caller gets as an answer or an exception, too; some of its
    # loggers have a level of their own.
    for name in [*logging.root.manager.loggerDict]:
        if name.partition(".")[0] == "distributed":
            logging.getLogger(name).setLevel(logging.CRITICAL)
    keyword = "scheduler_file" if address.endswith(".json") else "address"
    if keyword == "scheduler_file":
        _await(Path(address))
    try:
        client = Client(**{keyword: address}, timeout=_CONNECT_S)
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"--cluster {address}: no scheduler answers there; start one with `dask scheduler` "
            f"({error})"
        ) from None
    with client:
        yield client


def _await(file: Path) -> None:
    """Give a scheduler that has just been started the time to write its file.

    Raises ConfigError if it does not; the library would wait for longer, and without a word.
    """
    end = time.monotonic() + _CONNECT_S
    while not file.is_file():
        if time.monotonic() > end:
            raise ConfigError(
                f"--cluster {file}: there is no such file; `dask scheduler --scheduler-file "
                f"{file}` writes it"
            )
        time.sleep(0.1)


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
    from hiros_mcap._version import __version__ as version

    return version, [path for path in paths if not Path(path).exists()]


def _work(
    client: Any,
    function: Callable[..., Answer],
    tasks: Sequence[tuple[Any, ...]],
    lost: Callable[[int, str], Answer],
) -> Iterator[tuple[int, Answer]]:
    """Hand out all tasks and yield the answers as they come; the cluster repeats lost ones.

    A task whose workers were killed may only have waited beside one that killed them. Such tasks
    run again at the end, one at a time.
    """
    from distributed import KilledWorker, as_completed

    futures = {client.submit(function, *task, pure=False): k for k, task in enumerate(tasks)}
    suspects = []
    try:
        for future in as_completed(futures):
            try:
                answer = future.result()
            except KilledWorker:
                suspects.append(futures[future])
                continue
            yield futures[future], answer
        for k in suspects:
            try:
                answer = client.submit(function, *tasks[k], pure=False).result()
            except KilledWorker:
                answer = lost(k, "the cluster gave it up; is there enough memory on the workers?")
            yield k, answer
    except CancelledError:
        raise HirosError(
            "the connection to the cluster is lost; the same command goes on"
        ) from None
