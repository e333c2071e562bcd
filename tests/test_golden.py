"""The sample logs give what they gave when their golden outputs were blessed."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

SAMPLES = Path(__file__).parent.parent / "sample_data"
sys.path.insert(0, str(SAMPLES))

import make  # noqa: E402


@pytest.mark.parametrize("log", make.LOGS, ids=lambda path: path.stem)
def test_output_is_golden(log: Path) -> None:
    assert make.differences(make.run(log)[0], make.filtered(make.golden_of(log))[0]) == []


def test_a_micrometre_and_a_person_are_noticed() -> None:
    golden, _ = make.filtered(make.golden_of(make.LOGS[0]))
    moved = golden[5].markers.copy()
    moved[0, 3, 1] += 1e-5
    broken = [*golden[:5], golden[5].replace(markers=moved), *golden[6:]]
    assert make.differences(broken, golden) == ["frame 5: positions off by up to 0.0100 mm"]
    renamed = [golden[0].replace(ids=golden[0].ids + np.int32(1)), *golden[1:]]
    assert "people" in make.differences(renamed, golden)[0]
