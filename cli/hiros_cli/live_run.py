"""``hiros process`` with input that is still being written, or results that somebody waits for."""

from __future__ import annotations

import contextlib
import signal
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING

from hiros_cli.output import printable, warn
from hiros_mcap.errors import ConfigError
from hiros_mcap.progress import bar

if TYPE_CHECKING:
    from hiros_mcap.config import Config
    from hiros_mcap.io.container.file import Sink
    from hiros_mcap.io.container.live_input import LiveInput
    from hiros_mcap.io.live_log import LiveLog
    from hiros_mcap.io.ros_node import RosNode
    from hiros_mcap.running.process_options import ProcessOptions, Watcher
    from hiros_mcap.running.summary import Summary

STREAM = "-"
"""Stands for the standard input and the standard output."""
SOCKETS = ("ws://", "wss://")
GRAPH = "ros2://"


def is_live(logs: Sequence[str], outputs: Sequence[str], *, follow: bool) -> bool:
    """Whether the input is still being written, or somebody reads an output meanwhile."""
    return follow or not all(map(is_file, (*logs, *outputs)))


def is_file(source: str) -> bool:
    """Whether an input or an output is a file or a folder, no pipe, no server, and no graph."""
    return source != STREAM and not source.startswith(SOCKETS) and not is_graph(source)


def is_graph(source: str) -> bool:
    """Whether an input or an output is the graph of ROS 2; raises ConfigError for a part of it."""
    if source.startswith(GRAPH) and source != GRAPH:
        raise ConfigError(
            f"{source}: the ROS 2 graph is named {GRAPH}; --topic chooses its topics, and "
            "ROS_DOMAIN_ID another graph"
        )
    return source == GRAPH


def check_live(logs: Sequence[str], outputs: Sequence[str], *, follow: bool) -> None:
    """Raise ConfigError for an input or an output that cannot be live."""
    if len(logs) > 1:
        raise ConfigError("live input is one log; name one")
    (source,) = logs
    if is_file(source) and not follow:
        output = next(name for name in outputs if not is_file(name))
        raise ConfigError(
            f"-o {output}: only live input goes to a pipe or a server; add --follow, or read a "
            f"pipe: hiros process - -o {output} < {source}"
        )
    if len(set(outputs)) < len(outputs):
        raise ConfigError(f"-o {' -o '.join(outputs)}: an output is named twice")
    if not is_file(source) and follow:
        raise ConfigError(f"{source}: --follow is for a file; this input is live anyway")
    if is_file(source) and not Path(source).exists():
        raise ConfigError(f"{source}: does not exist yet; start the recording first")
    if is_file(source) and not Path(source).is_file():
        raise ConfigError(f"{source}: only an MCAP file can be followed")
    if not is_file(source) and not outputs:
        raise ConfigError(
            f"{source}: name the output: -o FILE, -o -, -o ws://HOST:PORT or -o {GRAPH}"
        )
    # Python knows the streams that were closed when it started.
    if source == STREAM and sys.__stdin__ is None:
        raise ConfigError("-: the standard input is closed; pipe an MCAP into hiros")
    if STREAM in outputs and sys.__stdout__ is None:
        raise ConfigError("-o -: the standard output is closed; pipe it into a program")
    if source == STREAM and sys.stdin.isatty():
        raise ConfigError("-: the standard input is a terminal; pipe an MCAP into hiros")
    if STREAM in outputs and sys.stdout.isatty():
        raise ConfigError(
            "-o -: the standard output is a terminal; pipe it into a program, or name a file"
        )


def run_live(
    source: str,
    wanted: Sequence[str],
    config: Config,
    options: ProcessOptions,
    watcher: Watcher | None,
    *,
    ros: Sequence[str] = (),
    quiet: bool,
) -> Summary:
    """Process until the input ends; see :func:`hiros_mcap.running.process_live.process_live`.

    ``ros`` are arguments of ROS 2.
    """
    from hiros_mcap.running.process_live import process_live

    def started(log: LiveLog) -> None:
        cameras = ", ".join(sorted(n for c in log.cameras for n in c.sources.values()))
        print(f"hiros: running on {cameras}; Ctrl-C ends the input", file=sys.stderr, flush=True)

    with contextlib.ExitStack() as stack:
        node = None
        if any(map(is_graph, (source, *wanted))):
            node = stack.enter_context(_node(ros))
        targets = [
            stack.enter_context(_output(name, node, options, quiet=quiet)) for name in wanted
        ]
        stream = stack.enter_context(_input(source, node, options))
        if not quiet:
            print(f"hiros: listening to {printable(_name(source))}", file=sys.stderr, flush=True)
        shown = stack.enter_context(bar("live", quiet=quiet, live=True))
        return process_live(
            stream,
            targets,
            config=config,
            options=options,
            watcher=watcher,
            started=None if quiet else started,
            progress=shown,
        )


@contextlib.contextmanager
def _node(arguments: Sequence[str]) -> Iterator[RosNode]:
    from hiros_mcap.io.ros_node import RosNode

    with contextlib.closing(RosNode(arguments)) as node:
        yield node


@contextlib.contextmanager
def _output(
    wanted: str, node: RosNode | None, options: ProcessOptions, *, quiet: bool
) -> Iterator[int | Path | Sink]:
    """Yield where the results go; a server is open from here on."""
    if node is not None and is_graph(wanted):
        from hiros_mcap.io.ros_output import RosOutput

        output = RosOutput(node, others=options.markers)
        if output.note:
            warn(output.note)
        yield output
        return
    if not wanted.startswith(SOCKETS):
        yield sys.__stdout__.fileno() if sys.__stdout__ and wanted == STREAM else Path(wanted)
        return
    from hiros_mcap.io.foxglove_server import FoxgloveServer

    with contextlib.ExitStack() as stack:
        server = FoxgloveServer(wanted)
        stack.callback(server.discard)
        if not quiet:
            print(f"hiros: serving the results at {server.url}", file=sys.stderr, flush=True)
        yield server


def _name(source: str) -> str:
    names = {STREAM: "the standard input", GRAPH: "the ROS 2 graph"}
    return names.get(source, source)


@contextlib.contextmanager
def _input(source: str, node: RosNode | None, options: ProcessOptions) -> Iterator[LiveInput]:
    """Yield the input; the first Ctrl-C or SIGTERM ends it.

    What was read by then is processed and written. A second signal stops the program.
    """
    from hiros_mcap.io.container.live_input import McapInput

    with contextlib.ExitStack() as stack:
        stream: LiveInput
        if source.startswith(SOCKETS):
            from hiros_mcap.io.foxglove import LARGEST, FoxgloveInput
            from hiros_mcap.running.process_live import subscription

            stream = FoxgloveInput(source, subscription(options), int(options.memory * LARGEST))
        elif node is not None and is_graph(source):
            from hiros_mcap.io.ros_input import RosInput
            from hiros_mcap.running.process_live import necessity, subscription

            stream = RosInput(node, subscription(options), necessity(options), warn)
        elif source == STREAM:
            stream = McapInput(sys.stdin.fileno(), _name(source))
        else:
            file = stack.enter_context(Path(source).open("rb", buffering=0))
            stream = McapInput(file.fileno(), source, follow=True)
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
