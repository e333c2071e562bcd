"""Which logs are meant: files, recordings of several files, folders and globs."""

from __future__ import annotations

import glob
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path, PurePosixPath

from hiros_mcap.errors import ConfigError
from hiros_mcap.io.bag_files import (
    STORAGES,
    is_log_name,
    is_recording,
)

_RESULT = re.compile(r"(\.hiros)?\.(mcap|bag|db3)(\.zstd?)?$", re.IGNORECASE)


def are_many(named: Sequence[str]) -> bool:
    """Whether a command was given more than one log: several names, a folder of logs or a glob.

    A folder with nothing but one MCAP or SQLite file is that log.

    Raises ConfigError if no file matches a glob.
    """
    if len(named) != 1:
        return True
    (text,) = named
    path = Path(text)
    if path.is_dir():
        return not (is_recording(path) or _is_single(path))
    if glob.has_magic(text) and not path.exists():
        if not glob.glob(text, recursive=True):  # noqa: PTH207 - may be absolute
            raise _no_match(text)
        return True
    return False


def _no_match(text: str) -> ConfigError:
    return ConfigError(f"{text}: no log matches this pattern (.mcap, .bag, .db3)")


def find_logs(named: Sequence[str], leave_out: str = "") -> list[str]:
    """Return absolute paths of the logs that are named, each once, in their order.

    A recording of several files is one log, also if a glob names its files.

    Parameters
    ----------
    named : files, folders (searched with all folders below), globs.
    leave_out : folder of results, which may lie within the others.

    Raises ConfigError if a folder or a glob has no logs; OSError if a file does not exist.
    """
    distinct: dict[str, None] = {}
    for text in named:
        logs = list(_local(text, leave_out))
        if not logs and glob.has_magic(text):
            raise _no_match(text)
        if not logs:
            raise ConfigError(f"{text}: there is no log (.mcap, .bag, .db3 or ROS 2 bag folder)")
        distinct.update(dict.fromkeys(logs))
    return list(distinct)


def _local(text: str, leave_out: str) -> Iterator[str]:
    path = Path(text)
    if text == "-":
        raise ConfigError("- is one log; it cannot be one of many")
    if glob.has_magic(text) and not path.exists():
        for one in sorted(glob.glob(text, recursive=True)):  # noqa: PTH207 - may be absolute
            if Path(one).is_dir() or _is_log(Path(one)):
                yield from _logs_of(Path(one), leave_out)
        return
    path.stat()
    yield from _logs_of(path, leave_out)


def _logs_of(path: Path, leave_out: str) -> Iterator[str]:
    path = path.absolute()
    if path.is_dir() and not is_recording(path):
        yield from _below(path, Path(leave_out).absolute() if leave_out else None)
    elif path.is_file() and is_recording(path.parent):
        yield str(path.parent)
    else:
        yield str(path)


def _below(folder: Path, leave_out: Path | None) -> Iterator[str]:
    """Yield the logs in a folder and those below it; links to folders are not followed."""
    for path in sorted(folder.iterdir()):
        if path.name.startswith(".") or path == leave_out:
            continue
        if _is_log(path) or (path.is_dir() and is_recording(path)):
            yield str(path)
        elif path.is_dir() and not path.is_symlink():
            yield from _below(path, leave_out)


def _is_single(folder: Path) -> bool:
    """Whether there is one MCAP or SQLite file in a folder, and no other log in it or below."""
    first = [Path(log) for log in islice(_below(folder, None), 2)]
    return len(first) == 1 and first[0].parent == folder and is_log_name(first[0].name, STORAGES)


def _is_log(path: Path) -> bool:
    """Whether a name is that of a log. What cannot be read fails by name, and is not left out."""
    return is_log_name(path.name) and not path.is_dir()


def base_name(log: str) -> str:
    """Return the name of a log, or of its result, without suffixes: lab for lab.hiros.mcap."""
    return _RESULT.sub("", PurePosixPath(log.rstrip("/")).name)


def distinct_names(logs: Iterable[str], names_given: Mapping[str, str]) -> dict[str, str]:
    """Return a name for each log, without suffix, by which files of all of them differ.

    It is the log's own name. Where several have the same, their folder's name comes before it:
    ``monday_lab``; if that is not enough, a number behind it. A log that has a name in
    ``names_given`` keeps it.
    """
    names = {log: names_given[log] for log in logs if log in names_given}
    waiting = [log for log in logs if log not in names]
    taken = {name.casefold() for name in names_given.values()}
    counts = Counter(base_name(log).casefold() for log in waiting)
    for log in waiting:
        name = base_name(log)
        if counts[name.casefold()] > 1 or name.casefold() in taken:
            name = f"{Path(log.rstrip('/')).parent.name}_{name}"
        names[log], number = name, 2
        while names[log].casefold() in taken:
            names[log], number = f"{name}-{number}", number + 1
        taken.add(names[log].casefold())
    return names
