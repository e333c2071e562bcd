"""What of a log is scored: its results, or those of a run on its cameras, in memory."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from dataclasses import replace
from fnmatch import fnmatchcase

from hiros_mcap.config import Config, load_config
from hiros_mcap.defaults import DEFAULT_SYSTEM
from hiros_mcap.errors import ConfigError, LogError
from hiros_mcap.evaluate.logs import Channel, fused_topics, has_cameras, has_outputs, read_results
from hiros_mcap.io.channels import CONFIG_ATTACHMENT, OUTPUT_PREFIX, PROVENANCE, TRUTH_PREFIX
from hiros_mcap.io.log import Source, reading
from hiros_mcap.io.marker_uncertainty import UNCERTAIN_TOPIC, deviations_of
from hiros_mcap.running.process_options import ProcessOptions
from hiros_mcap.running.recording import Recording
from hiros_mcap.systems import SYSTEMS


def check_scorable(log: Source, truth: str | None, *, has_truth: bool) -> None:
    """Refuse a log that holds neither a result nor cameras, or nothing to judge its result by.

    Raises ConfigError.
    """
    with reading(log) as reader:
        if has_cameras(reader):
            return
        path = reader.path
        if not has_truth:
            raise ConfigError(
                f"{path}: has no truth, and no cameras that could be left out; name a truth: "
                f"hiros eval {path} --truth FILE"
            )
        if truth is None and not has_outputs(reader):
            raise ConfigError(
                f"{path}: holds a truth but no result; name the result: "
                f"hiros eval RESULT --truth {path}"
            )


def results_of(
    log: Source,
    config: Config,
    truth: str | None = None,
    globs: Sequence[str] = (),
    system: str = DEFAULT_SYSTEM,
) -> dict[str, Channel]:
    """Return the channels that are scored, all outputs or those that globs name.

    They are in the log itself if it holds outputs, the truth in it if it holds no cameras either,
    else what a ``system`` makes of it.

    Raises LogError or ConfigError if the log cannot be processed.
    """
    with reading(log) as reader:
        if has_outputs(reader):
            return read_results(reader, globs)
        if not has_cameras(reader):
            return read_results(reader, globs or [f"{TRUTH_PREFIX}/*"])
        options = ProcessOptions(system, topics=fused_topics(reader, truth))
        recording = Recording.read(reader, config, options)
    results = recording.run(config, options)
    topics = {f"{OUTPUT_PREFIX}/{name}": name for name in results}
    if globs:
        topics = {t: n for t, n in topics.items() if any(fnmatchcase(t, g) for g in globs)}
    if not topics:
        named = ", ".join(globs)
        raise LogError(f"no channel of a run of {system} matches {named}", path=reader.path)
    channels = {
        topic: Channel(recording.prepared.log.path, results[name], recording.model)
        for topic, name in topics.items()
    }
    if UNCERTAIN_TOPIC in channels:
        last = channels[UNCERTAIN_TOPIC]
        stated = deviations_of(last.frames, last.model)
        channels[UNCERTAIN_TOPIC] = replace(last, deviations=stated)
    return channels


def settings_of(
    log: Source, config: Config, system: str, *, asked: bool
) -> tuple[Config, ProcessOptions]:
    """Return with what a log is run anew: a result with the settings that made it.

    ``config`` and ``system`` count for a recording, and if the user ``asked`` for them.

    Raises LogError or ConfigError if the settings in a result cannot be used.
    """
    with reading(log) as reader:
        facts = dict(reader.contents.metadata).get(PROVENANCE, {})
        name = facts.get("system", "")
        if asked or name not in SYSTEMS:
            return config, ProcessOptions(system)
        text = (reader.attachment(CONFIG_ATTACHMENT) or b"").decode(errors="replace")
        try:
            table = tomllib.loads(text)
        except tomllib.TOMLDecodeError as error:
            fault = f"has no TOML in {CONFIG_ATTACHMENT}: {error}"
            raise LogError(fault, path=reader.path) from None
        return load_config(system=name, named={str(reader.path): table}), ProcessOptions(name)
