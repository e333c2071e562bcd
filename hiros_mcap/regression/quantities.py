"""The numbers of a skeleton that a check compares, and how far two results may differ."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from math import floor, log10
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from pydantic import Field, NonNegativeFloat, ValidationError

from hiros_mcap.body.rotations import angle
from hiros_mcap.errors import ConfigError
from hiros_mcap.outside import read_toml
from hiros_mcap.params import Params, explain
from hiros_mcap.skeletons import (
    ACCELERATION,
    ANGULAR_ACCELERATION,
    ANGULAR_VELOCITY,
    ORIENTATION,
    POSITION,
    STATE,
    VELOCITY,
    Flags,
    Floats,
    Frame,
    SkeletonModel,
)

P = TypeVar("P", bound=Params)


class Tolerances(Params):
    """Differences that do not count: they forgive another machine, not another algorithm.

    If a change is meant to alter the numbers, give the suite thresholds on metrics instead.
    """

    positions: NonNegativeFloat = Field(1e-6, description="m; also of links, and sizes of boxes.")
    orientations: NonNegativeFloat = Field(
        1e-4, description="deg; 1e-6 m at the end of a limb of 0.5 m."
    )
    velocities: NonNegativeFloat = Field(1e-4, description="m/s.")
    angular_velocities: NonNegativeFloat = Field(1e-2, description="deg/s.")
    accelerations: NonNegativeFloat = Field(1e-2, description="m/s2.")
    angular_accelerations: NonNegativeFloat = Field(1.0, description="deg/s2.")
    confidences: NonNegativeFloat = 1e-6
    times: NonNegativeFloat = Field(
        1e-6, allow_inf_nan=False, description="s; of frames, and of their source and log times."
    )
    frames: NonNegativeFloat = Field(0.0, le=1, description="Share of frames that may be missing.")
    people: NonNegativeFloat = Field(
        0.0, le=1, description="Share of a channel's skeletons that may be missing, new or renamed."
    )

    def of(self, quantity: Quantity) -> float:
        """Return the largest distance that does not count."""
        limit: float = getattr(self, quantity.name.replace(" ", "_"))
        return limit


def load_tolerances(path: Path) -> Tolerances:
    """Read tolerances from a TOML file.

    Raises ConfigError if the file cannot be read, or holds something else.
    """
    return validated(Tolerances, read_toml(path), str(path))


def validated(kind: type[P], table: dict[str, Any], origin: str) -> P:
    """Return what a table holds; ``origin`` names it in errors."""
    try:
        return kind.model_validate(table)
    except ValidationError as error:
        where, message = explain(error)
        raise ConfigError(": ".join([origin, *filter(None, [".".join(where)]), message])) from None


SUFFIX = ".tolerances.toml"


def beside(golden: Path) -> Tolerances:
    """Tolerances from ``GOLDEN.tolerances.toml`` (its suffix replaced), else the defaults."""
    path = golden.with_suffix(SUFFIX)
    return load_tolerances(path) if path.is_file() else Tolerances()


Distance = Callable[[Floats, Floats], Floats]


def _norm(was: Floats, now: Floats) -> Floats:
    return np.asarray(np.linalg.norm(now - was, axis=-1))


@dataclass(frozen=True, slots=True)
class Quantity:
    """One kind of number of a skeleton. Its tolerance has the same name."""

    name: str
    unit: str  # of a distance as it is shown
    values: str  # unit of the numbers themselves
    read: Callable[[Frame, int], Floats]
    """(frame, row of a person) -> (N, D) numbers of N named elements; NaN = absent."""
    names: Callable[[SkeletonModel], Sequence[str]]
    """Model -> what the N elements are called."""
    distance: Distance = _norm
    """(..., D), (..., D) -> (...) distance in the unit of the tolerance."""
    scale: float = 1.0  # unit of the tolerance -> unit of a distance as it is shown

    def shown(self, distance: float) -> str:
        """Return a distance as text."""
        return f"{self.scale * distance:.4g} {self.unit}".rstrip()

    def value(self, numbers: Floats, decimals: int) -> str:
        """Return the numbers of one element as text."""
        rounded = (round(x, decimals) for x in numbers.tolist())
        return f"{', '.join(f'{x:.12g}' for x in rounded)} {self.values}".rstrip()


def _states(frame: Frame, row: int, columns: slice) -> Floats:
    """Columns of the KinematicState of all markers, all links and the box."""
    box = frame.boxes[row : row + 1, :STATE]
    return np.concatenate([frame.markers[row], frame.links[row], box])[:, columns]


def _positions(frame: Frame, row: int) -> Floats:
    return np.concatenate([_states(frame, row, POSITION), frame.boxes[row : row + 1, STATE:]])


def _state_names(model: SkeletonModel) -> tuple[str, ...]:
    return (*model.marker_names, *(f"link {name}" for name in model.link_names), "box")


def _confidences(frame: Frame, row: int) -> Floats:
    skeleton = frame.confidences[row : row + 1]
    each = frame.marker_confidences[row], frame.link_confidences[row]
    return np.concatenate([skeleton, *each])[:, None]


def _times(frame: Frame, row: int) -> Floats:
    """(2, 1) Source time and log time after the frame's stamp, s."""
    stamp = int(frame.stamps[row])
    source = stamp - frame.stamp if stamp else np.nan
    return np.array([[source], [frame.log_time - frame.stamp]], np.float64) / 1e9


def _degrees(was: Floats, now: Floats) -> Floats:
    return np.degrees(angle(was, now))


def _degree_rates(was: Floats, now: Floats) -> Floats:
    return np.degrees(_norm(was, now))


def _state(
    name: str, unit: str, values: str, columns: slice, distance: Distance = _norm
) -> Quantity:
    read = partial(_states, columns=columns)
    return Quantity(name, unit, values, read, _state_names, distance)


QUANTITIES = (
    Quantity(
        "positions",
        "mm",
        "m",
        _positions,
        lambda model: (*_state_names(model), "box size"),
        scale=1000.0,
    ),
    _state("orientations", "deg", "(x y z w)", ORIENTATION, _degrees),
    _state("velocities", "m/s", "m/s", VELOCITY),
    _state("angular velocities", "deg/s", "rad/s", ANGULAR_VELOCITY, _degree_rates),
    _state("accelerations", "m/s2", "m/s2", ACCELERATION),
    _state("angular accelerations", "deg/s2", "rad/s2", ANGULAR_ACCELERATION, _degree_rates),
    Quantity(
        "confidences",
        "",
        "",
        _confidences,
        lambda model: ("skeleton", *_state_names(model)[:-1]),
    ),
    Quantity(
        "times",
        "ms",
        "s after the frame's stamp",
        _times,
        lambda _: ("source time", "log time"),
        scale=1000.0,
    ),
)
"""In the order in which reports name them."""


@dataclass(frozen=True, slots=True)
class Pair:
    """The same person in a frame of the golden log and in the new one."""

    index: int  # of the golden frame
    was: Frame
    was_row: int
    now: Frame
    now_row: int

    @property
    def person(self) -> int:
        """Id in the golden log."""
        return int(self.was.ids[self.was_row])


@dataclass(slots=True)
class QuantityComparison:
    """One quantity of a channel against its golden self; distances in the tolerance's unit."""

    quantity: Quantity
    largest: float = 0.0
    rms: float = 0.0
    worst: Mapping[str, float] = field(default_factory=dict)  # element -> its largest distance
    vanished: Mapping[str, int] = field(default_factory=dict)
    """Element -> skeletons in which it is absent now."""
    appeared: Mapping[str, int] = field(default_factory=dict)
    """Element -> skeletons in which it was absent before."""
    place: str = ""  # where the distance is largest: element, person, time
    was: str = ""  # the numbers there in the golden log
    now: str = ""  # the numbers there in the new one
    first: tuple[Pair, str] | None = None  # the first skeleton that differs, and how

    @classmethod
    def of(
        cls, quantity: Quantity, pairs: Sequence[Pair], model: SkeletonModel, tolerance: float,
        start: int,
    ) -> QuantityComparison:  # fmt: skip
        """Compare skeletons, at least one; ``start`` is the golden channel's first stamp, ns."""
        names = quantity.names(model)
        was = np.stack([quantity.read(pair.was, pair.was_row) for pair in pairs])
        now = np.stack([quantity.read(pair.now, pair.now_row) for pair in pairs])
        before, after = _present(was), _present(now)
        both = before & after
        # Rounding gives two equal orientations a distance above 0.
        differs = both & (was != now).any(axis=-1)
        distance = np.where(differs, quantity.distance(was, now), 0.0)
        peaks = dict(zip(names, distance.max(axis=0).tolist(), strict=True))
        result = cls(
            quantity,
            float(distance.max(initial=0.0)),
            float(np.sqrt((distance**2).sum() / max(both.sum(), 1))),
            {name: peak for name, peak in peaks.items() if peak},
            _counts(names, before & ~after),
            _counts(names, after & ~before),
        )
        if result.largest:
            s, k = divmod(int(distance.argmax()), distance.shape[1])
            decimals = max(3, 2 - floor(log10(np.abs(was[s, k] - now[s, k]).max())))
            result.was, result.now = (quantity.value(x[s, k], decimals) for x in (was, now))
            seconds = (pairs[s].was.stamp - start) / 1e9
            result.place = f"{names[k]} of person {pairs[s].person} at {seconds:.3f} s"
        # What is absent or new has no distance, and tells more than one.
        distance[before != after] = np.inf
        wrong = (distance > tolerance).any(axis=1)
        if wrong.any():
            s = int(wrong.argmax())
            k = int(distance[s].argmax())
            change = f"is off by {quantity.shown(float(distance[s, k]))}"
            if before[s, k] != after[s, k]:
                change = f"is {'absent' if before[s, k] else 'new'}"
            kind = "" if quantity.name == "positions" else f" ({quantity.name})"
            result.first = pairs[s], f"{names[k]}{kind} of person {pairs[s].person} {change}"
        return result


def _present(numbers: Floats) -> Flags:
    return np.asarray(~np.isnan(numbers).any(axis=-1))


def _counts(names: Sequence[str], mask: Flags) -> dict[str, int]:
    counts = zip(names, mask.sum(axis=0).tolist(), strict=True)
    return {name: count for name, count in counts if count}


SHOWN = 5


def worst(values: Mapping[str, float], shown: Callable[[float], str]) -> str:
    """Return the largest values with their names, the largest first."""
    ordered = sorted(values.items(), key=lambda item: -item[1])[:SHOWN]
    return ", ".join(f"{name} {shown(value)}" for name, value in ordered)


def most(counts: Mapping[str, int]) -> str:
    """Return the highest counts with their names."""
    rest = f" and {len(counts) - SHOWN} more" if len(counts) > SHOWN else ""
    ordered = Counter(counts).most_common(SHOWN)
    return ", ".join(f"{name} ({n})" for name, n in ordered) + rest
