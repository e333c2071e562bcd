"""The steps of all systems. A step is a folder: its page, its parameters, its compiled loops.

bank.py, look_ahead.py and time_order.py are what several steps need: the state of people, frames
that wait for those after them, and messages in the order of their stamps. delay.py holds single
messages back, for the tracker.
"""
