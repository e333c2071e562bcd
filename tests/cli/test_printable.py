"""Nothing from a log may drive the terminal."""

from __future__ import annotations

import unicodedata

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hiros_cli.output import LIMIT, error_line, printable
from hiros_mcap.errors import ConfigError, LogError


@pytest.mark.parametrize(
    ("raw", "safe"),
    [
        ("/k1/skeletons", "/k1/skeletons"),
        ("Größe 3 m², 山田", "Größe 3 m², 山田"),
        ("a\x1b[2Jb", "a\\x1b[2Jb"),
        ("one\ntwo\r\tthree", "one\\ntwo\\r\\tthree"),
        ("\x9b31m", "\\x9b31m"),
        ("gpj.\u202eexe", "gpj.\\u202eexe"),
        ("line\u2028separator", "line\\u2028separator"),
        ("\udcff.mcap", "\\udcff.mcap"),
    ],
)
def test_unsafe_characters_become_escapes(raw, safe):
    assert printable(raw) == safe


@given(st.text())
def test_any_text_is_one_short_line_without_controls(raw):
    safe = printable(raw)
    assert len(safe) <= LIMIT
    assert not any(unicodedata.category(char) in {"Cc", "Cf", "Zl", "Zp", "Cs"} for char in safe)


def test_a_long_string_says_that_it_was_cut():
    assert printable("x" * 1_000_000) == "x" * (LIMIT - 1) + "…"


def test_an_error_line_escapes_each_part():
    error = LogError("no such\nthing", path="in.mcap", topic="/a\x1bb")
    assert error_line(error) == "hiros: error: in.mcap: /a\\x1bb: no such\\nthing"


def test_an_os_error_names_the_file_and_not_the_number():
    error = PermissionError(13, "Permission denied", "/root/x.mcap")
    assert error_line(error) == "hiros: error: /root/x.mcap: Permission denied"


def test_a_config_error_is_its_own_line():
    assert error_line(ConfigError("no preset 'x'")) == "hiros: error: no preset 'x'"
