"""Stages remember people, and forget those who are gone."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hiros_mcap.skeletons import Floats
from hiros_mcap.stages.bank import Bank

SECOND = 1_000_000_000


class Past(NamedTuple):
    """A number for each person."""

    numbers: Floats


def bank_of(person, *seconds):
    """A bank that forgets after 1 s, and that has seen somebody, in one block."""
    bank = Bank(Past(np.zeros(0)), forget_after=1.0)
    seen(bank, person, *seconds)
    bank.past.numbers[bank.rows[person]] = 7.0
    return bank


def seen(bank, person, *seconds):
    """See somebody in one block; return what is remembered."""
    stamps = (np.array(seconds) * SECOND).astype(np.int64)
    rows = bank.rows_of(np.full(len(stamps), person, np.int32), stamps)
    return float(bank.past.numbers[rows[-1]])


def test_who_was_seen_at_the_end_of_the_last_block_is_remembered():
    assert seen(bank_of(1, 0.0, 0.5, 0.9), 1, 1.7) == 7.0


def test_who_comes_back_too_late_starts_anew():
    assert seen(bank_of(1, 0.0, 0.5, 0.9), 1, 2.0) == 0.0


def test_who_is_gone_at_the_end_of_a_block_is_forgotten():
    bank = bank_of(1, 0.0)
    seen(bank, 2, 0.5, 1.0, 1.5)
    assert set(bank.rows) == {2}


def test_few_people_take_few_rows():
    bank = Bank(Past(np.zeros(0)))
    for person, size in enumerate([2, 2, 4, 4, 8, 8]):
        bank.row(person, 0)
        assert len(bank.past.numbers) == size


def test_a_long_block_of_somebody_is_no_absence():
    assert seen(bank_of(1, 0.0), 1, 0.5, 1.3, 2.1) == 7.0
