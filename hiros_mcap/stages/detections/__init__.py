"""What is mended in a single detection before it is tracked.

plausible.py          markers that no body can have; limb_deviations.py is its compiled loop
sides.py              left and right (the page); facing_evidence.py, facing.py, body_axes.py,
                      exchanging.py
detection_params.py   the parameters
"""
