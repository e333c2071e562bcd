"""RGB cameras: the keypoints of their images as rays, and what follows from them in space.

May change: how people are matched and triangulated. Must not: read files or messages. Whatever
is found leaves as skeletons of one camera, so that no stage knows of images.
"""
