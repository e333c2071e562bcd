"""The numbers of a skeleton that a check compares, and how far two results may differ."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import floor, log10
from pathlib import Path
from typing import Any, Self, TypeVar

import numpy as np
from pydantic import ConfigDict, Field, NonNegativeFloat, ValidationError, model_validator

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
Read = Callable[[Frame, int], Floats]
"""(frame, row of a person) -> (N, D) numbers of N named elements; NaN = absent."""
Names = Callable[[SkeletonModel], Sequence[str]]
"""Model -> what the N elements are called."""
Distance = Callable[[Floats, Floats], Floats]
"""(..., D), (..., D) -> (...) distance in the unit of the tolerance."""


@dataclass(frozen=True, slots=True)
class Quantity:
    """One kind of number of a skeleton."""

    name: str
    tolerance: float
    """Distances up to this do not count, unless a file says so. The defaults forgive another
    machine, not another algorithm. In m, degrees, s and their derivatives."""
    unit: str  # of a distance as it is shown
    values: str  # unit of the numbers themselves
    read: Read
    distance: Distance
    names: Names
    scale: float = 1.0  # unit of the tolerance -> unit of a distance as it is shown

    @property
    def limit(self) -> str:
        """Name of its tolerance: boxes have that of positions."""
        return "positions" if self.name == "box sizes" else self.name.replace(" ", "_")

    def shown(self, distance: float) -> str:
        """Return a distance as text."""
        return f"{self.scale * distance:.4g} {self.unit}".rstrip()

    def value(self, numbers: Floats, decimals: int) -> str:
        """Return the numbers of one element as text."""
        rounded = (round(x, decimals) for x in numbers.tolist())
        return f"{', '.join(f'{x:.12g}' for x in rounded)} {self.values}".rstrip()


def _states(columns: slice) -> Read:
    """Columns of the KinematicState of all markers, all links and the box."""

    def read(frame: Frame, row: int) -> Floats:
        box = frame.boxes[row : row + 1, :STATE]
        return np.concatenate([frame.markers[row], frame.links[row], box])[:, columns]

    return read


def _state_names(model: SkeletonModel) -> Sequence[str]:
    return (*model.marker_names, *(f"link {name}" for name in model.link_names), "box")


def _confidences(frame: Frame, row: int) -> Floats:
    skeleton = frame.confidences[row : row + 1]
    each = frame.marker_confidences[row], frame.link_confidences[row]
    return np.concatenate([skeleton, *each])[:, None]


def _times(frame: Frame, row: int) -> Floats:
    """(2, 1) Source time and log time after the frame's stamp, ns."""
    stamp = int(frame.stamps[row])
    source = stamp - frame.stamp if stamp else np.nan
    return np.array([[source], [frame.log_time - frame.stamp]], np.float64)


def _norm(was: Floats, now: Floats) -> Floats:
    return np.asarray(np.linalg.norm(now - was, axis=-1))


def _degrees(was: Floats, now: Floats) -> Floats:
    return np.degrees(angle(was, now))


def _degree_rates(was: Floats, now: Floats) -> Floats:
    return np.degrees(_norm(was, now))


def _seconds(was: Floats, now: Floats) -> Floats:
    return np.asarray(np.abs(now - was)[..., 0] / 1e9)


def _state(
    name: str, tolerance: float, units: tuple[str, str], columns: slice, distance: Distance = _norm
) -> Quantity:
    """Part of the KinematicState; units of a distance, and of the numbers."""
    return Quantity(name, tolerance, *units, _states(columns), distance, _state_names)


_POSITIONS = replace(_state("positions", 1e-6, ("mm", "m"), POSITION), scale=1000.0)
QUANTITIES = (
    _POSITIONS,
    # 1e-6 m at the end of a limb of 0.5 m.
    _state("orientations", 1e-4, ("deg", "(x y z w)"), ORIENTATION, _degrees),
    _state("velocities", 1e-4, ("m/s", "m/s"), VELOCITY),
    _state("angular velocities", 1e-2, ("deg/s", "rad/s"), ANGULAR_VELOCITY, _degree_rates),
    _state("accelerations", 1e-2, ("m/s2", "m/s2"), ACCELERATION),
    _state("angular accelerations", 1.0, ("deg/s2", "rad/s2"), ANGULAR_ACCELERATION, _degree_rates),
    Quantity(
        "confidences",
        1e-6,
        "",
        "",
        _confidences,
        _norm,
        lambda model: ("skeleton", *_state_names(model)[:-1]),
    ),
    replace(
        _POSITIONS,
        name="box sizes",
        read=lambda frame, row: frame.boxes[row : row + 1, STATE:],
        names=lambda _: ("box",),
    ),
    Quantity(
        *("times", 1e-6, "ms", "ns after the frame's stamp"),
        *(_times, _seconds, lambda _: ("source time", "log time"), 1000.0),
    ),
)
"""In the order in which reports name them."""


SUFFIX = ".tolerances.toml"


LIMITS = {quantity.limit: quantity.tolerance for quantity in QUANTITIES}


class Tolerances(Params):
    """Differences that do not count: of :data:`QUANTITIES` by the names of their limits, and these.

    If a change is meant to alter the numbers, give the suite thresholds on metrics instead.
    """

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, NonNegativeFloat]

    lengths: NonNegativeFloat = Field(1e-6, description="m, of a calibrated limb.")
    frames: NonNegativeFloat = Field(0.0, le=1, description="Share of frames that may be missing.")
    people: NonNegativeFloat = Field(
        0.0, le=1, description="Share of a channel's skeletons that may be missing, new or renamed."
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        for name in self.__pydantic_extra__.keys() - LIMITS:
            raise ValueError(f"{name}: there is no such key")
        if not math.isfinite(self.limit("times")):
            raise ValueError("times: should be a finite number")
        return self

    def limit(self, name: str) -> float:
        """Return a limit of :data:`LIMITS`."""
        return self.__pydantic_extra__.get(name, LIMITS[name])

    def of(self, quantity: Quantity) -> float:
        """Return the largest distance that does not count."""
        return self.limit(quantity.limit)


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


def beside(golden: Path) -> Tolerances:
    """Tolerances from ``GOLDEN.tolerances.toml`` (its suffix replaced), else the defaults."""
    path = golden.with_suffix(SUFFIX)
    return load_tolerances(path) if path.is_file() else Tolerances()


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
    worst: dict[str, float] = field(default_factory=dict)  # element -> its largest distance
    vanished: Counter[str] = field(default_factory=Counter)
    """Element -> skeletons in which it is absent now."""
    appeared: Counter[str] = field(default_factory=Counter)
    """Element -> skeletons in which it was absent before."""
    place: str = ""  # where the distance is largest: element, person, time
    was: str = ""  # the numbers there in the golden log
    now: str = ""  # the numbers there in the new one
    _squares: float = 0.0
    _count: int = 0

    @property
    def rms(self) -> float:
        """Root mean square of the distances."""
        return float(np.sqrt(self._squares / self._count)) if self._count else 0.0

    def add(
        self, pairs: Sequence[Pair], model: SkeletonModel, tolerance: float, start: int
    ) -> tuple[Pair, str] | None:
        """Compare some skeletons; return the first that differs, and how."""
        names = self.quantity.names(model)
        was = np.stack([self.quantity.read(pair.was, pair.was_row) for pair in pairs])
        now = np.stack([self.quantity.read(pair.now, pair.now_row) for pair in pairs])
        before, after = _present(was), _present(now)
        for counts, mask in ((self.vanished, before & ~after), (self.appeared, after & ~before)):
            counts.update(
                {names[k]: int(mask[:, k].sum()) for k in np.flatnonzero(mask.any(axis=0)).tolist()}
            )
        both = before & after
        # Rounding gives two equal orientations a distance above 0.
        differs = both & (was != now).any(axis=-1)
        distance = np.where(differs, self.quantity.distance(was, now), 0.0)
        self._squares += float((distance * distance).sum())
        self._count += int(both.sum())
        for k in np.nonzero(distance.any(axis=0))[0].tolist():
            self.worst[names[k]] = max(float(distance[:, k].max()), self.worst.get(names[k], 0.0))
        if distance.max(initial=0.0) > self.largest:
            s, k = divmod(int(distance.argmax()), distance.shape[1])
            self.largest = float(distance[s, k])
            decimals = max(3, 2 - floor(log10(np.abs(was[s, k] - now[s, k]).max())))
            self.was, self.now = (self.quantity.value(x[s, k], decimals) for x in (was, now))
            seconds = (pairs[s].was.stamp - start) / 1e9
            self.place = f"{names[k]} of person {pairs[s].person} at {seconds:.3f} s"
        # What is absent or new has no distance, and tells more than one.
        distance[before != after] = np.inf
        wrong = distance > tolerance
        if not wrong.any():
            return None
        s = int(wrong.any(axis=1).argmax())
        k = int(distance[s].argmax())
        kind = "" if self.quantity.name == "positions" else f" ({self.quantity.name})"
        what = f"{names[k]}{kind} of person {pairs[s].person}"
        if np.isfinite(distance[s, k]):
            return pairs[s], f"{what} is off by {self.quantity.shown(float(distance[s, k]))}"
        return pairs[s], f"{what} is {'absent' if before[s, k] else 'new'}"


def _present(numbers: Floats) -> Flags:
    return np.asarray(~np.isnan(numbers).any(axis=-1))


SHOWN = 5


def worst(values: Mapping[str, float], shown: Callable[[float], str]) -> str:
    """Return the largest values with their names, the largest first."""
    ordered = sorted(values.items(), key=lambda item: -item[1])[:SHOWN]
    return ", ".join(f"{name} {shown(value)}" for name, value in ordered)


def most(counts: Counter[str]) -> str:
    """Return the highest counts with their names."""
    rest = f" and {len(counts) - SHOWN} more" if len(counts) > SHOWN else ""
    return ", ".join(f"{name} ({n})" for name, n in counts.most_common(SHOWN)) + rest


def union(old: SkeletonModel, new: SkeletonModel) -> SkeletonModel:
    """Return a model with the markers and links of both, by name; the old ones come first."""
    markers = dict.fromkeys([*old.marker_names, *new.marker_names])
    links = dict.fromkeys([*old.link_names, *new.link_names])
    return SkeletonModel.of(markers, [(name, -1, -1) for name in links])


def widened(frame: Frame, narrow: SkeletonModel, model: SkeletonModel) -> Frame:
    """Return a frame with the slots of another model that has at least its own names."""
    markers = [model.marker_names.index(name) for name in narrow.marker_names]
    links = [model.link_names.index(name) for name in narrow.link_names]
    result = Frame.empty(frame.n_people, model)
    for name, slots in (("marker", markers), ("link", links)):
        for array in (f"{name}s", f"{name}_confidences"):
            getattr(result, array)[:, slots] = getattr(frame, array)
    return frame.replace(
        markers=result.markers,
        marker_confidences=result.marker_confidences,
        links=result.links,
        link_confidences=result.link_confidences,
    )
