"""``hiros process -`` and ``hiros process --follow``: input that is still being written."""

from __future__ import annotations

import contextlib
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING

import typer

from hiros_mcap.errors import ConfigError
from hiros_mcap.outputs import target_kind

if TYPE_CHECKING:
    from hiros_mcap.config import Config
    from hiros_mcap.io.container.live_reader import LiveInput
    from hiros_mcap.io.live_log import LiveLog
    from hiros_mcap.running.process_options import ProcessOptions, Watcher
    from hiros_mcap.summary import Summary

STREAM = "-"
"""Stands for the standard input and the standard output."""


def check_live(source: Path, output: str | None, *, follow: bool) -> None:
    """Raise ConfigError for an input or an output that cannot be live."""
    if str(source) != STREAM and not follow:
        raise ConfigError(
            "-o -: only live input goes to a pipe; add --follow, or read a pipe: hiros process - "
            f"-o - < {source}"
        )
    if str(source) == STREAM and follow:
        raise ConfigError("--follow is for a file; a pipe is followed anyway")
    if str(source) != STREAM and not source.is_file():
        raise ConfigError(f"{source}: only an MCAP file can be followed")
    if str(source) == STREAM and output is None:
        raise ConfigError("-: name the output: -o FILE, or -o - for a pipe")
    if str(source) == STREAM and sys.stdin.isatty():
        raise ConfigError("-: the standard input is a terminal; pipe an MCAP into hiros")
    if output == STREAM and sys.stdout.isatty():
        raise ConfigError(
            "-o -: the standard output is a terminal; pipe it into a program, or name a file"
        )
    if output is not None and target_kind(output) != "log":
        raise ConfigError(f"{output}: live input gives an MCAP file or a pipe, not a bag's folder")


def live_system(context: typer.Context, system: str) -> str:
    """Return the system to run: unless one is named, that which waits for nothing."""
    source = context.get_parameter_source("system")
    return "hiros-realtime" if source is None or source.name == "DEFAULT" else system


def run_live(
    source: Path,
    wanted: str,
    config: Config,
    options: ProcessOptions,
    watcher: Watcher | None,
    *,
    quiet: bool,
) -> Summary:
    """Process until the input ends; see :func:`hiros_mcap.running.live.process_live`."""
    from hiros_mcap.running.live import process_live

    def started(log: LiveLog) -> None:
        cameras = ", ".join(sorted(n for c in log.cameras for n in c.sources.values()))
        print(f"hiros: running on {cameras}; Ctrl-C ends the input", file=sys.stderr, flush=True)

    if not quiet:
        print(f"hiros: listening to {_name(source)}", file=sys.stderr, flush=True)
    with _input(source) as stream:
        return process_live(
            stream,
            sys.__stdout__.fileno() if wanted == STREAM and sys.__stdout__ else Path(wanted),
            config=config,
            options=options,
            watcher=watcher,
            started=None if quiet else started,
        )


@contextlib.contextmanager
def stdout_free(output: str) -> Iterator[None]:
    """Print on stderr whatever is printed, if stdout is the output itself."""
    with contextlib.redirect_stdout(sys.stderr) if output == STREAM else contextlib.nullcontext():
        yield


def _name(source: Path) -> str:
    return "the standard input" if str(source) == STREAM else str(source)


@contextlib.contextmanager
def _input(source: Path) -> Iterator[LiveInput]:
    """Yield the standard input, or a file that grows; the first Ctrl-C or SIGTERM ends it.

    What was read by then is processed and written. A second signal stops the program.
    """
    from hiros_mcap.io.container.live_reader import LiveInput

    with contextlib.ExitStack() as stack:
        if str(source) == STREAM:
            stream = LiveInput(sys.stdin.fileno(), _name(source))
        else:
            file = stack.enter_context(source.open("rb", buffering=0))
            stream = LiveInput(file.fileno(), _name(source), follow=True)
        before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

        def stop(*_: int | FrameType | None) -> None:
            stream.stop()
            restore()

        def restore() -> None:
            for number, handler in before.items():
                signal.signal(number, handler)

        for number, handler in before.items():
            if handler is not signal.SIG_IGN:
                signal.signal(number, stop)
        stack.callback(restore)
        yield stream
