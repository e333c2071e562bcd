"""``hiros warmup``: compile the kernels now rather than in the first run."""

from __future__ import annotations

import time

from hiros_cli.options import QUIET


def warmup(quiet: bool = QUIET) -> None:
    """Compile the kernels now, to make the first run fast."""
    from hiros_cli.compiling import prepare
    from hiros_mcap import kernels

    started = time.perf_counter()
    prepare(quiet=quiet, everything=True)
    kernels.load(list(kernels.sources()))
    if not quiet:
        print(f"kernels ready after {time.perf_counter() - started:.1f} s")
