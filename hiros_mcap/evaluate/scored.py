"""What of a log is scored: its results, or those of a run on its cameras."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from hiros_mcap.config import Config
from hiros_mcap.defaults import DEFAULT_SYSTEM
from hiros_mcap.errors import ConfigError
from hiros_mcap.evaluate.logs import fused_topics, has_cameras, has_outputs
from hiros_mcap.io.channels import TRUTH_PREFIX
from hiros_mcap.running.pipeline import ProcessOptions, process


def check_scorable(log: Path, truth: str | None, *, has_truth: bool) -> None:
    """Refuse a log that holds neither a result nor cameras, or nothing to judge its result by.

    Raises ConfigError.
    """
    if has_cameras(log):
        return
    if not has_truth:
        raise ConfigError(
            f"{log}: has no truth, and no cameras that could be left out; name a truth: "
            f"hiros eval {log} --truth FILE"
        )
    if truth is None and not has_outputs(log):
        raise ConfigError(
            f"{log}: holds a truth but no result; name the result: hiros eval RESULT --truth {log}"
        )


@contextmanager
def results_of(
    log: Path, config: Config, truth: str | None, system: str = DEFAULT_SYSTEM
) -> Iterator[tuple[Path, list[str]]]:
    """Yield where the results are, and globs of their channels: [] = all outputs.

    That is the log itself if it holds outputs, the truth in it if it holds no cameras either, else
    what a ``system`` makes of it, in a temporary folder.

    Raises LogError or ConfigError if the log cannot be processed.
    """
    if has_outputs(log):
        yield log, []
    elif not has_cameras(log):
        yield log, [f"{TRUTH_PREFIX}/*"]
    else:
        with tempfile.TemporaryDirectory() as folder:
            out = Path(folder) / "out.mcap"
            options = ProcessOptions(system, keep=(), topics=fused_topics(log, truth))
            process(log, out, config=config, options=options)
            yield out, []
