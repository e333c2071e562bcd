"""Pictures of results: pages with plots, and the Rerun viewer. Heavy imports wait for their use.

::

    hiros_viewer.show(result)                 # people in the room, in a notebook
    hiros_viewer.plot(result, person=0)       # their joint angles
"""

import os

# Rerun would print lines of its own for a full disk, and one per message that a viewer which was
# closed does not take. It looks here when it is imported.
os.environ.setdefault("RUST_LOG", "off")

from hiros_viewer.notebook import Picture, plot, show

__all__ = ["Picture", "plot", "show"]
