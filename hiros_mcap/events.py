"""What the stages did besides their output: counted, so that nothing is dropped in silence."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import asdict, dataclass, field

TOO_LATE = "too late to be merged"
"""Counts whole messages, by source, that no result is made of: the merged time is past theirs."""


@dataclass(frozen=True, slots=True)
class Event:
    """Something that happened at an instant and that a person may want to see."""

    stamp: int
    """ns since the epoch."""
    kind: str
    """"track born", "track lost", "flip", "limbs calibrated", ..."""
    person: int
    """Id of the person, -1 if of nobody."""
    source: str
    """The camera, "" if of none."""
    detail: str


@dataclass(slots=True)
class Events:
    """Counters by (kind, source) and a list of notable instants, shared by the stages of a run."""

    counts: Counter[tuple[str, str]] = field(default_factory=Counter)
    log: list[Event] = field(default_factory=list)

    def count(self, kind: str, source: str = "", n: int = 1) -> None:
        """Add ``n`` to a counter."""
        if n:
            self.counts[kind, source] += n

    def note(
        self, stamp: int, kind: str, *, person: int = -1, source: str = "", detail: str = ""
    ) -> None:
        """Append an event to the log."""
        self.log.append(Event(stamp, kind, person, source, detail))

    def total(self, kind: str) -> int:
        """Sum of a counter over all sources."""
        return sum(n for (k, _), n in self.counts.items() if k == kind)

    def to_json(self) -> str:
        """Events by time, as the attachment of an output holds them."""
        events = sorted(self.log, key=lambda event: event.stamp)
        return json.dumps([asdict(event) for event in events], indent=0)


def events_from_json(text: str) -> list[Event]:
    """Read what :meth:`Events.to_json` returns; ValueError or TypeError if it is something else."""
    return [Event(**row) for row in json.loads(text)]
