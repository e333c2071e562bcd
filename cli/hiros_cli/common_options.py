"""Options of every command: how much it shows, where that is logged, and whether in colour."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from hiros_cli.output import error_line, printable
from hiros_mcap.errors import ConfigError, LogError

LOGGERS = ("hiros_mcap", "hiros_cli")
LOG_MARK = "# hiros log\n"
_VALUED = ("--log-file", "--color")
_COLOURS: Mapping[str, Mapping[str, str | None]] = {
    "auto": {},
    "always": {"NO_COLOR": None, "FORCE_COLOR": "1"},
    "never": {"NO_COLOR": "1", "FORCE_COLOR": None},
}
"""Choice of --color -> variables of the environment, which rich reads; None unsets one."""


@dataclass(frozen=True, slots=True)
class CommonOptions:
    """Options that every command has."""

    verbose: bool = False
    log_file: Path | None = None
    color: str = "auto"

    @contextmanager
    def in_effect(self, arguments: Sequence[str]) -> Iterator[None]:
        """Run a command so; raises LogError if the log file is somebody else's."""
        with ExitStack() as stack:
            stack.enter_context(environment(_COLOURS[self.color]))
            if self.verbose:
                stack.enter_context(_handled_by(_Steps(logging.INFO)))
            if self.log_file is not None:
                _check_log_file(self.log_file, arguments)
                stack.enter_context(_handled_by(_file_handler(self.log_file)))
            log = logging.getLogger("hiros_cli")
            log.debug("hiros %s", printable(" ".join(arguments)))
            try:
                yield
            except Exception as error:
                log.error("%s", error_line(error), exc_info=log.isEnabledFor(logging.DEBUG))
                raise


def split(arguments: Sequence[str]) -> tuple[CommonOptions, list[str]]:
    """Return these options, wherever they stand, and the arguments without them.

    Raises ConfigError for a value that is missing or makes no sense.
    """
    rest: list[str] = []
    given: dict[str, str] = {}
    waiting = iter(arguments)
    # The ball has a colour of its own.
    valued = ("--log-file",) if [*arguments[:2]] == ["calibrate", "ball"] else _VALUED
    for argument in waiting:
        name, equals, value = argument.partition("=")
        if argument == "--":
            rest += [argument, *waiting]
        elif argument == "--verbose":
            given[name] = ""
        elif name in valued:
            given[name] = value if equals else next(waiting, "")
            if not given[name]:
                raise ConfigError(f"{name}: its value is missing")
        else:
            rest.append(argument)
    color = given.get("--color", "auto")
    if color not in _COLOURS:
        raise ConfigError(f"--color: {color!r} is none of {', '.join(_COLOURS)}")
    file = given.get("--log-file")
    return CommonOptions("--verbose" in given, Path(file) if file else None, color), rest


def of_ros(arguments: Sequence[str]) -> list[str]:
    """Return the arguments with those of ROS 2 each as the value of an option --ros-args.

    As in any node, they reach from ``--ros-args`` to ``--`` or to the end.
    """
    joined, inside = [], False
    for argument in arguments:
        if argument == "--ros-args":
            inside = True
        elif inside and argument == "--":
            inside = False
        else:
            joined.append(f"--ros-args={argument}" if inside else argument)
    return joined


class _Steps(logging.Handler):
    """Prints on stderr what the library does; its warnings are printed anyway."""

    def emit(self, record: logging.LogRecord) -> None:
        if record.levelno < logging.WARNING:
            print(f"hiros: {printable(record.getMessage())}", file=sys.stderr, flush=True)


class _LogFile(logging.FileHandler):
    """Appends to a file; where that fails, for example on a full disk, a run goes on without."""

    _failed = False

    def emit(self, record: logging.LogRecord) -> None:
        if not self._failed:
            super().emit(record)

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802 - logging's name
        error = sys.exception()
        if not isinstance(error, OSError):
            super().handleError(record)
            return
        self._failed = True
        from hiros_cli.output import warn

        warn(f"{self.baseFilename}: {error.strerror}; the log ends here", logged=True)

    def close(self) -> None:
        with suppress(OSError):  # what is left in its buffer does not fit either
            super().close()


def _check_log_file(path: Path, arguments: Sequence[str]) -> None:
    """Raise ConfigError if a new log file is also another file of the command."""
    names = [os.path.realpath(argument.rpartition("=")[2]) for argument in arguments]
    if not path.exists() and names.count(os.path.realpath(path)) > 1:
        raise ConfigError(f"--log-file: {path} is another file of the command; choose another name")


def _file_handler(path: Path) -> logging.Handler:
    """Return what appends to a file; a terminal or a pipe may stand for it."""
    is_new = not path.is_file() or not path.stat().st_size
    if not is_new:
        with path.open("rb") as file:
            if file.read(len(LOG_MARK)) != LOG_MARK.encode():
                raise LogError("exists and is not a log of hiros; choose another name", path=path)
    if is_new:
        try:
            path.write_text(LOG_MARK, encoding="utf-8")
        except OSError as error:  # a full disk names no file
            raise LogError(f"cannot be written: {error.strerror}", path=path) from None
    handler = _LogFile(path, encoding="utf-8", errors="backslashreplace")
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    return handler


@contextmanager
def _handled_by(handler: logging.Handler) -> Iterator[None]:
    """Give a handler what the library and the commands log, as long as the block runs."""
    loggers = [logging.getLogger(name) for name in LOGGERS]
    before = [logger.level for logger in loggers]
    for logger in loggers:
        logger.addHandler(handler)
        logger.setLevel(min(handler.level or logging.DEBUG, logger.level or logging.WARNING))
    try:
        yield
    finally:
        for logger, level in zip(loggers, before, strict=True):
            logger.removeHandler(handler)
            logger.setLevel(level)
        handler.close()


@contextmanager
def environment(values: Mapping[str, str | None]) -> Iterator[None]:
    """Set variables, None = without it, as long as the block runs."""
    before = {name: os.environ.get(name) for name in values}

    def put(named: Mapping[str, str | None]) -> None:
        for name, value in named.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value

    put(values)
    try:
        yield
    finally:
        put(before)
