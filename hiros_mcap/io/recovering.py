"""Writes what can be read of a damaged recording as a healthy log."""

from __future__ import annotations

import os
from pathlib import Path

from hiros_mcap.errors import LogError
from hiros_mcap.io.bags import join as join_parts
from hiros_mcap.io.bags import kind_of, parts_of
from hiros_mcap.io.container import McapWriter, Recovery
from hiros_mcap.io.container.recovery import RECOVERY_METADATA
from hiros_mcap.outputs import check_outputs


def recover(
    source: str | os.PathLike[str], target: str | os.PathLike[str], *, force: bool = False
) -> Recovery:
    """Write everything that can be read of a recording to one indexed MCAP file with checksums.

    Messages keep their bytes, times and numbers. A metadata record, ``hiros.recovery``, marks the
    file if anything was damaged.

    Parameters
    ----------
    source : an MCAP file, or a folder with the files of one recording.
    target : the output.
    force : replace a file that hiros did not write.

    Raises
    ------
    LogError
        nothing can be read; ``source`` is a bag of another kind; ``target`` cannot be written.
    """
    path, out = Path(source), Path(target)
    parts = parts_of(path, recover=True)
    if not parts:
        raise LogError(f"is {kind_of(path)}; hiros recovers MCAP files", path=path)
    check_outputs([(out, "log")], [path], force=force)
    with McapWriter(out, inputs=parts) as writer:
        recovery = join_parts(parts, writer, recover=True)
        if recovery.damages:
            writer.add_metadata(RECOVERY_METADATA, recovery.metadata())
        writer.commit()
    return recovery
