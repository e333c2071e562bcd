"""Logs that several tests read."""

from __future__ import annotations

from pathlib import Path

import pytest

SAMPLES = Path(__file__).parent.parent / "sample_data"


@pytest.fixture(scope="session")
def crossing() -> Path:
    """Two people who cross, three cameras, 5 s."""
    return SAMPLES / "two_people_crossing.mcap"


@pytest.fixture(scope="session")
def walking() -> Path:
    """One person who walks, three cameras, 3 s."""
    return SAMPLES / "one_person_walking.mcap"
