"""Numbers that tell how good a result is, by name, and thresholds on them."""

from __future__ import annotations

import json
import math
import operator
import os
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from hiros_mcap.errors import ConfigError
from hiros_mcap.evaluate import Scores, Truth
from hiros_mcap.evaluate.logs import (
    Consistency,
    consistency,
    evaluate_log,
    find_truth,
    read_channel,
)
from hiros_mcap.outputs import write_text

VERSION = 1


@dataclass(frozen=True, slots=True)
class Metric:
    """A number by name. ``better`` is -1 if less is better, 1 if more is, 0 if it must be equal."""

    unit: str
    better: int
    text: str
    floor: float = 0.0
    """Changes smaller than this never count."""


METRICS: Mapping[str, Metric] = {
    "people": Metric("", 0, "ids in the channel"),
    "frames": Metric("", 0, "frames in the channel"),
    "limb_cv": Metric("", -1, "coefficient of variation of limb lengths", 1e-3),
    "jitter": Metric("mm", -1, "mean norm of the second difference of joints", 0.1),
    "mpjpe": Metric("mm", -1, "mean joint error", 0.1),
    "mpjpe_sd": Metric("mm", -1, "standard deviation of the joint error", 0.1),
    "mpjpe_95": Metric("mm", -1, "95 % of the joint errors are below", 0.2),
    "pck_50": Metric("%", 1, "joints within 50 mm", 0.1),
    "pck_100": Metric("%", 1, "joints within 100 mm", 0.1),
    "angle_rmse": Metric("deg", -1, "flexion angles by joint positions", 0.05),
    "link_angle_rmse": Metric("deg", -1, "flexion angles by link orientations", 0.05),
    "turn": Metric("deg", -1, "mean turn of a link from the true one", 0.05),
    "limb_error": Metric("mm", -1, "mean error of limb lengths", 0.1),
    "lag": Metric("ms", -1, "delay against the truth, without its sign", 1.0),
    "missing": Metric("", -1, "true people without a skeleton, summed over frames"),
    "false": Metric("", -1, "skeletons of nobody, summed over frames"),
    "id_switches": Metric("", -1, "changes of a true person's id"),
    "mota": Metric("", 1, "1 - (missing + false + switches) / true", 1e-3),
    "idf1": Metric("", 1, "identity F1", 1e-3),
    "hota": Metric("", 1, "higher order tracking accuracy", 1e-3),
}
COUNTS = ("people", "frames", "missing", "false", "id_switches")

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

        Raises
        ------
        ConfigError
            It is not of this form, or there is no such metric, or its unit is another.
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

    def fault(self, values: Mapping[str, float]) -> str:
        """Return what is wrong, "" if the requirement is met."""
        value = values.get(self.metric, math.nan)
        if math.isnan(value):
            return f"{self.text}: {self.metric} is not known (no truth, or nothing to measure)"
        if _COMPARE[self.sign](value, self.value):
            return ""
        return f"{self.text}: is {shown(self.metric, value)}"


def shown(name: str, value: float) -> str:
    """Return a metric's value with its unit."""
    unit = METRICS[name].unit if name in METRICS else ""
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
    values = _own(consistency(frames, model))
    truth = find_truth(path) if truth is None else truth
    if truth is not None:
        values.update(_against(evaluate_log(path, truth, [topic])[topic].scores))
    return {name: values[name] for name in METRICS if not math.isnan(values.get(name, math.nan))}


def _own(own: Consistency) -> dict[str, float]:
    return {
        "people": len(own.people),
        "frames": own.frames,
        "limb_cv": own.limb_variation,
        "jitter": own.jitter,
    }


def _against(scores: Scores) -> dict[str, float]:
    return {
        "mpjpe": scores.mean,
        "mpjpe_sd": scores.deviation,
        "mpjpe_95": scores.percentile_95,
        "pck_50": 100 * scores.pck_at(50),
        "pck_100": 100 * scores.pck_at(100),
        "angle_rmse": scores.angle_rmse,
        "link_angle_rmse": scores.link_angle_rmse,
        "turn": scores.turn_error,
        "limb_error": scores.limb_error,
        "lag": abs(scores.lag),
        "missing": scores.missing,
        "false": scores.false,
        "id_switches": scores.switches,
        "mota": scores.tracking.mota,
        "idf1": scores.tracking.idf1,
        "hota": scores.tracking.hota,
    }


def worse(
    new: Mapping[str, float], golden: Mapping[str, float], share: float
) -> tuple[list[str], list[str]]:
    """Compare metrics: (what got worse by more than ``share``, what got better by more).

    Counts are compared exactly; a metric that the golden ones have and the new ones lack is worse.
    """
    faults, gains = [], []
    for name, was in golden.items():
        if name not in METRICS:
            continue
        now, metric = new.get(name, math.nan), METRICS[name]
        if math.isnan(now):
            faults.append(f"{name}: was {shown(name, was)}, is not known any more")
            continue
        slack = 0.0 if name in COUNTS else max(share * abs(was), metric.floor)
        change = f"{name}: was {shown(name, was)}, is {shown(name, now)}"
        if (metric.better == 0 and now != was) or metric.better * (was - now) > slack:
            faults.append(change)
        elif metric.better and metric.better * (now - was) > slack:
            gains.append(change)
    return faults, gains


def save_metrics(path: Path, topic: str, values: Mapping[str, float]) -> None:
    """Write golden metrics: JSON, one number a line, so that a change shows in a diff."""
    data = {"hiros_golden_metrics": VERSION, "channel": topic, "metrics": _rounded(values)}
    write_text(path, json.dumps(data, indent=1) + "\n")


def _rounded(values: Mapping[str, float]) -> dict[str, float]:
    return {name: float(f"{value:.6g}") for name, value in values.items()}


def load_metrics(path: Path) -> tuple[str, dict[str, float]]:
    """Read golden metrics: the channel and its numbers.

    Raises
    ------
    ConfigError
        The file is not what :func:`save_metrics` writes.
    """
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from error
    except ValueError as error:
        raise ConfigError(f"{path}: not JSON: {error}") from error
    values = data.get("metrics") if isinstance(data, dict) else None
    if not isinstance(values, dict) or data.get("hiros_golden_metrics") != VERSION:
        raise ConfigError(f"{path}: is not a file of golden metrics, version {VERSION}")
    if not all(isinstance(v, int | float) for v in values.values()):
        raise ConfigError(f"{path}: a metric is not a number")
    return str(data.get("channel")), {str(k): float(v) for k, v in values.items()}
