"""The parameters that a result holds."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping

from hiros_mcap.errors import LogError
from hiros_mcap.io.channels import CONFIG_ATTACHMENT
from hiros_mcap.io.container import McapReader


def stored_parameters(reader: McapReader) -> dict[str, str]:
    """Return ``section.parameter`` -> its value as JSON; nothing if the file holds none.

    Raises LogError if they are not TOML.
    """
    text = (reader.attachment(CONFIG_ATTACHMENT) or b"").decode(errors="replace")
    try:
        return values_of(text)
    except tomllib.TOMLDecodeError as error:
        raise LogError(f"has no TOML in {CONFIG_ATTACHMENT}: {error}", path=reader.path) from None


def values_of(text: str) -> dict[str, str]:
    """Read a configuration in TOML like :func:`stored_parameters`; raises TOMLDecodeError."""
    return {
        f"{section}.{name}": json.dumps(value)
        for section, values in tomllib.loads(text).items()
        if isinstance(values, Mapping)
        for name, value in values.items()
    }
