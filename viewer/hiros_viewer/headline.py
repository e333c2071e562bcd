"""What pages and plots say about their log: when, how it was made, whether it can be trusted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from hiros_mcap.evaluate.logs import start_of
from hiros_mcap.io.attachments import stored_report
from hiros_mcap.io.log import open_reader
from hiros_mcap.regression.provenance import Provenance
from hiros_mcap.summary import quantity

_EPOCH_2001 = 1_000_000_000 * 1_000_000_000  # ns; earlier times are no dates


@dataclass(frozen=True, slots=True)
class Headline:
    """What stands below a title."""

    facts: tuple[str, ...]
    """When the log was recorded, and how the result was made."""
    warnings: tuple[str, ...]
    """Of the run that made the result."""

    def lines(self, *verdict: str) -> tuple[str, ...]:
        """Return the facts in a line, and the verdict in another."""
        warnings = quantity(len(self.warnings), "warning") if self.warnings else "no warnings"
        return "; ".join(self.facts), "; ".join([*filter(None, verdict), warnings])


def headline(path: Path) -> Headline:
    """Read what a log that hiros wrote says about itself; raises LogError if it is damaged."""
    facts = []
    start = start_of(path)
    if start > _EPOCH_2001:
        facts.append(f"recorded {datetime.fromtimestamp(start // 10**9, UTC):%Y-%m-%d %H:%M} UTC")
    run = Provenance.of_log(path).run
    if "version" in run:
        facts.append(f"hiros {run['version']}, system {run.get('system', '')}")
    return Headline(tuple(facts), tuple(_warnings(path)))


def _warnings(path: Path) -> Sequence[str]:
    with open_reader(path) as reader:
        return stored_report(reader).warnings
