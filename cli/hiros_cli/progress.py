"""A progress bar for people; nothing at all for a pipe."""

from __future__ import annotations

import os
import sys
from types import TracebackType
from typing import Protocol, Self

PERIOD_S = 0.1


class Bar(Protocol):
    """A context in which progress is shown."""

    def __enter__(self) -> Self: ...
    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None: ...
    def update(self, done: int, total: int) -> None:
        """Say that ``done`` of ``total`` is done, in whatever unit."""


class NoBar:
    """Shows nothing."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        pass

    def update(self, done: int, total: int) -> None:
        """Nothing to show."""


class TerminalBar:
    """A bar with the time that remains, on stderr, removed at the end."""

    def __init__(self, label: str) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn
        from rich.progress import TimeRemainingColumn as Remaining

        self._progress = Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            TaskProgressColumn(),
            Remaining(),
            console=Console(stderr=True),
            transient=True,
            refresh_per_second=1 / PERIOD_S,
        )
        self._task = self._progress.add_task(label, total=None)

    def __enter__(self) -> Self:
        self._progress.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._progress.stop()

    def update(self, done: int, total: int) -> None:
        """Move the bar."""
        self._progress.update(self._task, completed=done, total=total)


def bar(label: str, *, quiet: bool) -> Bar:
    """Return a bar on a terminal, and the one that shows nothing otherwise."""
    if quiet or not sys.stderr.isatty() or os.environ.get("TERM") == "dumb":
        return NoBar()
    return TerminalBar(label)
