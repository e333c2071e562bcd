"""Unit quaternions in kernels: tuples x y z w, never views of arrays, which cost more.

Orientations and angular velocities are in the fixed frame, so rotations multiply from the left.
"""

from __future__ import annotations

import math

from hiros_mcap.kernels.compile import inlined

Quaternion = tuple[float, float, float, float]
Vector = tuple[float, float, float]


@inlined
def multiply(a: Quaternion, b: Quaternion) -> Quaternion:
    """Return the product: the rotation ``b`` followed by ``a``."""
    return (
        a[3] * b[0] + a[0] * b[3] + a[1] * b[2] - a[2] * b[1],
        a[3] * b[1] - a[0] * b[2] + a[1] * b[3] + a[2] * b[0],
        a[3] * b[2] + a[0] * b[1] - a[1] * b[0] + a[2] * b[3],
        a[3] * b[3] - a[0] * b[0] - a[1] * b[1] - a[2] * b[2],
    )


@inlined
def conjugate(q: Quaternion) -> Quaternion:
    """Return the inverse rotation."""
    return -q[0], -q[1], -q[2], q[3]


@inlined
def dot(a: Quaternion, b: Quaternion) -> float:
    """Scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3]


@inlined
def normalize(q: Quaternion) -> Quaternion:
    """Return ``q`` with length 1."""
    scale = 1.0 / math.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
    return q[0] * scale, q[1] * scale, q[2] * scale, q[3] * scale


@inlined
def exponential(x: float, y: float, z: float) -> Quaternion:
    """Quaternion of a rotation vector, rad."""
    square = x * x + y * y + z * z
    if square < 0.25:  # nearly always; the series are exact to 1e-11 and need no sine
        s = 0.5 + square * (-1 / 48 + square * (1 / 3840 - square / 645120))
        c = 1.0 + square * (-1 / 8 + square * (1 / 384 + square * (-1 / 46080 + square / 10321920)))
        return s * x, s * y, s * z, c
    angle = math.sqrt(square)
    s = math.sin(0.5 * angle) / angle
    return s * x, s * y, s * z, math.cos(0.5 * angle)


@inlined
def rotation_vector(q: Quaternion) -> Vector:
    """Rotation vector, rad, along the shortest path; the inverse of :func:`exponential`."""
    sign = 1.0 if q[3] >= 0.0 else -1.0
    square = q[0] * q[0] + q[1] * q[1] + q[2] * q[2]
    if square < 0.01:  # the series of the arc sine, exact to 1e-11
        scale = 2.0 * sign * (1.0 + square * (1 / 6 + square * (3 / 40 + square * (
            5 / 112 + square * 35 / 1152))))  # fmt: skip
    else:
        sine = math.sqrt(square)
        scale = 2.0 * sign * math.atan2(sine, abs(q[3])) / sine
    return scale * q[0], scale * q[1], scale * q[2]


@inlined
def difference(a: Quaternion, b: Quaternion) -> Vector:
    """Rotation vector, rad, that takes ``b`` to ``a`` along the shortest path."""
    return rotation_vector(multiply(a, conjugate(b)))


@inlined
def angle_of(product: float) -> float:
    """Angle, rad in [0, pi], between quaternions of this scalar product (Hi-ROS 2023, eq 10)."""
    return 2.0 * math.acos(min(1.0, abs(product)))  # eq 10
