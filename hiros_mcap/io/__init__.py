"""Logs in and out: the container, messages, transforms, bags and exports."""
