"""Which files are one recording of rosbag2: what metadata.yaml lists, else what their names say.

The recorder names the parts of ``lab`` ``lab_0.mcap``, ``lab_1.mcap``, since ROS 2 Lyrical
``0_lab_2026_11_27-10_00_00.mcap`` (rosbag2, pull request 2265). Of SQLite they end in ``.db3``, and
``--compression-mode file`` adds ``.zstd`` to each. When it ends, it writes metadata.yaml.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path, PurePath
from typing import NamedTuple

from pydantic import BaseModel, ValidationError

from hiros_mcap.errors import ConfigError, LogError
from hiros_mcap.outside import read_yaml
from hiros_mcap.params import explain

METADATA = "metadata.yaml"
STORAGES = (".mcap", ".db3")
SUFFIXES = (*STORAGES, ".bag")
_PACKED = (".zstd", ".zst")
_RECORDED = "rosbag2_bagfile_information"
_DATE = r"_\d{4}_\d\d_\d\d-\d\d_\d\d_\d\d"
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
"""First bytes of a zstd frame. No message in CDR begins so: its first byte is 0.

mcap 1.6.0 and rosbags 0.11.9 hand such frames out as if they were CDR (docs/upstream.md).
"""
_MAGIC = {
    b"#ROSBAG V2.0": "a ROS 1 bag",
    b"SQLite format 3": "a SQLite bag",
    ZSTD_MAGIC: "a file compressed with zstd",
}
_NAMED = 4


class Files(NamedTuple):
    """The files of a recording."""

    parts: Sequence[Path]  # in their order
    promised: int = 0  # messages that metadata.yaml counts
    remarks: Sequence[str] = ()  # guesses about the files, for notes
    warnings: Sequence[str] = ()  # that metadata.yaml was not used


def kind_of(path: Path) -> str:
    """Return what kind of bag a path is; "" for a file that is none, such as an MCAP."""
    if path.is_dir():
        return "a rosbag2 folder" if (path / METADATA).is_file() else ""
    if not path.is_file():  # opening a pipe would wait for its writer
        return ""
    try:
        with path.open("rb") as file:
            start = file.read(16)
    except OSError:
        return ""
    return next((kind for magic, kind in _MAGIC.items() if start.startswith(magic)), "")


def unpacked_name(name: str) -> str:
    """Return a file's name without the suffix of zstd."""
    path = PurePath(name)
    return path.stem if path.suffix.lower() in _PACKED else name


def is_log_name(name: str, suffixes: Sequence[str] = SUFFIXES) -> bool:
    """Whether a name is that of a log, perhaps compressed."""
    return unpacked_name(name).lower().endswith(tuple(suffixes))


def is_recording(folder: Path) -> bool:
    """Whether a folder is one recording of ROS 2.

    It has a metadata.yaml of rosbag2. Without it, such as after a power loss, its logs have the
    names that rosbag2 gives the parts of a recording.
    """
    if _is_of_rosbag2(folder / METADATA):
        return True
    try:
        return are_splits(folder.name, [path.name for path in _inside(folder)])
    except OSError:
        return False


def _is_of_rosbag2(path: Path) -> bool:
    """Whether a file begins as a metadata.yaml of rosbag2."""
    try:
        with path.open(encoding="utf-8", errors="replace") as file:
            return _RECORDED in file.read(4096)
    except OSError:
        return False


def are_splits(folder: str, names: Iterable[str]) -> bool:
    """Whether logs in a folder have the names that rosbag2 gives all parts of a recording."""
    plain = {unpacked_name(name) for name in names}
    parts = [_part(folder, name) for name in plain]
    numbers = {part[0] for part in parts if part}
    titles = {part[1:] for part in parts if part}
    return len(plain) > 1 and len(titles) == 1 and numbers == set(range(len(plain)))


def _part(folder: str, name: str) -> tuple[int, str, str] | None:
    """Return the number of a part, its title and suffix; None for any other name."""
    stem, suffix = PurePath(name).stem, PurePath(name).suffix.lower()
    if suffix not in STORAGES:
        return None
    if match := re.fullmatch(rf"{re.escape(folder)}_(\d+)", stem):
        return int(match[1]), folder, suffix
    # The date tells them from somebody's own names, so that the folder may have another name.
    match = re.fullmatch(rf"(\d+)_(.*){_DATE}", stem)
    return (int(match[1]), match[2], suffix) if match else None


def other_parts(path: Path) -> list[str]:
    """Return the files beside one of which it may be a part: names that differ in numbers only."""
    like = re.sub(r"\d+", "#", unpacked_name(path.name))
    logs = [other.name for other in _inside(path.parent) if other.name != path.name]
    return [name for name in logs if re.sub(r"\d+", "#", unpacked_name(name)) == like]


def files_of(path: Path, *, recover: bool = False) -> Files:
    """Return the files of a recording in their order.

    A rosbag2 folder lists them in metadata.yaml. After a power loss this file is missing or empty;
    the names of all parts then tell, too. With ``recover``, all files of the folder are taken, in
    the order of their numbers.

    Raises LogError if files that are listed are missing, or nothing says what a folder holds.
    """
    if not path.exists():
        return Files([path])
    if not path.is_dir():
        about = _described(path.parent, is_named=False)
        is_whole = [*map(unpacked_name, about.names)] == [unpacked_name(path.name)]
        return Files([path], about.n_messages if is_whole else 0, warnings=about.faults)
    about = _described(path, is_named=True)
    inside = _inside(path)
    if about.names:
        listed = [_found(path / name) for name in about.names]
        if recover:
            return Files(sorted({*inside, *listed}, key=_numbered), about.n_messages)
        return Files(_complete(path, listed, inside), about.n_messages)
    if len(inside) == 1 or (recover and inside):
        return Files(inside, warnings=about.faults)
    if are_splits(path.name, [part.name for part in inside]):
        remark = f"by their names, the {len(inside)} files of the folder are one recording"
        missing = "" if about.faults else f"{METADATA} is missing; "
        return Files(inside, remarks=[missing + remark], warnings=about.faults)
    kinds = {"SQLite" if ".db3" in part.name.lower() else "MCAP" for part in inside} or {"MCAP"}
    raise LogError(
        f"is a folder with {len(inside)} {' and '.join(sorted(kinds))} files; name one"
        + (", or join them by `hiros recover FOLDER -o OUT`" if inside else ""),
        path=path,
    )


def _complete(folder: Path, listed: list[Path], inside: list[Path]) -> list[Path]:
    """Return the files that are listed, under other names if all have others; raises LogError."""
    missing = [part.name for part in listed if not part.is_file()]
    if missing == [part.name for part in listed] and len(inside) == len(listed):
        return inside
    if missing:
        more = f" and {len(missing) - _NAMED} more" if len(missing) > _NAMED else ""
        raise LogError(
            f"{METADATA} lists {', '.join(missing[:_NAMED])}{more}, which the folder lacks; copy "
            "the recording again, or join what is there by `hiros recover FOLDER -o OUT`",
            path=folder,
        )
    return listed


def _found(path: Path) -> Path:
    """Return a file that is listed, or the one that was unpacked or packed from it since."""
    plain = path.with_name(unpacked_name(path.name))
    names = (path, plain, *(plain.with_name(plain.name + suffix) for suffix in _PACKED))
    return next((name for name in names if name.is_file()), path)


def _inside(folder: Path) -> list[Path]:
    """Return the files of a recording in a folder; of a file and its compressed copy, the file."""
    paths = [p for p in folder.iterdir() if is_log_name(p.name, STORAGES) and not p.is_dir()]
    plain = {path.name for path in paths} & {unpacked_name(path.name) for path in paths}
    kept = (p for p in paths if p.name in plain or unpacked_name(p.name) not in plain)
    return sorted(kept, key=_numbered)


def _numbered(path: Path) -> tuple[list[tuple[int, str]], str]:
    """Key that puts bag_2 before bag_10."""
    parts = re.findall(r"\d+|\D+", path.stem)
    return [(int(p), "") if p.isdecimal() else (-1, p) for p in parts], path.name


class _Recorded(BaseModel):
    """What hiros takes from metadata.yaml."""

    relative_file_paths: list[str]
    compression_format: str | None = None
    compression_mode: str | None = None
    message_count: int = 0


class _Description(NamedTuple):
    """The content of metadata.yaml."""

    names: Sequence[str] = ()  # of the files
    n_messages: int = 0
    faults: Sequence[str] = ()  # why it was not used, if it cannot be understood


def _described(folder: Path, *, is_named: bool) -> _Description:
    """Read metadata.yaml; without ``is_named``, one that does not look as of rosbag2 is none.

    Raises LogError for a compression that only a plugin of rosbag2 can undo.
    """
    path = folder / METADATA
    if not path.exists() or not (is_named or _is_of_rosbag2(path)):
        return _Description()
    try:
        raw = read_yaml(path)
        info = _Recorded.model_validate(raw.get(_RECORDED) if isinstance(raw, dict) else None)
    except ConfigError as error:
        return _Description(faults=[f"{error}; it was not used"])
    except ValidationError as error:
        where, fault = explain(error)
        text = f"{path}: {'.'.join([_RECORDED, *where])}: {fault}"
        return _Description(faults=[f"{text}; it was not used"])
    kind = info.compression_format or "zstd"
    if kind != "zstd" and (info.compression_mode or "none").lower() != "none":
        raise LogError(
            f"is compressed by {kind!r}, which hiros cannot undo; convert it with `ros2 bag "
            "convert`, or record with --compression-format zstd",
            path=folder,
        )
    names = [PurePath(name).name for name in info.relative_file_paths]
    return _Description(names, info.message_count)
