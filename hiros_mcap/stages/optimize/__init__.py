"""The optimizer (Hi-ROS 2023, section 3.3): constant limb lengths.

optimize.py           the page
energy.py             the energy, eq 14 to 19, with its derivatives
optimizing.py         the solver's compiled loops; normal_equations.py
ceres.py              the solver of the paper, for comparison
limb_calibration.py   the lengths themselves, section 3.3.1
optimize_params.py    the parameters

May change: the energy and its weights. Must not: people whose lengths are not accepted; they
pass as they are.
"""
