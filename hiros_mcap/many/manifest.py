"""The manifest of an output folder: the outcome of each log, so that a second run can resume.

It is a file of JSON lines: a head, then a record for each log that was done. Of several records of
a log the last one counts. A run that is killed repeats only the logs that it was at.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, TypeAdapter

from hiros_mcap._version import __version__
from hiros_mcap.errors import ConfigError
from hiros_mcap.wording import plain

Verdict = Literal["done", "doubtful", "recovered", "skipped", "failed"]
"""done; doubtful: done, with warnings; recovered: done, with losses; skipped: not a log for
this command; failed: see the error."""
HEAD = '{"schema": "hiros.manifest", "version": 2}'


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
    modified: str  # time of the last change, ns


@dataclass(frozen=True, slots=True)
class LogRecord:
    """Outcome of one log."""

    log: str  # absolute path
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
    bug: bool = False  # whether the error is a fault of hiros


_RECORD = TypeAdapter(LogRecord)


class Manifest:
    """The records of a folder, by log; a manifest without a folder is kept in memory only."""

    def __init__(self, command: str, folder: Path | None = None) -> None:
        self.records: dict[str, LogRecord] = {}
        self._file = None if folder is None else folder / f"hiros-{command}.jsonl"
        if self._file is not None and self._file.exists():
            self._read(self._file)

    def _read(self, file: Path) -> None:
        data = file.read_bytes()
        whole = data[: data.rfind(b"\n") + 1]
        head, *lines = whole.splitlines() or [HEAD.encode()]
        try:
            if head != HEAD.encode():
                raise ValueError
            records = map(_RECORD.validate_json, lines)
            self.records = {record.log: record for record in records}
        except ValueError:  # pydantic's is one, too
            raise ConfigError(
                f"{file}: is not a manifest of this version of hiros; choose "
                "another folder, or remove the file to begin anew"
            ) from None
        if whole != data:  # whoever wrote the last line was killed
            file.write_bytes(whole)

    def add(self, record: LogRecord) -> None:
        """Take note of what became of a log."""
        self.records[record.log] = record
        if self._file is not None:
            with self._file.open("a", encoding="utf-8") as file:
                head = "" if file.tell() else f"{HEAD}\n"
                file.write(f"{head}{json.dumps(plain(record))}\n")

    def exported(self) -> Mapping[str, int]:
        """Return the size of every file that was written, by its name."""
        return {name: n for record in self.records.values() for name, n in record.files.items()}

    def knows(self, record: LogRecord, sizes: Mapping[str, int]) -> LogRecord | None:
        """Return the former record of a log if its result is still there and would be the same.

        ``record`` says what is to be done; ``sizes`` has the files of the folder.
        """
        former = self.records.get(record.log)
        same = (
            former is not None
            and former.verdict != "failed"
            and former.configuration == record.configuration
            and former.version == record.version
            and former.name == record.name
            and former.input == record.input
            and all(sizes.get(name) == size for name, size in former.files.items())
        )
        return former if same else None
