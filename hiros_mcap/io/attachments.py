"""What a result holds besides skeletons: the parameters, the events and the summary of its run."""

from __future__ import annotations

import json
from collections.abc import Mapping

from pydantic import BaseModel, ConfigDict

from hiros_mcap.errors import LogError
from hiros_mcap.events import Event, events_from_json
from hiros_mcap.io.channels import CONFIG_ATTACHMENT, EVENTS_ATTACHMENT, REPORT_ATTACHMENT
from hiros_mcap.io.container import McapReader
from hiros_mcap.outside import parse


def stored_parameters(reader: McapReader) -> dict[str, str]:
    """Return ``section.parameter`` -> its value as JSON; nothing if the file holds none.

    Raises ConfigError if they are not TOML.
    """
    text = (reader.attachment(CONFIG_ATTACHMENT) or b"").decode(errors="replace")
    return values_of(text, f"{reader.path}: {CONFIG_ATTACHMENT}")


def values_of(text: str, origin: str) -> dict[str, str]:
    """Read a configuration in TOML like :func:`stored_parameters`; ``origin`` names it."""
    return {
        f"{section}.{name}": json.dumps(value, default=str)
        for section, values in parse(text, "TOML", origin).items()
        if isinstance(values, Mapping)
        for name, value in values.items()
    }


def stored_events(reader: McapReader) -> tuple[Event, ...]:
    """Return what the stages did; nothing if the file does not tell. Raises LogError."""
    try:
        return tuple(events_from_json((reader.attachment(EVENTS_ATTACHMENT) or b"[]").decode()))
    except ValueError:
        raise LogError(f"attachment {EVENTS_ATTACHMENT} is damaged", path=reader.path) from None


class _CameraReport(BaseModel):
    model_config = ConfigDict(extra="allow")
    name: str
    messages: int = 0
    used: int = 0


class StoredReport(BaseModel):
    """What is read of the summary of a run, :class:`hiros_mcap.summary.Summary`."""

    warnings: tuple[str, ...] = ()
    cameras: list[_CameraReport] = []


def stored_report(reader: McapReader) -> StoredReport:
    """Return the summary of the run, empty if the file holds none. Raises LogError."""
    try:
        return StoredReport.model_validate_json(reader.attachment(REPORT_ATTACHMENT) or b"{}")
    except ValueError:
        raise LogError(f"attachment {REPORT_ATTACHMENT} is damaged", path=reader.path) from None
