"""Logs that several tests read."""

from __future__ import annotations

import os
import signal
import sys
import tempfile
from pathlib import Path

import pytest

from hiros_cli.app import SINGLE_THREADED

for variable in SINGLE_THREADED:  # as the program does, before anything imports numpy
    os.environ.setdefault(variable, "1")

SAMPLES = Path(__file__).parent.parent / "sample_data"


def pytest_configure():
    """Ignore what the parent ignores (nohup, a background job) by a handler, not by SIG_IGN.

    Programs that tests start and stop would inherit SIG_IGN.
    """
    for name in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(name) is signal.SIG_IGN:
            signal.signal(name, lambda *_: None)


@pytest.fixture(autouse=True)
def _signals():
    """Give pytest its signal handlers back after a command was run in its process."""
    names = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGALRM)
    before = {name: signal.getsignal(name) for name in names}
    hook = sys.unraisablehook
    yield
    sys.unraisablehook = hook
    for name, handler in before.items():
        signal.signal(name, handler)


@pytest.fixture
def nothing_left(tmp_path, monkeypatch):
    """The folder of temporary files, in which nothing may be left."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    yield folder
    assert not list(folder.iterdir())


@pytest.fixture
def without_curves(monkeypatch):
    """Pages without their pictures, which take seconds: for tests of all else about a page."""
    monkeypatch.setattr("hiros_viewer.page.png_of", lambda figure: b"")


@pytest.fixture(scope="module")
def coarse_plans():
    """Plans of a few places on the floor: for tests of all else about a plan."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("hiros_mcap.plan.planning._CELLS", 80)
        patch.setattr("hiros_mcap.plan.planning._TRIED_CELLS", 24)
        yield


@pytest.fixture(scope="session")
def crossing(tmp_path_factory):
    """Two people who cross, three cameras, 2 s."""
    return beginning("two_people_crossing.mcap", 2.0, tmp_path_factory)


@pytest.fixture(scope="session")
def walking(tmp_path_factory):
    """One person who walks, three cameras, 1.5 s."""
    return beginning("one_person_walking.mcap", 1.5, tmp_path_factory)


@pytest.fixture(scope="session")
def whole_crossing(tmp_path_factory):
    """Two people who cross, three cameras, 5 s: for what needs a longer log."""
    return beginning("two_people_crossing.mcap", 5.0, tmp_path_factory)


@pytest.fixture(scope="session")
def whole_walking():
    """One person who walks, three cameras, 3 s: for what needs a longer log."""
    return SAMPLES / "one_person_walking.mcap"


def beginning(name, seconds, tmp_path_factory):
    """Write the first seconds of a sample log; return its path."""
    from whole_commands import first_seconds

    return first_seconds(SAMPLES / name, seconds, tmp_path_factory.mktemp("sample") / name)


@pytest.fixture(scope="session")
def short(walking, tmp_path_factory):
    """The first second of one person who walks."""
    from whole_commands import first_seconds

    return first_seconds(walking, 1.0, tmp_path_factory.mktemp("short") / "walk.mcap")
