"""A progress bar for people; nothing at all for a pipe."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

PERIOD_S = 0.1


@dataclass(frozen=True, slots=True)
class Bar:
    """Shows how far a run is; a bar without ``progress`` shows nothing."""

    progress: Progress | None = None
    task: TaskID | None = None

    def update(self, done: int, total: int) -> None:
        """Say that ``done`` of ``total`` is done, in whatever unit."""
        if self.progress is not None and self.task is not None:
            self.progress.update(self.task, completed=done, total=total)


@contextmanager
def bar(label: str, *, quiet: bool, always: bool = False) -> Iterator[Bar]:
    """Show a bar with the time that remains on stderr until the end.

    In a pipe it shows nothing unless ``always``; a notebook is a pipe that can show it.
    """
    is_plain = not sys.stderr.isatty() or os.environ.get("TERM") == "dumb"
    if quiet or (is_plain and not always):
        yield Bar()
        return
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        Progress,
        TaskProgressColumn,
        TextColumn,
        TimeRemainingColumn,
    )

    with Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TaskProgressColumn(),
        TimeRemainingColumn(),
        console=Console(stderr=True),
        transient=True,
        refresh_per_second=1 / PERIOD_S,
    ) as progress:
        yield Bar(progress, progress.add_task(label, total=None))
