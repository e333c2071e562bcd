"""Turns a log of several cameras' 3D skeletons into one clean, smooth skeleton per person."""

import logging

from hiros_mcap._version import __version__

logging.getLogger(__name__).addHandler(logging.NullHandler())

__all__ = ["__version__"]
