"""Where a command may write, what it prints for machines, and text that is safe to print.

A topic may hold an escape sequence that clears the screen, a right-to-left override that shows
another name than it is, or a megabyte. Nothing from outside is printed except through here.
"""

from __future__ import annotations

import glob
import json
import sys
import unicodedata
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from hiros_mcap.errors import ConfigError
from hiros_mcap.outputs import Kind
from hiros_mcap.outputs import check_outputs as check


def check_outputs(
    *outputs: tuple[Path | None, Kind], inputs: Iterable[Path | str | None], force: bool
) -> None:
    """Refuse, before anything slow happens, what a command must not write.

    ``inputs`` may hold texts that name a file or a channel.

    Raises LogError as :func:`hiros_mcap.outputs.check_outputs` does.
    """
    check(outputs, inputs, force=force, remedy="--force")


def warn(text: str) -> None:
    """Print ``hiros: warning: ...`` on stderr, where no pipe and no --quiet hides it."""
    print(f"hiros: warning: {printable(text, LINE_LIMIT)}", file=sys.stderr, flush=True)


SCHEMA_VERSIONS: Mapping[str, int] = {
    "process": 1,
    "info": 1,
    "eval": 2,
    "eval.self": 4,
    "compare": 3,
    "check": 1,
    "recover": 2,
    "calibrate.people": 1,
    "calibrate.noise": 2,
    "calibrate.ball": 1,
    "export": 1,
    "logs": 2,
    "calibrate.board": 1,
    "plan": 1,
}
"""Schema of ``--json`` -> version of its fields, docs/json.md. A new field keeps the version. It
changes if a field goes or means something else."""


def print_json(schema: str, data: Mapping[str, object], warnings: Sequence[str] = ()) -> None:
    """Print data for machines, headed by the name and version of its schema.

    ``warnings`` go into the field of this name unless ``data`` has it.
    """
    head = {"schema": f"hiros.{schema}", "version": SCHEMA_VERSIONS[schema]}
    content = {**head, "warnings": list(warnings), **data}
    print(json.dumps(content, indent=2, allow_nan=False))


def beside(source: Path, suffix: str) -> Path:
    """Return the default output: the input's name with another suffix, in its folder.

    Raises ConfigError if the input is the root of the file system.
    """
    path = source if source.name else source.resolve()
    if not path.name:
        raise ConfigError(f"{source}: gives no name for the output; choose one with --output")
    return path.with_name(path.stem + suffix)


LIMIT = 200
LINE_LIMIT = 1000
_LEFT_OUT = {"rerun": "rerun-sdk", "matplotlib": "matplotlib"}
_QUOTED = "a pattern in quotes; this command takes the names of files"
_NO_MEMORY = ("can't start new thread", "failed to map segment", "cannot allocate memory")

# Cc: C0 and C1 controls. Cf: bidirectional and other invisible formatting. Zl, Zp: line and
# paragraph separators. Cs: halves of surrogate pairs, from names that are not UTF-8. Co, Cn:
# without a meaning that a terminal could show.
UNSAFE = frozenset({"Cc", "Cf", "Zl", "Zp", "Cs", "Co", "Cn"})


def printable(text: object, limit: int = LIMIT) -> str:
    """``str(text)`` with everything unsafe written as an escape, at most ``limit`` characters."""
    raw = str(text)
    cut = raw[:limit]
    safe = "".join(
        char.encode("unicode_escape").decode() if unicodedata.category(char) in UNSAFE else char
        for char in cut
    )
    if len(raw) <= limit and len(safe) <= limit:
        return safe
    return safe[: limit - 1] + "…"


def error_line(error: BaseException, *, bug: bool = False) -> str:
    """One line that says what is wrong, ``hiros: error: ...``."""
    if bug:
        from hiros_mcap.plugins import SYSTEMS, names

        what = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
        others = ", ".join(names(SYSTEMS))
        whose = f"hiros, or of the system {others} of a package" if others else "hiros"
        return printable(
            f"hiros: bug: {what} (this is a fault of {whose}, not of your input; please report it "
            "with the output of --debug)",
            LINE_LIMIT,
        )
    return f"hiros: error: {_reason(error)}"


def lacks_memory(error: BaseException | None) -> bool:
    """Whether an error, or one that led to it, says that memory ran out.

    Python says MemoryError; its threads and the loader of libraries say it in their own words.
    """
    while error is not None:
        text = str(error).lower()
        if isinstance(error, MemoryError) or any(word in text for word in _NO_MEMORY):
            return True
        error = error.__cause__ or error.__context__
    return False


def left_out(error: BaseException) -> str:
    """Return the package that an installation of requirements-small.txt lacks; "" if none."""
    missing = str(error.name) if isinstance(error, ModuleNotFoundError) else ""
    return _LEFT_OUT.get(missing.partition(".")[0], "")


def _reason(error: BaseException) -> str:
    from hiros_mcap.errors import LogError

    if package := left_out(error):
        return f"needs the package {package}, which this installation lacks: pip install {package}"
    if lacks_memory(error):
        reason = printable(error) if isinstance(error, MemoryError) else ""
        return f"not enough memory: {reason}" if reason else "not enough memory"
    if isinstance(error, OSError):
        names = (name for name in (error.filename, error.filename2) if name is not None)
        named = [printable(name, LINE_LIMIT) for name in names]
        if isinstance(error, FileNotFoundError) and glob.has_magic(str(error.filename)):
            has_some = glob.glob(str(error.filename))  # noqa: PTH207 - may be absolute
            return f"{named[0]}: {_QUOTED if has_some else 'no file matches this pattern'}"
        return ": ".join([*named, printable(error.strerror or error)])
    if isinstance(error, LogError):
        path = [] if error.path is None else [printable(error.path, LINE_LIMIT)]
        topic = [] if error.topic is None else [printable(error.topic)]
        return ": ".join([*path, *topic, printable(error.fault, LINE_LIMIT)])
    return printable(error, LINE_LIMIT)
