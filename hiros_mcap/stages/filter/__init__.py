"""The filter (Hi-ROS 2023, section 3.4): smooth motion, velocities, accelerations.

filter.py          the page
filtering.py       what all filters share, compiled
butterworth.py     the paper's filter
state_space.py     the causal and the smoothing Kalman filter
link_lengths.py    lengths that stay as they are
filter_params.py   the parameters

May change: the method and its noise. Must not: stamps, ids, and gaps, which stay gaps.
"""
