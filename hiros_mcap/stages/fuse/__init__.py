"""Our own system: one estimate from all views of a person in a window of time.

fuse.py              the page
gathering.py         views by instants, and what their orientations come to
window_smoother.py   the estimate; fusing.py is its compiled loop
majority.py          which cameras are outvoted about a joint; outliers.py, over time
pose_error.py        how well each camera's pose is known
fusion_noise.py      how well each camera sees; residuals.py
displaced_views.py   views of a camera that is not where its pose says
constrain.py         constant lengths afterwards; pair_lengths.py, pose_prior.py
fuse_params.py       the parameters

May change: the noise, the windows, what is doubted. Must not: ids; and results may not depend
on how frames are cut into blocks.
"""
