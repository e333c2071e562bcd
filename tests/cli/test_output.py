"""What may be overwritten, and what may not."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from hiros_cli.output import check_target
from hiros_mcap.errors import ConfigError


def test_a_new_file_may_be_written(tmp_path: Path) -> None:
    check_target(tmp_path / "new.mcap", force=False)


def test_an_empty_file_may_be_replaced(tmp_path: Path) -> None:
    target = tmp_path / "made-by-mktemp"
    target.touch()
    check_target(target, force=False)


def test_a_recording_is_not_replaced_without_force(tmp_path: Path) -> None:
    target = tmp_path / "recording.mcap"
    target.write_bytes(b"\x89MCAP0\r\n" + bytes(100))
    with pytest.raises(ConfigError, match="--force"):
        check_target(target, force=False)
    check_target(target, force=True)


def test_a_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="is a folder"):
        check_target(tmp_path, force=True)


def test_a_missing_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no such folder"):
        check_target(tmp_path / "missing" / "out.mcap", force=False)


def test_a_pipe_is_refused_even_with_force(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(ConfigError, match="pipe"):
        check_target(tmp_path / "pipe", force=True)
