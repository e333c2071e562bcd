"""Writes an MCAP message by message, to a pipe or a server."""

from __future__ import annotations

import os
from collections.abc import Iterable

from hiros_mcap.errors import LogError
from hiros_mcap.io.container.atomic import Sink
from hiros_mcap.io.container.records import Bytes
from hiros_mcap.io.container.writer import McapWriter


class LiveWriter(McapWriter):
    """An MCAP on its way to a reader: :meth:`flush` sends what was written since the last.

    Messages are not in chunks, since a chunk would have to wait for its last message, and no index
    grows with the length of the recording. Whatever leaves the ``with`` block without a commit has
    no end mark.

    """

    def __init__(self, out: Sink) -> None:
        super().__init__(out, compression="")

    def flush(self) -> None:
        """Send everything so far, and wait until it is on its way."""
        self._submit(self._flush)
        self._wait()

    def _emit_batch(self) -> None:
        batch = self._batch
        first, last = self._times or (batch.start_time, batch.end_time)
        self._times = [min(first, batch.start_time), max(last, batch.end_time)]
        self._out.write(batch.buffer.data[: batch.size])


class Pipe(Sink):
    """A pipe in place of a file.

    A reader that is slow makes the writer wait; BrokenPipeError is raised if it is gone.
    """

    def __init__(self, descriptor: int, name: str) -> None:
        super().__init__(name)
        self._descriptor = descriptor

    def _put(self, parts: Iterable[Bytes]) -> None:
        """Write everything, however long that takes; raises BrokenPipeError or LogError."""
        data = memoryview(b"".join(parts))
        try:
            while data:
                data = data[os.write(self._descriptor, data) :]
        except BrokenPipeError:
            raise
        except OSError as error:
            raise LogError(f"cannot be written: {error.strerror}", path=self.path) from None
