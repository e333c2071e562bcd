"""Every error that hiros raises on purpose.

::

    HirosError
    ├── LogError      a log that cannot be read or written as asked
    │   └── SchemaError   a message definition that differs from hiros_skeleton_msgs
    ├── ConfigError   a parameter, an option or a side file that makes no sense
    └── RegistrationError  points that do not tell where a camera stands

The command line catches :class:`HirosError` once, prints its one line and exits with 2.
Anything else that escapes is a bug of ours and exits with 70.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager


class HirosError(Exception):
    """Root of the tree. ``str(error)`` is one line that a user can act on."""


class LogError(HirosError):
    """A fault of a log: unreadable, damaged, without skeletons, without a transform.

    Parameters
    ----------
    fault : what is wrong, one line.
    path : the file, when there is one.
    topic : the channel, when the fault is of one.
    """

    def __init__(self, fault: str, *, path: object = None, topic: str | None = None) -> None:
        self.fault = fault
        self.path = path
        self.topic = topic
        where = [str(part) for part in (path, topic) if part is not None]
        super().__init__(": ".join([*where, fault]))


class SchemaError(LogError):
    """A channel's message definition is not the one that hiros decodes."""


class ConfigError(HirosError):
    """A parameter, an option or a side file (configuration, limbs, extrinsics) is wrong."""


class RegistrationError(HirosError, ValueError):
    """Points that do not tell a pose: of a wrong shape, too few, on a line, or on no sphere."""


@contextmanager
def naming(path: object, topic: str | None = None) -> Iterator[None]:
    """Give the LogErrors of a block that name no file the name of one."""
    try:
        yield
    except LogError as error:
        if error.path is not None:
            raise
        raise type(error)(error.fault, path=path, topic=error.topic or topic) from None


def explained(error: LogError, reasons: Sequence[str]) -> LogError:
    """Return an error with what is known to be wrong with the log anyway."""
    fault = "; ".join([error.fault, *reasons])
    return type(error)(fault, path=error.path, topic=error.topic) if reasons else error
