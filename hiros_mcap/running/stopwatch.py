"""CPU time by step."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager

from hiros_mcap.frames import Block
from hiros_mcap.threads import cpu_time


class Stopwatch:
    """Adds up the CPU time of steps that pull from each other in one thread."""

    def __init__(self) -> None:
        self.cpu: defaultdict[str, float] = defaultdict(float)
        """Of each step, s."""
        self.started = time.perf_counter()
        self._running = ""
        self._since = cpu_time()

    def charge(self, name: str, seconds: float) -> None:
        """Add what another thread did for a step."""
        self.cpu[name] += seconds

    def _switch(self, name: str) -> str:
        """Charge the time since the last switch to what was running; return its name."""
        now = cpu_time()
        before = self._running
        self.cpu[before] += now - self._since
        self._running, self._since = name, now
        return before

    @contextmanager
    def timing(self, name: str) -> Iterator[None]:
        """Charge a block of statements to ``name``."""
        before = self._switch(name)
        try:
            yield
        finally:
            self._switch(before)

    def timed(
        self, name: str, blocks: Iterable[Block], sink: Callable[[Block], None]
    ) -> Iterator[Block]:
        """Yield ``blocks``, charging the making of each to ``name`` and its sink to "write"."""
        switch = self._switch
        before = switch(name)
        for block in blocks:
            switch("write")
            sink(block)
            switch(before)
            yield block
            del block  # else it would lie in memory until the next one is made
            before = switch(name)
        switch(before)
