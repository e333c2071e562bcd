"""Where a command may write, and what it prints for machines."""

from __future__ import annotations

import json
import logging
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from hiros_cli.printable import LINE_LIMIT, printable
from hiros_mcap.errors import ConfigError
from hiros_mcap.outputs import Kind
from hiros_mcap.outputs import check_outputs as check

_log = logging.getLogger(__name__)


def check_outputs(
    *outputs: tuple[Path | None, Kind], inputs: Iterable[Path | str | None], force: bool
) -> None:
    """Refuse, before anything slow happens, what a command must not write.

    ``inputs`` may hold texts that name a file or a channel.

    Raises LogError as :func:`hiros_mcap.outputs.check_outputs` does.
    """
    check(outputs, inputs, force=force, remedy="--force")


def warn(text: str, *, logged: bool = False) -> None:
    """Print ``hiros: warning: ...`` on stderr, where no pipe and no --quiet hides it.

    It is logged as well, unless the library has ``logged`` it.
    """
    print(f"hiros: warning: {printable(text, LINE_LIMIT)}", file=sys.stderr, flush=True)
    if not logged:
        _log.warning("%s", text)


SCHEMA_VERSIONS: Mapping[str, int] = {
    "process": 1,
    "info": 1,
    "eval": 1,
    "eval.self": 2,
    "compare": 2,
    "check": 1,
    "recover": 2,
    "calibrate.people": 1,
    "calibrate.noise": 1,
    "calibrate.ball": 1,
    "export": 1,
    "logs": 1,
    "calibrate.board": 1,
    "plan": 1,
}
"""What ``--json`` prints -> version of its fields, docs/json.md. A new field does not change the
version; a field that goes, or means something else, does."""


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
