"""README for a package index, which has neither our pages nor our pictures beside it."""

from __future__ import annotations

import re

_LINK = re.compile(r"(!?)(\[[^\]]*\]\()(?!https?:|mailto:|#)([^)\s]+)\)")


def absolute(text: str, source: str) -> str:
    """Return Markdown whose links and pictures lead into the repository at ``source``.

    They stay as they are while it has no address, "".
    """
    if not source:
        return text

    def led(hit: re.Match[str]) -> str:
        kind = "raw" if hit[1] else "blob"
        return f"{hit[1]}{hit[2]}{source}/{kind}/main/{hit[3]})"

    return _LINK.sub(led, text)
