"""Joints that most cameras see elsewhere: a camera that is outvoted there has no weight.

A detector that puts a limb to a wrong place leaves it there for a while. A filter stays with the
camera that it believed first, right or wrong. But of three cameras or more, most are right: their
measurements z_k of a joint at an instant have a centre, the geometric median (Weiszfeld 1937),

    c = argmin sum_k |z_k - c|.

A camera is outvoted if its distance from c is over LIMIT, over CLEARLY times the median distance of
all cameras, and over BEYOND standard deviations of its own noise. The variance of its measurement
grows by SHARE times the square of the distance. Where all cameras differ, nobody knows who is
right, and all count as before. The measurements are taken to the middle of their times by the
velocity of the centre.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from hiros_mcap.kernels.array_types import F1, F2, F3, I1, arrays
from hiros_mcap.kernels.compile import entry, kernel
from hiros_mcap.kernels.points import geometric_median, point_distance
from hiros_mcap.skeletons import Floats
from hiros_mcap.stages.bank import Bank
from hiros_mcap.stages.fuse.fusing import Sightings

LIMIT = 0.08
"""m. With .06 to .1, logs of detectors that err by limbs are alike within 4 %; ideal ones lose up
to .1 mm below."""
_CLEARLY = 1.5  # 1.5 and 1.9 are alike
_BEYOND = 3.0  # so no joint is outvoted that counts little anyway, guessed or hidden
_SHARE = 100.0  # a wrong place lasts: 30 to 1000 are alike
_MAJORITY = 3  # cameras that measure the joint
_RECENT = 0.2  # s for which a velocity is believed


class LastCentres(NamedTuple):
    """Where the cameras saw S people the last time that three of them did."""

    times: F2  # (S, M) s; 0 = never
    places: F3  # (S, M, 3) m
    velocities: F3  # (S, M, 3) m/s


class VoteWork(NamedTuple):
    """Scratch for the views of one person by up to C cameras."""

    views: I1  # (C,) rows of the views
    voters: I1  # (C,) those of them that measure a joint
    places: F2  # (C, 3) m
    distances: F1  # (C,) from the centre, m
    ordered: F1  # (C,) the same, sorted
    centre: F1  # (3,)

    @classmethod
    def of(cls, cameras: int) -> VoteWork:
        """Make room."""
        c = cameras
        return arrays(cls, c, c, (c, 3), c, c, 3)


class Majority:
    """Finds measurements that are outvoted; remembers how joints move."""

    def __init__(self, markers: int) -> None:
        m = markers
        self._bank = Bank(arrays(LastCentres, (0, m), (0, m, 3), (0, m, 3)))

    def vote(self, views: Sightings, variances: Floats) -> None:
        """Write ``views.outvoted``.

        Parameters
        ----------
        views : all that the cameras saw at some instants, which come once, in their order.
        variances : (N, M) of the measurements along each axis, m2.
        """
        rows = self._bank.rows_of(views.people.astype(np.int32), views.stamps)
        most = int(np.unique(views.instants, return_counts=True)[1].max(initial=1))
        outvote(views, variances, rows, self._bank.past, VoteWork.of(most))


@kernel
def _gather(
    views: Sightings, members: int, m: int, row: int, past: LastCentres, work: VoteWork
) -> tuple[int, float]:
    """Take what a person's views measure of a joint to the middle of their times.

    Returns how many there are, and the middle, s.
    """
    n, middle = 0, 0.0
    for k in range(members):
        view = work.views[k]
        if not math.isnan(views.positions[view, m, 0]):
            work.voters[n] = view
            middle += views.stamps[view] * 1e-9
            n += 1
    middle /= max(n, 1)
    moves = middle - past.times[row, m] < _RECENT
    for k in range(n):
        view = work.voters[k]
        later = middle - views.stamps[view] * 1e-9 if moves else 0.0
        for c in range(3):
            place, speed = views.positions[view, m, c], past.velocities[row, m, c]
            work.places[k, c] = place + later * speed
    return n, middle


@kernel
def _remember(row: int, m: int, time: float, past: LastCentres, work: VoteWork) -> None:
    """Keep the centre of a joint, and the mean of its last velocities."""
    passed = time - past.times[row, m]
    for c in range(3):
        speed = 0.0
        if 0.0 < passed < _RECENT:
            latest = (work.centre[c] - past.places[row, m, c]) / passed
            speed = 0.5 * (past.velocities[row, m, c] + latest)
        past.velocities[row, m, c] = speed
        past.places[row, m, c] = work.centre[c]
    past.times[row, m] = time


@kernel
def _vote(n: int, m: int, variances: Floats, outvoted: Floats, work: VoteWork) -> None:
    """Write by how much the variances of those of the first ``n`` voters grow who are outvoted."""
    for k in range(n):
        work.distances[k] = point_distance(work.places[k], work.centre)
        at = k
        while at > 0 and work.ordered[at - 1] > work.distances[k]:
            work.ordered[at] = work.ordered[at - 1]
            at -= 1
        work.ordered[at] = work.distances[k]
    limit = max(LIMIT, _CLEARLY * work.ordered[(n - 1) // 2])
    for k in range(n):
        view, distance = work.voters[k], work.distances[k]
        if distance > max(limit, _BEYOND * math.sqrt(3.0 * variances[view, m])):
            outvoted[view, m] = _SHARE * distance * distance


@entry
def outvote(views: Sightings, variances: F2, rows: I1, past: LastCentres, work: VoteWork) -> None:
    """Write ``views.outvoted``, which is 0; see :meth:`Majority.vote`.

    Parameters
    ----------
    rows : (N,) of the people in ``past``.
    work : has room for the views of an instant.
    """
    n = len(rows)
    for first in range(n):
        members, is_first = 0, True
        at = first
        while at > 0 and views.instants[at - 1] == views.instants[first]:
            at -= 1
            is_first = is_first and views.people[at] != views.people[first]
        at = first
        while is_first and at < n and views.instants[at] == views.instants[first]:
            if views.people[at] == views.people[first]:
                work.views[members] = at
                members += 1
            at += 1
        for m in range(variances.shape[1] if members >= _MAJORITY else 0):
            voters, middle = _gather(views, members, m, rows[first], past, work)
            if voters >= _MAJORITY:
                geometric_median(work.places, voters, work.centre)
                _vote(voters, m, variances, views.outvoted, work)
                _remember(rows[first], m, middle, past, work)
