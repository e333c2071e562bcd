"""Logs in and out: the container, messages, transforms, bags and exports.

May change: what is read, and from where. Must not: guess a layout, or return data that failed a
check.
"""
