"""Lee's Kalman filter: every joint predicted on its own (Lee et al. 2022, section 2.2.3).

The paper prints Q = 0.01 and R = 1, but neither the model A, nor units, nor the size of the state.
The gain depends on Q / R only, so that the unit of length is of no account. That of time is: the
step here is the paper's frame, 1/30 s, whatever the rate of a log, and Q grows with the time that
has passed. With these numbers a standing model (A = I) has a gain of .095 and lags by a third of a
second, which would be 30 cm at walking speed and contradicts the paper's own errors; constant
velocity has a gain of .37 and follows steady motion without lag. It is the default.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Literal

import numpy as np
from pydantic import Field

from hiros_mcap.events import Events
from hiros_mcap.params import Params
from hiros_mcap.skeletons import UNTRACKED, Frame, SkeletonModel

STEP = 1 / 30
"""s: time step of Q, the period of the paper's cameras."""
_SIZES = {"constant_position": 1, "constant_velocity": 2, "constant_acceleration": 3}


class PredictParams(Params):
    """Parameters of Lee's Kalman filter."""

    model: Literal["constant_position", "constant_velocity", "constant_acceleration"] = Field(
        "constant_velocity",
        description="State space A. Not given in the paper; a constant position would lag by a "
        "third of a second.",
    )
    process_noise: float = Field(
        0.01,
        gt=0,
        description="Q (paper): variance that every element of the state gains in 1/30 s, in m and "
        "steps of 1/30 s. Only Q / R counts: at other rates the filter is as smooth in seconds.",
    )
    measurement_noise: float = Field(
        1.0, gt=0, description="R (paper): variance of a measured position, m2."
    )
    output: Literal["predicted", "corrected"] = Field(
        "predicted",
        description="The position predicted from the frames before, which the paper takes, or that "
        "corrected by the frame itself: less error, as smooth.",
    )
    max_gap: float = Field(
        0.5, gt=0, description="s without data after which a person or a joint starts anew."
    )


def predict(
    frames: Iterable[Frame],
    model: SkeletonModel,
    params: PredictParams = PredictParams(),  # noqa: B008 - immutable
    events: Events | None = None,
) -> Iterator[Frame]:
    """Filter marker positions; fill in velocities, and accelerations if they are estimated.

    Parameters
    ----------
    frames : merged frames, by time; people are told apart by id. Untracked people pass unchanged,
        as do links and absent joints. A new joint is where it is measured.
    model : the skeleton. params : see :class:`PredictParams`.
    events : counts "predict: time not increasing" (a person passed unchanged).
    """
    events = Events() if events is None else events
    people: dict[int, _Person] = {}
    gap = params.max_gap * 1e9
    for frame in frames:
        people = {i: person for i, person in people.items() if frame.stamp - person.stamp <= gap}
        out = frame.replace(markers=frame.markers.copy())
        for row, number in enumerate(frame.ids.tolist()):
            stamp = int(frame.stamps[row]) or frame.stamp
            if number == UNTRACKED:
                continue
            person = people.get(number)
            if person is None:
                person = people[number] = _Person(model, params, stamp)
            elif stamp <= person.stamp:
                events.count("predict: time not increasing", frame.source)
                continue
            person.step(out, row, stamp)
        yield out


class _Person:
    """State of the joints of one person."""

    def __init__(self, model: SkeletonModel, params: PredictParams, stamp: int) -> None:
        from hiros_mcap.kernels.predicting import predict_and_correct

        self.kernel = predict_and_correct
        size, n = _SIZES[params.model], model.n_markers
        self.params = params
        self.stamp = stamp
        self.state = np.zeros((n, size, 3))
        self.covariance = np.zeros((n, size, size))
        self.age = np.full(n, np.inf)

    def step(self, out: Frame, row: int, stamp: int) -> None:
        """Replace what is measured in a row of ``out`` by what the filter knows."""
        params = self.params
        self.kernel(
            out.markers, row, (stamp - self.stamp) * 1e-9 / STEP, STEP, params.process_noise,
            params.measurement_noise, params.max_gap / STEP, params.output == "corrected",
            self.state, self.covariance, self.age,
        )  # fmt: skip
        self.stamp = stamp
