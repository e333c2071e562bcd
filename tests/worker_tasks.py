"""Tasks for other processes, which import this module and nothing of the tests."""

from __future__ import annotations

import os
import signal
import tempfile
import time
from pathlib import Path

from hiros_mcap.errors import LogError


def square(number):
    return number * number


def where(_):
    return os.getpid()


def refuse(number):
    if number == 3:
        raise LogError("is damaged", path="lab.mcap", topic="/camera")
    return number


def die(number):
    if number == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def dies_once(flag):
    if not Path(flag).exists():
        Path(flag).touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return os.getpid()


def hold(folder):
    """Hold a temporary folder until somebody stops it."""
    with tempfile.TemporaryDirectory() as temporary:
        (Path(folder) / f"{os.getpid()}.started").write_text(temporary)
        time.sleep(60)


def hold_second(folder, number):
    if number == 1:
        hold(folder)
