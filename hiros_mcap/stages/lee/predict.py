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
from typing import NamedTuple

import numpy as np

from hiros_mcap.events import Events
from hiros_mcap.skeletons import (
    ACCELERATION,
    POSITION,
    UNTRACKED,
    VELOCITY,
    Flags,
    Floats,
    Frame,
    SkeletonModel,
    Stamps,
)
from hiros_mcap.stages.bank import Bank
from hiros_mcap.stages.lee.lee_params import PredictParams
from hiros_mcap.stages.point_filter import correct, seconds
from hiros_mcap.stages.point_filter import predict as carried_on

STEP = 1 / 30  # s: time step of Q, the period of the paper's cameras
_SIZES = {"constant_position": 1, "constant_velocity": 2, "constant_acceleration": 3}


class PredictedPeople(NamedTuple):
    """The filters of all people: R rows, M joints, S elements of the state."""

    stamps: Stamps  # (R,) time of the state, ns
    started: Flags  # (R, M) joints that were measured at least once
    seen: Stamps  # (R, M) time of the last measurement, ns
    states: Floats  # (R, M, S, 3) position, m, and its derivatives per step
    covariances: Floats  # (R, M, S, S), per R and step


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
    m, size = (0, model.n_markers), _SIZES[params.model]
    seen, states, covariances = np.zeros(m, np.int64), np.zeros((*m, size, 3)), (*m, size, size)
    nobody = np.zeros(0, np.int64), seen > 0, seen, states, np.zeros(covariances)
    bank = Bank(PredictedPeople(*nobody), params.max_gap)
    for frame in frames:
        bank.expire(frame.stamp)
        out = frame.replace(markers=frame.markers.copy())
        stamps = np.where(frame.stamps == 0, frame.stamp, frame.stamps)
        people, rows = [], []
        for k, (person, stamp) in enumerate(zip(frame.ids.tolist(), stamps.tolist(), strict=True)):
            if person == UNTRACKED:
                continue
            if stamp <= bank.last_seen.get(person, -1):
                events.count("predict: time not increasing", frame.source)
                continue
            people.append(k)
            rows.append(bank.row(person, stamp))
        if people:
            filtered = _filtered(bank.past, rows, out.markers[people], stamps[people], params)
            out.markers[people] = filtered
        yield out


def _filtered(
    past: PredictedPeople, rows: list[int], markers: Floats, stamps: Stamps, params: PredictParams
) -> Floats:
    """(P, M, 19) Replace the measured positions, and fill in the derivatives of the state.

    All variances are multiples of R. Q is that of every element of the state and accumulates.

    Parameters
    ----------
    rows : row of each person in ``past``. stamps : (P,) times, ns.
    """
    x, p, now = past.states[rows], past.covariances[rows], stamps[:, None]
    unit = np.eye(x.shape[2])
    steps = seconds(now - past.stamps[rows][:, None]) / STEP
    measured = markers[..., POSITION].copy()
    is_seen = ~np.isnan(measured[..., 0])
    goes_on = past.started[rows] & (seconds(now - past.seen[rows]) <= params.max_gap)
    old, new = is_seen & goes_on, is_seen & ~goes_on

    x, p = carried_on(x, p, steps, params.noise_ratio * steps[..., None, None] * unit)  # X~, P~
    corrected, q = correct(x, p, measured, np.ones(is_seen.shape))  # K, X^, P
    result = corrected if params.output == "corrected" else x  # "X~ is used"
    markers[old, POSITION] = result[old, 0]
    x[old], p[old] = corrected[old], q[old]
    x[new], p[new] = 0.0, unit
    x[new, 0] = measured[new]
    for order, columns in zip(range(1, x.shape[2]), (VELOCITY, ACCELERATION), strict=False):
        markers[is_seen, columns] = x[is_seen, order] / STEP**order

    past.states[rows], past.covariances[rows], past.stamps[rows] = x, p, stamps
    past.started[rows] |= is_seen
    past.seen[rows] = np.where(is_seen, now, past.seen[rows])
    return markers
