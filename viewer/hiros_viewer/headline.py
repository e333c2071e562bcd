"""What pages and plots say about their log: when, how it was made, whether it can be trusted."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

from hiros_mcap.evaluate.logs import start_of
from hiros_mcap.io.attachments import stored_report
from hiros_mcap.io.log import open_reader
from hiros_mcap.regression.provenance import Provenance
from hiros_mcap.summary import quantity

_EPOCH_2001 = 1_000_000_000 * 1_000_000_000  # ns; earlier times are no dates


def about(path: Path, *verdict: str) -> tuple[str, str]:
    """Return when a log that hiros wrote was recorded and how it was made, and the verdict.

    Raises LogError if it is damaged.
    """
    facts = []
    start = start_of(path)
    if start > _EPOCH_2001:
        facts.append(f"recorded {datetime.fromtimestamp(start // 10**9, UTC):%Y-%m-%d %H:%M} UTC")
    run = Provenance.of_log(path).run
    if "version" in run:
        facts.append(f"hiros {run['version']}, system {run.get('system', '')}")
    with open_reader(path) as reader:
        n = len(stored_report(reader).warnings)
    warnings = quantity(n, "warning") if n else "no warnings"
    return "; ".join(facts), "; ".join([*filter(None, verdict), warnings])
