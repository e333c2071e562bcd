"""The tracker (Hi-ROS 2023, section 3.1): detections of all cameras become tracks with ids.

track.py            the page: predict, associate, correct, start, confirm, delete
tracking.py         its compiled loops
tracked_people.py   the tracks of a log
support.py          who counts as a person
identity.py         who is who: displaced.py, likeness.py, reidentify.py
coverage.py         where each camera looks
track_params.py     the parameters

May change: the cost, the gate, who counts as a person. Must not: the ids of a person once
given, and the order of messages.
"""
