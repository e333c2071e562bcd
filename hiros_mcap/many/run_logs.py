"""A command on many logs: plan, run, keep what came of each in the manifest, and add it up.

::

    logs = find_logs(["recordings/"])
    for record, _ in run_logs(ProcessJob(Settings()), logs, "results", jobs=2):
        print(record.log, record.verdict)
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
import math
import os
import re
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from statistics import fmean
from typing import Any

from pydantic import BaseModel

from hiros_mcap.errors import HirosError, LogError
from hiros_mcap.many.find import base_name, distinct_names
from hiros_mcap.many.jobs import Job
from hiros_mcap.many.manifest import Identity, LogRecord, Manifest
from hiros_mcap.outputs import check_outputs, remove_parts
from hiros_mcap.wording import plain, plain_value
from hiros_mcap.workers import run_tasks


def run_logs(
    job: Job, logs: Sequence[str], folder: str, jobs: int = 0, *, force: bool = False
) -> Iterator[tuple[LogRecord, bool]]:
    """Yield what becomes of each log as it gets ready, and whether it was done now.

    What a former run has done comes first. Failures do not stop the others. The manifest of the
    folder has every record.

    Parameters
    ----------
    logs : absolute paths, see :func:`hiros_mcap.many.find.find_logs`.
    folder : where the results go; "" keeps nothing.
    jobs : processes at once; 0 = one per core.
    force : replace files that hiros did not write.

    Raises LogError if the folder cannot be written, or a file in it must not be replaced;
    ConfigError if the manifest is damaged.
    """
    with ExitStack() as stack:
        place = Path(folder).absolute() if folder else None
        sizes = {}
        if place is not None:
            _create(place)
            stack.enter_context(locked(place))
            sizes = {path.name: path.stat().st_size for path in place.iterdir() if path.is_file()}
        manifest = Manifest(job.command, place)
        planned = _planned(job, logs, manifest)
        done = {r.log: old for r in planned if (old := manifest.knows(r, sizes))}
        todo = [record for record in planned if record.log not in done]
        if place is not None and job.suffix:
            names = {record.name for record in todo}
            ours = manifest.exported() if job.kind == "export" else {}
            beside = [log for log in logs if Path(log).parent.resolve() == place.resolve()]
            for file, size in sizes.items():
                if _base(file, job.suffix) in names and ours.get(file) != size:
                    output = [(place / file, job.kind)]
                    check_outputs(output, beside, force=force, remedy="--force")
        for former in done.values():
            yield former, False

        def lost(k: int, why: str) -> LogRecord:
            error = f"stopped its process more than once: {why}"
            return replace(todo[k], verdict="failed", error=error)

        tasks = [(job, record, folder) for record in todo]
        if place is not None:
            stack.callback(remove_parts, place)
        for _, record in run_tasks(run_one, tasks, jobs, lost):
            manifest.add(record)
            yield record, True


def _create(folder: Path) -> None:
    """Make a folder unless it is there; raises LogError."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        is_file = isinstance(error, FileExistsError | NotADirectoryError)
        reason = "it is a file" if is_file else error.strerror or error
        raise LogError(f"is no folder that can be written: {reason}", path=folder) from None


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Keep other runs away from a folder; the lock ends with the process, however it ends.

    Raises LogError if another run has it.
    """
    try:
        import fcntl
    except ImportError:  # Windows
        yield
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            fault = "another run of hiros writes there; wait for it, or choose another folder"
            raise LogError(fault, path=folder) from None
        except OSError:
            pass  # not every file system has locks
        yield
    finally:
        os.close(handle)


def _base(file: str, suffix: str) -> str:
    """Return the name of the log that an output is of: lab for lab.trc, and for lab.0.trc."""
    return re.sub(r"\.\d+$", "", file.removesuffix(suffix)) if file.endswith(suffix) else ""


def _planned(job: Job, logs: Sequence[str], manifest: Manifest) -> list[LogRecord]:
    """Return what is known of each log before anything is done; the verdict is not."""
    names = distinct_names(logs, {r.log: r.name for r in manifest.records.values()})
    planned = []
    for log in logs:
        configuration, identity = "", Identity(0, "")
        with suppress(HirosError, OSError):  # the job will say why
            its_job = job.of(log)
            contents = (path.read_bytes() for path in its_job.sides(base_name(log)))
            configuration = hashlib.sha256(b"".join([_settings(its_job), *contents])).hexdigest()
            if log in manifest.records:
                identity = identity_of(log)
        planned.append(
            LogRecord(log, names[log], "failed", input=identity, configuration=configuration)
        )
    return planned


def identity_of(log: str) -> Identity:
    """Return the size and the time of change of a log; raises OSError or LogError."""
    path = Path(log)
    if not (path.is_file() or path.is_dir()):
        path.stat()
        raise LogError("is a device or a pipe, not a file of a log", path=path)
    files = path.rglob("*") if path.is_dir() else [path]
    stats = [file.stat() for file in files if not file.is_dir()]
    newest = max((one.st_mtime_ns for one in stats), default=0)
    return Identity(sum(one.st_size for one in stats), str(newest))


def _settings(job: Job) -> bytes:
    """Return the settings of a job as text."""

    def as_json(value: object) -> object:
        return value.model_dump(mode="json") if isinstance(value, BaseModel) else str(value)

    settings = json.dumps(plain_value(job), default=as_json, sort_keys=True)
    return f"{job.command}\n{settings}\n".encode()


def run_one(job: Job, record: LogRecord, folder: str) -> LogRecord:
    """Do the work for one log; whatever is wrong with it becomes the record."""
    start = time.perf_counter()
    try:
        record = _run(job.of(record.log), record, Path(folder).absolute() if folder else None)
    except (HirosError, OSError) as error:
        record = replace(record, verdict="failed", error=_in_one_line(error, record.log))
    except MemoryError:
        record = replace(record, verdict="failed", error="not enough memory; use fewer --jobs")
    except Exception as error:  # noqa: BLE001 - a fault of hiros must not stop the others
        what = f"{type(error).__name__}: {error}"
        record = replace(record, verdict="failed", error=f"bug: {what}", bug=True)
    return replace(record, seconds=time.perf_counter() - start)


def _run(job: Job, record: LogRecord, folder: Path | None) -> LogRecord:
    # Compared with what is there before: a log may change while it is read.
    identity, log = identity_of(record.log), Path(record.log)
    target = folder / (record.name + job.suffix) if folder and job.suffix else Path()
    finding = job.run(log, target)
    verdict = finding.verdict
    if verdict == "done":
        verdict = "recovered" if finding.losses else "doubtful" if finding.warnings else "done"
    return replace(
        record,
        verdict=verdict,
        error=finding.error,
        warnings=tuple(finding.warnings),
        losses=finding.losses,
        values=dict(finding.values),
        files={file.name: file.stat().st_size for file in finding.files},
        input=identity,
    )


def _in_one_line(error: Exception, log: str) -> str:
    """Return what is wrong, without the name of the log in front."""
    text = str(error)
    if isinstance(error, OSError):
        names = [str(name) for name in (error.filename, error.filename2) if name is not None]
        text = ": ".join([*names, error.strerror or text])
    return text.removeprefix(f"{log}: ")


def columns_of(records: Sequence[LogRecord]) -> list[str]:
    """Return the names of all values that a log has, in their order, and the time it took."""
    return [*dict.fromkeys(name for record in records for name in record.values), "took_s"]


def values_of(record: LogRecord) -> dict[str, Any]:
    """Return the values of a log by :func:`columns_of`."""
    return {**record.values, "took_s": record.seconds}


def column_means(records: Sequence[LogRecord]) -> dict[str, float]:
    """Return the mean of every column of numbers, over the logs that have it; not of people.

    Logs of which nothing was measured, failed or skipped ones, took no time and do not count.
    """
    records = [record for record in records if record.values]
    means = {}
    for name in columns_of(records):
        values = [values_of(record).get(name) for record in records]
        numbers = [float(x) for x in values if isinstance(x, int | float) and math.isfinite(x)]
        if numbers and name != "people":
            means[name] = fmean(numbers)
    return means


def as_csv(records: Sequence[LogRecord]) -> str:
    """Return the table of all logs as CSV: log, verdict, what was measured, time, error."""
    columns, text = columns_of(records), io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["log", "verdict", *columns, "warnings", "error"])
    for r in records:
        values = [values_of(r).get(name, "") for name in columns]
        writer.writerow([r.log, r.verdict, *values, "; ".join(r.warnings), r.error])
    return text.getvalue()


def to_dict(records: Sequence[LogRecord], job: Job) -> Mapping[str, Any]:
    """Plain data for JSON."""
    return {
        "command": job.command,
        "verdicts": dict(Counter(record.verdict for record in records)),
        "means": column_means(records),
        "logs": [plain(record) for record in records],
    }
