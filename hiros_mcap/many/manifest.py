"""The manifest of an output folder: the outcome of each log, so that a second run can resume.

The manifest is one JSON file. It is replaced as a whole, at most once a second, and once more at
the end; a run that is killed repeats at most the logs of that second.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, TypeAdapter, ValidationError

from hiros_mcap._version import __version__
from hiros_mcap.errors import ConfigError
from hiros_mcap.outputs import write_text
from hiros_mcap.wording import plain

Verdict = Literal["done", "doubtful", "recovered", "equal", "different", "skipped", "failed"]
"""done; doubtful: done, with warnings; recovered: done, with losses; equal and different: from a
golden file; skipped: not a log for this command; failed: see the error."""
_PERIOD_S = 1.0
_SHARE = 20  # a manifest that takes 1 s to write, as on a slow disk, is written every 20 s


def _checked_name(text: str) -> str:
    if text in ("", "..") or "\0" in text or Path(text).name != text:
        raise ValueError("names no file of the output folder")
    return text


FileName = Annotated[str, AfterValidator(_checked_name)]
"""A name without a folder: whoever changes a manifest must not choose where hiros writes."""


@dataclass(frozen=True, slots=True)
class Identity:
    """By which an input is known."""

    size: int  # Bytes; of a folder, those of its files
    modified: str  # time of the last change, or what a server gives instead
    sha256: str = ""


@dataclass(frozen=True, slots=True)
class LogRecord:
    """Outcome of one log."""

    log: str  # absolute path or address
    name: FileName  # by which its files in the output folder are called
    verdict: Verdict
    error: str = ""
    warnings: tuple[str, ...] = ()
    losses: str = ""  # losses of a damaged log, one line
    values: Mapping[str, Any] = field(default_factory=dict)
    """Values that were measured: columns of the table of all logs."""
    files: Mapping[FileName, int] = field(default_factory=dict)
    """Files in the output folder, with their size in bytes."""
    input: Identity = Identity(0, "")
    configuration: str = ""
    """SHA-256 of everything that the result depends on besides the log and the version."""
    version: str = __version__
    seconds: float = 0.0  # time that it took, s
    worker: str = ""  # which process did it
    bug: bool = False  # whether the error is a fault of hiros


@dataclass(frozen=True, slots=True)
class _Content:
    """The content of the file."""

    schema: Literal["hiros.manifest"]
    version: Literal[1]
    command: str
    logs: list[LogRecord]


_CONTENT = TypeAdapter(_Content)


class Manifest:
    """The records of a folder, by log; a manifest without a folder is kept in memory only."""

    def __init__(self, command: str, folder: Path | None = None) -> None:
        self.command = command
        self.records: dict[str, LogRecord] = {}
        self._file = None if folder is None else folder / f"hiros-{command}.json"
        self._next = 0.0
        self._changed = False
        if self._file is not None and self._file.exists():
            self.records = {record.log: record for record in self._read(self._file)}

    @staticmethod
    def _read(file: Path) -> Iterable[LogRecord]:
        try:
            return _CONTENT.validate_json(file.read_bytes()).logs
        except ValidationError:
            raise ConfigError(
                f"{file}: is not a manifest of this version of hiros; choose "
                "another folder, or remove the file to begin anew"
            ) from None

    def add(self, record: LogRecord) -> None:
        """Take note of what became of a log."""
        self.records[record.log] = record
        self._changed = True
        if time.monotonic() >= self._next:
            self.save()

    def save(self) -> None:
        """Write the manifest if there is anything new."""
        if self._file is None or not self._changed:
            return
        start = time.monotonic()
        logs = [self.records[log] for log in sorted(self.records)]
        data = plain(_Content("hiros.manifest", 1, self.command, logs))
        write_text(self._file, json.dumps(data, indent=1) + "\n")
        self._changed = False
        end = time.monotonic()
        self._next = end + max(_PERIOD_S, _SHARE * (end - start))

    def exported(self) -> Mapping[str, int]:
        """Return the size of every file that was written, by its name."""
        return {name: n for record in self.records.values() for name, n in record.files.items()}

    def knows(self, record: LogRecord, sizes: Mapping[str, int]) -> LogRecord | None:
        """Return the former record of a log if its result is still there and would be the same.

        ``record`` says what is to be done; ``sizes`` has the files of the folder. The content of
        the input is not compared here.
        """
        former = self.records.get(record.log)
        same = (
            former is not None
            and former.verdict != "failed"
            and former.configuration == record.configuration
            and former.version == record.version
            and former.name == record.name
            and former.input.size == record.input.size
            and all(sizes.get(name) == size for name, size in former.files.items())
        )
        return former if same else None
