"""Odd text for every reader of text: it is read, or refused in one line."""

from __future__ import annotations

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from text_readers import READERS, WORDS_OF_OTHERS, odd_text

from hiros_mcap.errors import HirosError


@pytest.mark.parametrize("name", READERS)
@settings(
    max_examples=25,
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(data=st.data())
def test_odd_text_is_read_or_refused(name, data, tmp_path):
    kind, read = READERS[name]
    path = tmp_path / "in" / f"x.{kind}"
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(data.draw(odd_text(kind)))
    try:
        read(path)
    except HirosError as error:
        assert "\n" not in str(error)
    except ValueError:
        assert name in WORDS_OF_OTHERS
    assert [entry.name for entry in tmp_path.iterdir()] == ["in"]
