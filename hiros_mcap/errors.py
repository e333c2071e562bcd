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
    listing : what the log has instead, for whom no table shows it.
    """

    def __init__(
        self, fault: str, *, path: object = None, topic: str | None = None, listing: str = ""
    ) -> None:
        self.cause, self.listing = fault, listing
        fault = "; ".join(part for part in (fault, listing) if part)
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
        raise type(error)(
            error.cause, path=path, topic=error.topic or topic, listing=error.listing
        ) from None


def explained(error: LogError, reasons: Sequence[str]) -> LogError:
    """Return an error with what is known to be wrong with the log anyway."""
    if not reasons:
        return error
    cause = "; ".join([error.cause, *reasons])
    return type(error)(cause, path=error.path, topic=error.topic, listing=error.listing)
