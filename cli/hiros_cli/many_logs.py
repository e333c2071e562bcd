"""A command that was given many logs: how far it is, what came of each, and the totals."""

from __future__ import annotations

import os
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from typer import Exit

from hiros_cli.exit_codes import BAD_INPUT, BUG, LOSSES
from hiros_cli.options import FORCE, JSON, MANY, QUIET, option
from hiros_cli.output import check_outputs, print_json, printable, warn
from hiros_mcap.errors import ConfigError
from hiros_mcap.progress import bar
from hiros_mcap.wording import quantity

if TYPE_CHECKING:
    from hiros_mcap.many.jobs import Job
    from hiros_mcap.many.manifest import LogRecord

_ALL_ROWS = 40
_LONGEST_REASON = 200  # logs up to which the table has a row for each


@dataclass(frozen=True, slots=True)
class ManyLogs:
    """Options of commands that take many logs."""

    jobs: int | None = option(
        "NUMBER",
        "Logs at once; 0 = one per core. With it, one log is treated as many are.",
        min=0,
        show_default="0",
        panel=MANY,
    )
    csv: Path | None = option("FILE", "Also write the table of all logs as CSV.", panel=MANY)
    force: bool = FORCE
    json: bool = JSON
    quiet: bool = QUIET

    def wanted(self, logs: Sequence[str], folder: str = "", **for_one: object) -> bool:
        """Whether there is more than one log, or one is to be treated so.

        Raises ConfigError for an option of ``for_one`` log if there are many, and the reverse; and
        for an address.
        """
        from hiros_mcap.many.find import are_many

        for name in (*logs, folder):
            if "://" in name:
                raise ConfigError(
                    f"{name}: is an address; hiros reads and writes files of this machine, so copy "
                    "them with the store's own tools, such as `aws s3 sync`"
                )
        if self.jobs is None and not are_many(logs):
            self.refuse_alone()
            return False
        for name, value in for_one.items():
            if value:
                option_name = name.replace("_", "-")
                raise ConfigError(f"--{option_name} is for one log, and there are many")
        return True

    def refuse_alone(self) -> None:
        """Refuse options that are for many logs; raises ConfigError."""
        if self.csv is not None:
            raise ConfigError("--csv is for many logs; for one, use --json")


def one_log(named: str) -> Path:
    """Return the path of the only log of a command; raises OSError if it does not exist."""
    path = Path(named)
    path.stat()  # reports a missing file before anything slow happens
    return path


def run(job: Job, named: Sequence[str], many: ManyLogs, folder: str = "") -> NoReturn:
    """Do the work of a command for many logs, and end with the exit code.

    Raises HirosError or OSError if the logs are not found, or the folder cannot be written.
    """
    from hiros_mcap.many.find import find_logs
    from hiros_mcap.many.run_logs import as_csv, run_logs, to_dict
    from hiros_mcap.outputs import write_text

    check_outputs((many.csv, "table of logs"), inputs=(), force=many.force)
    logs = find_logs(named, folder)
    if folder.endswith((".mcap", ".json", ".csv")) and not Path(folder).is_dir():
        raise ConfigError(f"{folder}: with many logs, -o names a folder, not a file")
    _name_settings(job, logs)
    by_log: dict[str, LogRecord] = {}
    with bar(quantity(len(logs), "log"), quiet=many.quiet) as progress:
        try:
            for record, is_new in run_logs(job, logs, folder, many.jobs or 0, force=many.force):
                by_log[record.log] = record
                place = f"{len(by_log)}/{len(logs)}"
                _tell(record, place, is_new=is_new, quiet=many.quiet)
                progress.update(len(by_log), len(logs))
        except Exception:
            raise
        except BaseException:  # a signal
            how = "the same command goes on" if folder else "nothing is kept without a folder"
            done = f"{len(by_log)} of {len(logs)} logs done"
            print(f"hiros: stopped: {done}; {how}", file=sys.stderr, flush=True)
            raise
    records = [by_log[log] for log in logs]
    if many.json:
        warnings = [f"{record.log}: {text}" for record in records for text in record.warnings]
        print_json("logs", to_dict(records, job), warnings)
    elif not many.quiet:
        _show(job, records, folder)
    if many.csv is not None:
        write_text(many.csv, as_csv(records))
    raise Exit(exit_code(records))


def _name_settings(job: Job, logs: Sequence[str]) -> None:
    """Say on stderr which files hiros.toml count, and for how many logs."""
    from hiros_mcap.config import settings_beside

    if job.settings is None or job.settings.file is not None:
        return
    for file, n in Counter(map(settings_beside, logs)).items():
        if file is not None:
            print(f"hiros: {quantity(n, 'log')} with parameters of {file}", file=sys.stderr)


def exit_code(records: Sequence[LogRecord]) -> int:
    """Return 70 after a fault of hiros, else 2 if a log failed, 3 for losses."""
    verdicts = {record.verdict for record in records}
    if any(record.bug for record in records):
        return BUG
    for verdict, code in (("failed", BAD_INPUT), ("recovered", LOSSES)):
        if verdict in verdicts:
            return code
    return 0


def short(log: str) -> str:
    """Return a path relative to the current folder if it lies below it."""
    here = f"{Path.cwd()}{os.sep}"
    return log.removeprefix(here)


def _without_common(logs: Sequence[str]) -> list[str]:
    """Return paths without the folders that all of them begin with."""
    folders = [f"{log.rpartition('/')[0]}/" for log in logs]
    common = os.path.commonprefix(folders).rpartition("/")[0]  # noqa: RUF071
    return [log.removeprefix(f"{common}/") for log in logs]


def _tell(record: LogRecord, place: str, *, is_new: bool, quiet: bool) -> None:
    """Print on stderr what came of a log; ``place`` is its number, of how many."""
    name = printable(short(record.log))
    for text in (*record.warnings, *filter(None, [record.losses])):
        warn(f"{name}: {text}")
    if record.verdict == "failed":
        print(f"hiros: error: {name}: {printable(record.error, 1000)}", file=sys.stderr)
    elif not quiet:
        time_taken = f"{record.seconds:.1f} s" if is_new else "before"
        line = f"[{place}] {name}: {record.verdict}, {time_taken}"
        print(line, file=sys.stderr, flush=True)


def _show(job: Job, records: Sequence[LogRecord], folder: str) -> None:
    from rich.text import Text

    from hiros_cli.run_report import page, table
    from hiros_mcap.many.run_logs import column_means, columns_of, values_of

    columns = [name for name in columns_of(records) if name in shown_columns(job.command)]
    named = [*zip(_without_common([r.log for r in records]), records, strict=True)]
    rows = [
        (log, r.verdict, *(_cell(values_of(r).get(name)) for name in columns))
        for log, r in named
        if len(records) <= _ALL_ROWS or r.verdict != "done"
    ]
    n_shown, means = len(rows), column_means(records)
    if any(name in means for name in columns):
        rows.append(("mean", "", *(_cell(means.get(name)) for name in columns)))
    titles = (f">{name.replace('_', ' ')}" for name in columns)
    counts = ", ".join(
        f"{n} {verdict}" for verdict, n in Counter(r.verdict for r in records).items()
    )
    lines: list[str | Text] = [Text(f"{quantity(len(records), 'log')}: {counts}", style="bold")]
    if n_shown < len(records):
        lines.append("the table has those that are not simply done; --csv and --json have all")
    for log, r in named:
        if r.verdict == "failed":
            lines.append(f"{printable(log)}: {printable(r.error, _LONGEST_REASON)}")
    if folder:
        lines.append(f"manifest: {folder.rstrip('/')}/hiros-{job.command}.jsonl")
    page((), table("Log", "Verdict", *titles, rows=rows), lines)


def shown_columns(command: str) -> tuple[str, ...]:
    """Return the columns for a terminal of 80 characters; CSV and JSON have all."""
    from hiros_mcap.evaluate.measures import BRIEF

    return {
        "process": ("people", "log_s", "skipped", "took_s"),
        "eval": ("people", *BRIEF, "left_out_camera"),
        "info": ("kind", "seconds", "megabytes", "cameras", "people"),
        "export": ("people", "files"),
    }[command]


def _cell(value: object) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
