"""Whole commands on altered files: 0, 2 or 3, one line of error, and nothing else touched."""

from __future__ import annotations

import tempfile
from pathlib import Path

import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from whole_commands import COMMANDS, altered, faults_of, write_files


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("files")
    write_files(folder)
    return folder


@pytest.mark.parametrize("name", COMMANDS)
def test_files_without_a_fault_are_taken(name, files, tmp_path):
    data = (files / COMMANDS[name].altered).read_bytes()
    assert faults_of(name, files, data, tmp_path, codes=frozenset({0})) == []


@pytest.mark.parametrize("name", COMMANDS)
@settings(
    max_examples=2,
    deadline=None,
    derandomize=True,
    database=None,
    phases=[Phase.generate],
    suppress_health_check=list(HealthCheck),
)
@given(data=st.data())
def test_altered_files_are_taken_or_refused_in_one_line(name, files, data):
    with tempfile.TemporaryDirectory() as folder:
        assert faults_of(name, files, data.draw(altered(name, files)), Path(folder)) == []
