"""How far something is, for people: a bar on a terminal or in a notebook, nothing for a pipe."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress as RichProgress
    from rich.progress import TaskID


class Progress(Protocol):
    """Follows how far a run is."""

    def update(self, done: int, total: int) -> None:
        """Take note that ``done`` of ``total`` is done, in whatever unit; of a log, ns."""


@dataclass(frozen=True, slots=True)
class Bar:
    """Shows how far a run is; a bar without ``progress`` shows nothing."""

    progress: RichProgress | None = None
    task: TaskID | None = None
    live: bool = False
    """Whether a log has no end yet: then it shows how much of it has come."""

    def update(self, done: int, total: int) -> None:
        """Say that ``done`` of ``total`` is done, in whatever unit; of a live log, ns."""
        if self.progress is None or self.task is None:
            return
        if self.live:
            self.progress.update(self.task, description=f"live, {done * 1e-9:.0f} s of log")
        else:
            self.progress.update(self.task, completed=done, total=total)


@contextmanager
def bar(label: str, *, quiet: bool, notebook: bool = False, live: bool = False) -> Iterator[Bar]:
    """Show a bar with the time on stderr until the end.

    The time is what remains, or what has passed as long as nobody says how much there is to do.
    Without a terminal there is no bar, but where ``notebook`` allows it in one.
    """
    shown_on = None if quiet else _console(notebook=notebook)
    if shown_on is None:
        yield Bar()
        return
    from rich.progress import (
        BarColumn,
        Progress,
        Task,
        TaskProgressColumn,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )
    from rich.text import Text

    class Time(TimeRemainingColumn):
        def render(self, task: Task) -> Text:
            return super().render(task) if task.total else TimeElapsedColumn().render(task)

    with Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TaskProgressColumn(),
        Time(),
        console=shown_on,
        transient=True,
        refresh_per_second=10 if shown_on.color_system else 2,  # a notebook keeps every state
    ) as progress:
        yield Bar(progress, progress.add_task(label, total=None), live)


def _console(*, notebook: bool) -> Console | None:
    """Return where a bar can be seen, if anywhere."""
    from rich.console import Console

    if sys.stderr.isatty() and os.environ.get("TERM") != "dumb":
        return Console(stderr=True)
    if notebook and "ipykernel" in sys.modules:
        # Not rich's own way, which shows nothing unless ipywidgets are installed.
        return Console(
            stderr=True,
            color_system=None,
            force_jupyter=False,
            force_terminal=True,
            width=80,
        )
    return None
