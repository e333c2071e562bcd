"""``hiros warmup``: compile the kernels now rather than in the first run."""

from __future__ import annotations

import time

from hiros_cli.options import Quiet


def warmup(quiet: Quiet = False) -> None:
    """Compile the kernels for this machine (half a minute, once), so that the first run is fast."""
    import pkgutil
    from importlib import import_module

    from hiros_cli.kernels import prepare
    from hiros_mcap import kernels

    prepare(quiet=quiet)
    started = time.perf_counter()
    for module in pkgutil.iter_modules(kernels.__path__):
        import_module(f"{kernels.__name__}.{module.name}")
    if not quiet:
        print(f"kernels ready after {time.perf_counter() - started:.1f} s")
