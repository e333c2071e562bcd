"""Rows of people: moved into another frame, and copied into other arrays."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from hiros_mcap.kernels.array_types import F2, F3, I1, I2
from hiros_mcap.kernels.bytes import copy
from hiros_mcap.kernels.compile import entry, kernel, rows_of
from hiros_mcap.skeletons import Floats, People


class PoseArrays(NamedTuple):
    """K poses; the rotation is given twice, since each form is needed."""

    xyzw: F2  # (K, 4) unit quaternions
    matrices: F3  # (K, 3, 3)
    translations: F2  # (K, 3) m


@kernel
def _move_state(poses: PoseArrays, k: int, states: Floats, p: int, n: int) -> None:
    """Move state (p, n). Most of a state is absent: a NaN at the front stands for its vector."""
    matrix = poses.matrices
    for at in (0, 7, 10, 13, 16):  # position, velocities, accelerations
        if at >= states.shape[2]:
            break
        x, y, z = states[p, n, at], states[p, n, at + 1], states[p, n, at + 2]
        if math.isnan(x):
            for i in range(3):
                states[p, n, at + i] = x
            continue
        for i in range(3):
            states[p, n, at + i] = matrix[k, i, 0] * x + matrix[k, i, 1] * y + matrix[k, i, 2] * z
        if at == 0:
            for i in range(3):
                states[p, n, i] += poses.translations[k, i]
    bx, by, bz, bw = states[p, n, 3], states[p, n, 4], states[p, n, 5], states[p, n, 6]
    if math.isnan(bx):
        for i in range(3, 7):
            states[p, n, i] = bx
        return
    ax, ay, az, aw = poses.xyzw[k, 0], poses.xyzw[k, 1], poses.xyzw[k, 2], poses.xyzw[k, 3]
    states[p, n, 3] = aw * bx + ax * bw + ay * bz - az * by
    states[p, n, 4] = aw * by - ax * bz + ay * bw + az * bx
    states[p, n, 5] = aw * bz + ax * by - ay * bx + az * bw
    states[p, n, 6] = aw * bw - ax * bx - ay * by - az * bz


@kernel
def move(poses: PoseArrays, k: int, people: People) -> None:
    """Express people in another frame by pose ``k`` (Hi-ROS 2023, eq 5), in place.

    Positions are rotated and shifted; orientations are multiplied from the left; the linear and
    angular velocities and accelerations are rotated, which is exact for a frame at rest in the
    other. The sizes of a box stay. A vector whose first number is NaN becomes NaN.
    """
    boxes = people.boxes.reshape((len(people.boxes), 1, people.boxes.shape[1]))
    for p in range(len(people.ids)):
        for m in range(people.markers.shape[1]):
            _move_state(poses, k, people.markers, p, m)
        for n in range(people.links.shape[1]):
            _move_state(poses, k, people.links, p, n)
        _move_state(poses, k, boxes, p, np.int64(0))


@entry
def move_messages(poses: PoseArrays, rows: I2, people: People) -> None:
    """Move the people of N messages, whose ``rows`` (N, 2) are given, by a pose each."""
    for n in range(len(rows)):
        move(poses, n, rows_of(people, rows[n, 0], rows[n, 1]))


@kernel
def _copy_rows(to: Floats, at: int, source: Floats, begin: int, end: int) -> None:
    """Copy some rows of the first axis."""
    size = source.size // max(1, len(source)) * source.itemsize
    copy(to, at * size, source, begin * size, (end - begin) * size)


@kernel
def _widen_rows(to: Floats, at: int, source: Floats, begin: int, end: int) -> None:
    """Copy some rows of the first axis; what follows the columns of ``source`` becomes NaN."""
    if source.shape[2] == to.shape[2]:
        _copy_rows(to, at, source, begin, end)
        return
    for p in range(end - begin):
        for m in range(to.shape[1]):
            for c in range(source.shape[2]):
                to[at + p, m, c] = source[begin + p, m, c]
            for c in range(source.shape[2], to.shape[2]):
                to[at + p, m, c] = np.nan


@entry
def gather(rows: I2, targets: I1, people: People, target: People) -> None:
    """Copy the people of frames into ``target``; neighbours are copied together.

    ``rows`` (N, 2): first row of each frame, and the row after the last; ``targets`` (N,): the row
    that the first one becomes. ``target`` may have more columns of markers and links: these become
    NaN.
    """
    first = 0
    for k in range(len(rows)):
        begin, end, at = rows[first, 0], rows[k, 1], targets[first]
        is_last = k + 1 == len(rows)
        if not is_last and rows[k + 1, 0] == end and targets[k + 1] == at + end - begin:
            continue
        first = k + 1
        _copy_rows(target.ids, at, people.ids, begin, end)
        _copy_rows(target.stamps, at, people.stamps, begin, end)
        _copy_rows(target.confidences, at, people.confidences, begin, end)
        _widen_rows(target.markers, at, people.markers, begin, end)
        _copy_rows(target.marker_confidences, at, people.marker_confidences, begin, end)
        _widen_rows(target.links, at, people.links, begin, end)
        _copy_rows(target.link_confidences, at, people.link_confidences, begin, end)
        _copy_rows(target.boxes, at, people.boxes, begin, end)
