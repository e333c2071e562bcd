"""Pictures of results: pages with plots, and the Rerun viewer. Heavy imports wait for their use.

::

    hiros_viewer.show(result)                 # people in the room, in a notebook
    hiros_viewer.plot(result, person=0)       # their joint angles
"""

from hiros_viewer.notebook import Picture, plot, show

__all__ = ["Picture", "plot", "show"]
