"""Lee's Kalman filter: every joint predicted on its own (Lee et al. 2022, section 2.2.3).

The paper prints Q = 0.01 and R = 1, but neither the model A, nor units, nor the size of the state.
The gain depends on Q / R alone, so there is one parameter, and the unit of length does not matter.
The unit of time does: the step of Q is the paper's frame, 1/30 s, whatever the rate of a log. Q
accumulates with the time that has passed. With these numbers, a constant position (A = I) has a
gain of .095. It lags by a third of a second, 30 cm at walking speed, which contradicts the paper's
own errors. A constant velocity has a gain of .37 and follows steady motion without lag. It is the
default.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from hiros_mcap.events import Events
from hiros_mcap.kernels.array_types import settings_of
from hiros_mcap.skeletons import UNTRACKED, Frame, SkeletonModel
from hiros_mcap.stages.bank import Bank
from hiros_mcap.stages.lee import predicting as kernels
from hiros_mcap.stages.lee.lee_params import PredictParams

_SIZES = {"constant_position": 1, "constant_velocity": 2, "constant_acceleration": 3}


def predict(
    frames: Iterable[Frame], model: SkeletonModel, params: PredictParams | None = None,
    events: Events | None = None,
) -> Iterator[Frame]:  # fmt: skip
    """Filter marker positions; fill in velocities, and accelerations if they are estimated.

    Parameters
    ----------
    frames : merged frames, by time; people are told apart by id. Untracked people pass unchanged,
        as do links and absent joints. A new joint stays where it is measured.
    model : the skeleton. params : see :class:`PredictParams`.
    events : counts "predict: time not increasing" (a person passes unchanged).
    """
    if not model.n_markers:  # a log of an empty room
        yield from frames
        return
    params, events = params or PredictParams(), Events() if events is None else events
    corrected = params.output == "corrected"
    settings = settings_of(kernels.PredictSettings, params, corrected=corrected)
    empty = kernels.PredictedPeople.empty(model.n_markers, _SIZES[params.model])
    bank = Bank(empty, params.max_gap)
    for frame in frames:
        bank.expire(frame.stamp)
        out = frame.replace(markers=frame.markers.copy())
        stamps = np.where(frame.stamps == 0, frame.stamp, frame.stamps)
        rows = np.full(frame.n_people, -1, np.int64)
        for k, (person, stamp) in enumerate(zip(frame.ids.tolist(), stamps.tolist(), strict=True)):
            if person == UNTRACKED:
                continue
            if stamp <= bank.last_seen.get(person, -1):
                events.count("predict: time not increasing", frame.source)
                continue
            rows[k] = bank.row(person, stamp)
        kernels.filter_people(bank.past, out.markers, rows, stamps, settings)
        yield out
