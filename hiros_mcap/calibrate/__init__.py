"""The poses and the noise of a log's cameras.

May change: how poses, clocks and noise are estimated. Must not: correct anything. ``running``
decides what is used.
"""
