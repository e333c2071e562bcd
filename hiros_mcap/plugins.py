"""Plugins: detector readers and systems of installed packages, by their entry points."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from traceback import walk_tb
from typing import Any

from hiros_mcap._version import __version__
from hiros_mcap.errors import ConfigError

DETECTORS, SYSTEMS = "hiros.detectors", "hiros.systems"
_KINDS = {DETECTORS: "detector reader", SYSTEMS: "system"}


@cache
def installed(group: str) -> Mapping[str, EntryPoint]:
    """Return the entry points of a group by their names; nothing of the packages is imported.

    Raises ConfigError where two packages bring one name.
    """
    points = list(entry_points(group=group))
    for name, number in Counter(point.name for point in points).items():
        if number > 1:
            packages = " and ".join(_package(point) for point in points if point.name == name)
            raise ConfigError(
                f"{packages} bring a {_KINDS[group]} called {name}; uninstall all but one"
            )
    return {point.name: point for point in points}


def names(group: str) -> list[str]:
    """Return the names of a group for a list; none where packages contradict each other."""
    try:
        return sorted(installed(group))
    except ConfigError:
        return []


def load(point: EntryPoint) -> Any:
    """Import what an entry point names; raises ConfigError with the package and the remedy."""
    try:
        return point.load()
    except (Exception, SystemExit) as error:  # anything can go wrong in it
        raise faulty(point, f"cannot be loaded: {error or type(error).__name__}") from error


def faulty(point: EntryPoint, fault: str) -> ConfigError:
    """Return the error of an entry point."""
    return ConfigError(
        f"the {_KINDS[point.group]} {point.name} ({point.value}) of {_package(point)} {fault}; "
        f"install a version for hiros {__version__}, or uninstall it"
    )


def failed(error: Exception) -> ConfigError | None:
    """Return the error of the entry point whose code an exception passed through; None if none."""
    points = {point.module: point for group in _KINDS for point in entry_points(group=group)}
    for frame, _ in walk_tb(error.__traceback__):
        if point := points.get(frame.f_globals.get("__name__", "")):
            return faulty(point, f"failed: {type(error).__name__}: {error}")
    return None


def _package(point: EntryPoint) -> str:
    return f"the package {point.dist.name}" if point.dist else "a package without a name"
