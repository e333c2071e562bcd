"""Centroids of people on the floor, and their Kalman filters (Malaguti et al. 2019, III-A)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hiros_mcap.kernels.array_types import F1, F2, F3, I1, arrays
from hiros_mcap.kernels.compile import entry
from hiros_mcap.kernels.distance import centre
from hiros_mcap.kernels.kalman_filter import prior, white_acceleration
from hiros_mcap.kernels.point_filter import TRIANGLE, correct, predict, start
from hiros_mcap.skeletons import POSITION

NOISE_RATE = 30.0
"""Hz: the noise of one second is that of so many steps of the paper's model (33 ms)."""
STARTING_SPEED = 1.0  # m/s, SD per axis of what was just seen for the first time
_X = POSITION.start


class Centroids(NamedTuple):
    """The filters K_i of T tracks."""

    stamps: I1  # (T,) time of the state, ns
    states: F3  # (T, 2, 2) position, m, and velocity, m/s, on the floor
    covariances: F2  # (T, 6) of ``kalman_filter``
    detections: I1  # (T,) how many detections were associated

    @classmethod
    def empty(cls) -> Centroids:
        """Return no tracks."""
        return arrays(cls, 0, (0, 2, 2), (0, TRIANGLE), 0)


class CentroidSettings(NamedTuple):
    """Parameters of ``associate`` that the kernels need."""

    gate: float
    position_noise: float
    acceleration: float


@entry
def find_centroids(markers: F3, centroids: F2) -> None:
    """Write the means of the known markers of (P, M, 19) into (P, 3), m; NaN where none is."""
    for p in range(len(markers)):
        centre(markers[p], centroids[p])


@entry
def start_track(
    tracks: Centroids, row: int, now: int, centroid: F1, settings: CentroidSettings
) -> None:
    """Start a track at a centroid (3,), m, at ``now``, ns."""
    covariance = prior(settings.position_noise**2, STARTING_SPEED**2, 0.0)
    start(tracks.states[row], tracks.covariances[row], centroid[:2], covariance)
    tracks.stamps[row], tracks.detections[row] = now, 1


@entry
def predict_tracks(tracks: Centroids, rows: I1, now: int, settings: CentroidSettings) -> None:
    """Carry the tracks in ``rows`` on to ``now``, ns."""
    for row in rows:
        dt = (now - tracks.stamps[row]) * 1e-9
        process = white_acceleration(dt, settings.acceleration**2 / NOISE_RATE)
        predict(tracks.states[row], tracks.covariances[row], dt, process)  # z^ of eq 2
        tracks.stamps[row] = now


@entry
def association_cost(
    tracks: Centroids, rows: I1, centroids: F2, settings: CentroidSettings, cost: F2
) -> None:
    """Write the cost of every track in ``rows`` and centroid (D, 3) into (T, D).

    The vector of eq 2 is the gain times the innovation. With the gain K = P H' / (p00 + r), its
    Mahalanobis distance by P is the squared innovation times p00 / (p00 + r)^2.
    """
    r = settings.position_noise**2
    for t in range(len(rows)):
        position, p00 = tracks.states[rows[t], 0], tracks.covariances[rows[t], 0]
        for d in range(len(centroids)):
            squared = (centroids[d, 0] - position[0]) ** 2 + (centroids[d, 1] - position[1]) ** 2
            distance = squared * p00 / (p00 + r) ** 2  # eq 2 and 3
            cost[t, d] = distance if distance <= settings.gate else np.inf  # epsilon


@entry
def correct_tracks(
    tracks: Centroids, matches: I1, centroids: F2, settings: CentroidSettings
) -> None:
    """Correct the track in row ``matches[d]`` by centroid d of (D, 3); -1 = none."""
    for d in range(len(matches)):
        row = matches[d]
        if row >= 0:
            p, variance = tracks.covariances[row], settings.position_noise**2
            correct(tracks.states[row], p, centroids[d, :2], variance)
            tracks.detections[row] += 1
