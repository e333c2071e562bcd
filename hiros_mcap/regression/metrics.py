"""Numbers that say how good a result is, by name, and thresholds on them."""

from __future__ import annotations

import math
import operator
import os
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from hiros_mcap.errors import ConfigError
from hiros_mcap.evaluate import Truth
from hiros_mcap.evaluate.logs import consistency, evaluate_log, find_truth, read_channel
from hiros_mcap.evaluate.measures import CONSISTENCY, MEASURES
from hiros_mcap.regression.differences import Difference

_FORM = re.compile(r"\s*(\w+)\s*(<=|>=|==|=|!=|<|>)\s*([-+]?[\d.]+(?:[eE][-+]?\d+)?)\s*(\S*)\s*")
_COMPARE: dict[str, Callable[[float, float], bool]] = {
    "<=": operator.le, ">=": operator.ge, "<": operator.lt, ">": operator.gt, "=": operator.eq,
    "==": operator.eq, "!=": operator.ne,
}  # fmt: skip


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
        if name not in MEASURES:
            raise ConfigError(f"no metric {name!r} (there are: {', '.join(MEASURES)})")
        if unit and unit != (its := MEASURES[name].unit):
            raise ConfigError(f"threshold {text!r}: {name} is in {its or 'no unit'}")
        try:
            return cls(" ".join(text.split()), name, sign, float(number))
        except ValueError:
            raise ConfigError(f"threshold {text!r}: {number!r} is not a number") from None

    def difference(self, values: Mapping[str, float]) -> Difference | None:
        """Return what is required and what is instead; None if the requirement is met."""
        value = values.get(self.metric, math.nan)
        required = f"required {self.sign} {MEASURES[self.metric].shown(self.value)}"
        if math.isnan(value):
            now = "not known (no truth, or nothing to measure)"
        elif _COMPARE[self.sign](value, self.value):
            return None
        else:
            now = MEASURES[self.metric].shown(value)
        return Difference("metrics", self.metric, required, now)


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
    of_result = consistency(frames, model)
    values = {m.name: m.compared(of_result) for m in CONSISTENCY}
    truth = find_truth(path) if truth is None else truth
    if truth is not None:
        scores = evaluate_log(path, truth, [topic])[topic].scores
        values = {name: m.compared(scores) for name, m in MEASURES.items()} | values
    return {name: value for name, value in values.items() if not math.isnan(value)}
