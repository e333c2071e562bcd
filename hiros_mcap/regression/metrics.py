"""Numbers that say how good a result is, by name, and thresholds on them."""

from __future__ import annotations

import json
import math
import operator
import os
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from hiros_mcap.errors import ConfigError
from hiros_mcap.evaluate import Scores, Truth
from hiros_mcap.evaluate.logs import consistency, evaluate_log, find_truth, read_channel
from hiros_mcap.outputs import write_text
from hiros_mcap.outside import parse, read_text
from hiros_mcap.regression.differences import Difference
from hiros_mcap.regression.provenance import Provenance

VERSION = 1


@dataclass(frozen=True, slots=True)
class Metric:
    """A number that a golden file or a threshold may name."""

    unit: str
    better: int
    """-1 if less is better, 1 if more is, 0 if it must be equal."""
    floor: float
    """Changes up to this never count; 0 for counts, which may not get worse at all."""
    of: Callable[[Scores], float] | None = None
    """How to read it from scores against a truth; None = it needs no truth."""


METRICS: Mapping[str, Metric] = {
    "people": Metric("", 0, 0),
    "frames": Metric("", 0, 0),
    "limb_cv": Metric("", -1, 1e-3),
    "jitter": Metric("mm", -1, 0.1),
    "mpjpe": Metric("mm", -1, 0.1, lambda s: s.mean),
    "mpjpe_sd": Metric("mm", -1, 0.1, lambda s: s.deviation),
    "mpjpe_95": Metric("mm", -1, 0.2, lambda s: s.percentile_95),
    "pck_50": Metric("%", 1, 0.1, lambda s: 100 * s.pck_at(50)),
    "pck_100": Metric("%", 1, 0.1, lambda s: 100 * s.pck_at(100)),
    "angle_rmse": Metric("deg", -1, 0.05, lambda s: s.angle_rmse),
    "link_angle_rmse": Metric("deg", -1, 0.05, lambda s: s.link_angle_rmse),
    "orientation_error": Metric("deg", -1, 0.05, lambda s: s.orientation_error),
    "limb_error": Metric("mm", -1, 0.1, lambda s: s.limb_error),
    "lag": Metric("ms", -1, 1.0, lambda s: abs(s.lag)),
    "missing": Metric("", -1, 0, lambda s: s.missing),
    "false": Metric("", -1, 0, lambda s: math.nan if s.false is None else s.false),
    "id_switches": Metric("", -1, 0, lambda s: s.switches),
    "mota": Metric("", 1, 1e-3, lambda s: s.tracking.mota),
    "idf1": Metric("", 1, 1e-3, lambda s: s.tracking.idf1),
    "hota": Metric("", 1, 1e-3, lambda s: s.tracking.hota),
}
"""docs/evaluating.md says what they are; ``hiros eval`` has them in its tables."""

_FORM = re.compile(r"\s*(\w+)\s*(<=|>=|==|=|!=|<|>)\s*([-+]?[\d.]+(?:[eE][-+]?\d+)?)\s*(\S*)\s*")
_COMPARE: dict[str, Callable[[float, float], bool]] = {
    "<=": operator.le,
    ">=": operator.ge,
    "<": operator.lt,
    ">": operator.gt,
    "=": operator.eq,
    "==": operator.eq,
    "!=": operator.ne,
}


@dataclass(frozen=True, slots=True)
class Threshold:
    """A requirement such as ``mpjpe <= 25 mm``."""

    text: str
    metric: str
    sign: str
    value: float

    @classmethod
    def parse(cls, text: str) -> Threshold:
        """Read ``metric sign number [unit]``.

        Raises ConfigError if it is not of this form, or there is no such metric, or its unit is
        another.
        """
        form = _FORM.fullmatch(text)
        if form is None:
            raise ConfigError(f"threshold {text!r} is not of the form 'mpjpe <= 25 mm'")
        name, sign, number, unit = form.groups()
        if name not in METRICS:
            raise ConfigError(f"no metric {name!r} (there are: {', '.join(METRICS)})")
        if unit and unit != METRICS[name].unit:
            raise ConfigError(f"threshold {text!r}: {name} is in {METRICS[name].unit or 'no unit'}")
        try:
            return cls(" ".join(text.split()), name, sign, float(number))
        except ValueError:
            raise ConfigError(f"threshold {text!r}: {number!r} is not a number") from None

    def difference(self, values: Mapping[str, float]) -> Difference | None:
        """Return what is required and what is instead; None if the requirement is met."""
        value = values.get(self.metric, math.nan)
        required = f"required {self.sign} {shown(self.metric, self.value)}"
        if math.isnan(value):
            now = "not known (no truth, or nothing to measure)"
        elif _COMPARE[self.sign](value, self.value):
            return None
        else:
            now = shown(self.metric, value)
        return Difference("metrics", self.metric, required, now)


def shown(name: str, value: float) -> str:
    """Return a metric's value with its unit."""
    unit = METRICS[name].unit
    return f"{value:.4g}{' ' if unit else ''}{unit}"


def metrics_of(
    path: str | os.PathLike[str], topic: str, truth: Truth | None = None
) -> dict[str, float]:
    """Measure a channel of a log; what needs a truth is left out without one.

    Parameters
    ----------
    path : what ``hiros process`` wrote. topic : the channel.
    truth : None = the log's own /truth channel, if it has one.
    """
    frames, model, _ = read_channel(path, topic)
    own = consistency(frames, model)
    values: dict[str, float] = {
        "people": len(own.people),
        "frames": own.frames,
        "limb_cv": own.limb_variation,
        "jitter": own.jitter,
    }
    truth = find_truth(path) if truth is None else truth
    if truth is not None:
        scores = evaluate_log(path, truth, [topic])[topic].scores
        values.update({name: m.of(scores) for name, m in METRICS.items() if m.of is not None})
    return {name: value for name, value in values.items() if not math.isnan(value)}


def worse(
    new: Mapping[str, float], golden: Mapping[str, float], share: float
) -> tuple[list[Difference], list[Difference]]:
    """Compare metrics: (what got worse by more than ``share``, what got better by more).

    Counts are compared exactly. A metric that only the golden ones have is worse.
    """
    losses, gains = [], []
    for name, was in golden.items():
        now, metric = new.get(name, math.nan), METRICS[name]
        if math.isnan(now):
            losses.append(Difference("metrics", name, shown(name, was), "not known any more"))
            continue
        slack = max(share * abs(was), metric.floor) if metric.floor else 0.0
        change = Difference("metrics", name, shown(name, was), shown(name, now))
        if (metric.better == 0 and now != was) or metric.better * (was - now) > slack:
            losses.append(change)
        elif metric.better * (now - was) > slack:
            gains.append(change)
    return losses, gains


@dataclass(frozen=True, slots=True)
class GoldenMetrics:
    """What a golden file of metrics holds."""

    channel: str
    values: Mapping[str, float]
    provenance: Provenance = field(default_factory=Provenance)


def save_metrics(path: Path, golden: GoldenMetrics) -> None:
    """Write golden metrics: JSON, one number a line, so that a change shows in a diff."""
    rounded = {name: float(f"{value:.6g}") for name, value in golden.values.items()}
    data = {
        "hiros_golden_metrics": VERSION,
        "channel": golden.channel,
        "metrics": rounded,
        "provenance": golden.provenance.to_json(),
    }
    write_text(path, json.dumps(data, indent=1) + "\n")


def load_metrics(path: Path) -> GoldenMetrics:
    """Read golden metrics.

    Raises ConfigError if the file is not what :func:`save_metrics` writes, or names a metric that
    does not exist.
    """
    data = parse(read_text(path), "JSON", path)
    values = data.get("metrics") if isinstance(data, dict) else None
    if not isinstance(values, dict) or data.get("hiros_golden_metrics") != VERSION:
        raise ConfigError(f"{path}: is not a file of golden metrics, version {VERSION}")
    for name, value in values.items():
        if name not in METRICS:
            raise ConfigError(f"{path}: no metric {name!r} (there are: {', '.join(METRICS)})")
        if not isinstance(value, int | float) or not math.isfinite(value):
            raise ConfigError(f"{path}: {name} is not a number")
    numbers = {name: float(value) for name, value in values.items()}
    provenance = Provenance.from_json(data.get("provenance"), path)
    return GoldenMetrics(str(data.get("channel")), numbers, provenance)
