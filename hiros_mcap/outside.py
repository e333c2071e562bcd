"""Text that comes from outside: files of settings and of joints, attachments, messages of servers.

All of it is read here, so that nothing in it takes endless time or memory, or raises anything but
one error that names its place.
"""

from __future__ import annotations

import codecs
import json
import os
import re
import stat
import sys
import tomllib
from collections.abc import Iterator
from itertools import chain, islice
from pathlib import Path
from typing import Any, Literal

from hiros_mcap.errors import ConfigError

MOST_BYTES = 16 << 20
"""Largest file of settings, bytes."""
_MOST_YAML = 1 << 20  # largest YAML file, bytes; its reader takes seconds for it
_MOST_PARTS = 1 << 20
"""Values beside each other in a YAML file, whose aliases repeat what they name."""
_DEEPEST = 64  # tables and lists in each other; nothing that hiros reads has more than 6
_LARGEST = 1 << 64  # whole numbers beyond it fit into no field


def read_text(path: str | os.PathLike[str], most: int = MOST_BYTES) -> str:
    """Return the text of a regular file of at most ``most`` bytes, without a byte order mark.

    It is UTF-8, or UTF-16 by its mark.

    Raises ConfigError naming the file. A FIFO is refused, for whose writer nobody may wait.
    """
    path = Path(path)
    try:
        mode = path.stat().st_mode
        if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
            raise ConfigError(f"{path}: is not a regular file; save a stream first")
        with path.open("rb") as file:
            data = file.read(most + 1)
        if len(data) > most:
            raise ConfigError(f"{path}: is larger than {most >> 20} MiB")
        is_wide = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))  # Excel's "Unicode"
        return data.decode("utf-16" if is_wide else "utf-8-sig")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not text: {error.reason}; save text as UTF-8") from None
    except ValueError as error:  # a null byte in the name
        raise ConfigError(f"{path}: {error}") from None


def parse(text: str, kind: Literal["JSON", "TOML", "YAML"], where: object) -> Any:
    """Return what a text holds; raises ConfigError that names ``where``.

    Refused are texts nested deeper than 64 levels, keys that occur twice, whole numbers beyond 64
    bits and text that is no Unicode; of YAML also tags of programs, merge keys, and aliases that
    make much of little.
    """
    try:
        if kind == "TOML":
            value: Any = tomllib.loads(text)
        elif kind == "JSON":
            value = json.loads(text, object_pairs_hook=_table)
        else:
            value = _yaml(text)
        _check(value, _MOST_PARTS if kind == "YAML" else sys.maxsize - 1)
    except RecursionError:
        raise ConfigError(f"{where}: not {kind}: nested too deeply") from None
    except ValueError as error:
        raise ConfigError(f"{where}: not {kind}: {error}") from None
    return value


def read_toml(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read a TOML file; raises ConfigError naming it."""
    table: dict[str, Any] = parse(read_text(path), "TOML", path)
    return table


def read_yaml(path: str | os.PathLike[str]) -> Any:
    """Read a YAML file of at most 1 MiB; raises ConfigError naming it."""
    return parse(read_text(path, _MOST_YAML), "YAML", path)


def _yaml(text: str) -> Any:
    from ruamel.yaml import YAML
    from ruamel.yaml.error import MarkedYAMLError, YAMLError

    if re.search(r"<<\s*:", text):
        raise ValueError("has a merge key (<<)")
    try:
        return YAML(typ="safe").load(text)
    except YAMLError as error:
        mark = error.problem_mark if isinstance(error, MarkedYAMLError) else None
        place = f"line {mark.line + 1}: " if mark else ""
        raise ValueError(f"{place}{getattr(error, 'problem', '') or error}") from None


def _table(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    table = dict(pairs)
    if len(table) < len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"the key {twice!r} occurs twice")
    return table


def _check(value: object, most: int) -> None:
    """Raise ValueError for what these readers take and nothing else does."""
    level = [value]
    for _ in range(_DEEPEST):
        level = [*islice(chain.from_iterable(map(_parts, level)), most + 1)]
        if not level:
            return
        if len(level) > most:
            raise ValueError("its aliases make too much of it")
    raise ValueError("nested too deeply")


def _parts(item: object) -> Iterator[object]:
    match item:
        case dict():
            yield from item
            yield from item.values()
        case list():
            yield from item
        case str() if not item.isascii():
            item.encode()
        case int() if abs(item) > _LARGEST:
            raise ValueError("a whole number of more than 64 bits")
