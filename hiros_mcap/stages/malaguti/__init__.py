"""Malaguti et al. (2019): associate centroids, filter joints, straighten limbs.

associate.py         people by their centroids
kalman.py            joints
straighten.py        constant lengths
moving_average.py    the average that the paper compares with
malaguti_params.py   the parameters
"""
