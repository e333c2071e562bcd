"""The Kalman filter of a point that moves, or turns, smoothly: covariance, gain, update.

The state is a position, its velocity and its acceleration, or the first two of them. The axes do
not influence each other and share their noises, so they share one covariance, a tuple of the upper
triangle ``00 01 02 11 12 22`` (0 position, 1 velocity, 2 acceleration). A state without
acceleration has zeros in ``02``, ``12`` and ``22``. Measured is the position.

A step is: ``predict`` with a process noise, ``innovation_variance``, ``gain``, ``correct``. The
caller moves the state itself, since positions add and orientations multiply.
"""

from __future__ import annotations

from hiros_mcap.kernels.compile import inlined

Covariance = tuple[float, float, float, float, float, float]
Gain = tuple[float, float, float]


@inlined
def white_jerk(dt: float, density: float) -> Covariance:
    """Process noise of ``dt`` s of constant acceleration that white jerk disturbs.

    ``density`` is the jerk's spectral density: its SD squared, m2/s5 for a position.
    """
    q = density
    dt2 = dt * dt
    dt3 = dt2 * dt
    return q * dt3 * dt2 / 20, q * dt2 * dt2 / 8, q * dt3 / 6, q * dt3 / 3, q * dt2 / 2, q * dt


@inlined
def white_acceleration(dt: float, density: float) -> Covariance:
    """Process noise of ``dt`` s of constant velocity; ``density`` as above, m2/s3."""
    return density * dt**3 / 3, density * dt**2 / 2, 0.0, density * dt, 0.0, 0.0


@inlined
def prior(position: float, velocity: float, acceleration: float) -> Covariance:
    """Covariance of a new state, of these variances."""
    return position, 0.0, 0.0, velocity, 0.0, acceleration


@inlined
def predict(p: Covariance, dt: float, process: Covariance) -> Covariance:
    """Covariance ``dt`` s later: F P F' + Q."""
    p00, p01, p02, p11, p12, p22 = p
    h = 0.5 * dt * dt
    dt2 = dt * dt
    return (
        p00 + 2 * dt * p01 + 2 * h * p02 + dt2 * p11 + 2 * dt * h * p12 + h * h * p22 + process[0],
        p01 + dt * p02 + dt * p11 + (dt2 + h) * p12 + dt * h * p22 + process[1],
        p02 + dt * p12 + h * p22 + process[2],
        p11 + 2 * dt * p12 + dt2 * p22 + process[3],
        p12 + dt * p22 + process[4],
        p22 + process[5],
    )


@inlined
def innovation_variance(p: Covariance, measurement: float, square: float, gate: float) -> float:
    """Variance of an innovation, H P H' + R, of which ``square`` is the squared length.

    Beyond ``gate`` standard deviations R is inflated until the innovation lies on the gate (as
    eq 10 of Malaguti 2019 does): a guessed joint moves the state a little, and a real fast motion,
    whose innovations agree with each other, still moves it. An infinite gate inflates nothing.
    """
    return max(p[0] + measurement, square / (gate * gate))


@inlined
def gain(p: Covariance, variance: float) -> Gain:
    """Kalman gain P H' / S of position, velocity and acceleration; S is ``variance``."""
    part = 1.0 / variance  # quicker than three quotients
    return p[0] * part, p[1] * part, p[2] * part


@inlined
def correct(p: Covariance, k: Gain) -> Covariance:
    """Covariance after the measurement: (I - K H) P."""
    p00, p01, p02, p11, p12, p22 = p
    return (
        p00 - k[0] * p00, p01 - k[0] * p01, p02 - k[0] * p02,
        p11 - k[1] * p01, p12 - k[1] * p02, p22 - k[2] * p02,
    )  # fmt: skip
