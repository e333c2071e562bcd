"""Lee et al. (2022): cluster the views of each joint, then predict.

cluster.py      the page; clustering.py holds its compiled loops
predict.py      the filter; predicting.py
lee_params.py   the parameters
"""
