"""The steps of all systems. A step is a folder: its page, its parameters, its compiled loops.

bank.py, delay.py and time_order.py are what several steps need: the state of people, frames that
wait, and messages in the order of their stamps.
"""
