"""Lee et al. (2022): cluster the views of each joint, then predict.

cluster.py      the page; clustering.py holds its compiled loops
predict.py      the filter
lee_params.py   the parameters
"""
