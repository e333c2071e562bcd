"""A run: from a log through a system to a log.

May change: the order before the first stage, and what is reported. Must not: compute poses of
people. That is the work of the stages.
"""
