"""Mends single detections before views are merged.

visibility.py         which joints a camera sees, by its detector and by who stands in front
plausible.py          markers that contradict the person's limb lengths
hidden.py             joints that a camera cannot see; hidden_joints.py, impossible_postures.py
sides.py              left and right (the page); facing_evidence.py, facing.py,
                      facing_live.py, body_axes.py
detection_params.py   the parameters

May change: what is doubted of a view. Must not: ids, stamps and frames. Doubts are columns of the
table of views (frames.py); no view is taken out here.
"""
