"""The merger (Hi-ROS 2023, section 3.2): the views of a person become one skeleton.

merge.py          the page
merging.py        its compiled loops
instants.py       which views belong to one instant
unseen.py         people whom no camera sees for a moment
merge_params.py   the parameters

May change: how views are weighed. Must not: who is who, which the tracker decided.
"""
