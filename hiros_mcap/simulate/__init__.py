"""Synthetic logs with known truth: people, cameras and all their faults.

    simulation = simulate(SimulateParams(people=2, action="cross", seconds=5))
    for frame in simulation.detections: ...  # what each depth camera reports
    for frame in simulation.keypoints: ...  # what each RGB camera finds in its image
    for frame in simulation.truth: ...

Bodies with constant limb lengths (:mod:`body`) perform the actions of the Hi-ROS evaluation
(:mod:`actions`); cameras with clocks of their own (:mod:`cameras`) see them as far as nothing is in
the way (:mod:`occlusion`), and a body tracker errs about them, by joints (:mod:`detector`), by
whole limbs (:mod:`limb_errors`), or in an image (:mod:`image_detector`). Every fault is a
parameter (:class:`SimulateParams`), and the same seed gives the same bytes.
"""

from hiros_mcap.simulate.settings import DetectorParams, ImageParams, RigParams, SimulateParams
from hiros_mcap.simulate.simulation import Simulation, simulate

__all__ = ["DetectorParams", "ImageParams", "RigParams", "SimulateParams", "Simulation", "simulate"]
