"""A log in, a log out: read, track, merge, optimize, filter, write.

::

    summary = hiros_mcap.process("lab.mcap", "lab.hiros.mcap")

A run is a list: what is known of the cameras (:mod:`hiros_mcap.running.preparation`), the stages,
and the sinks, which see every block that goes into the first stage or comes out of any. A file and
live input (:mod:`hiros_mcap.running.process_live`) differ in their output alone; a run in memory
(:mod:`hiros_mcap.running.recording`) has no output.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from functools import partial
from inspect import Parameter, Signature, signature
from pathlib import Path
from typing import Any, Unpack

from hiros_mcap.config import Config, load_config, settings_beside
from hiros_mcap.errors import ConfigError, LogError
from hiros_mcap.frames import Block
from hiros_mcap.io.detectors.conversion import Selection
from hiros_mcap.io.detectors.rgb_keypoints import RgbRig
from hiros_mcap.io.log import DAMAGED, Log, Reading, Source, open_log
from hiros_mcap.outputs import check_outputs
from hiros_mcap.progress import Bar, Progress, bar
from hiros_mcap.running.observe import DETECTIONS, Observer, Stopwatch
from hiros_mcap.running.preparation import (
    Prepared,
    poses_are_refined,
    prepare,
    set_up,
    stages_of,
)
from hiros_mcap.running.process_options import (
    ProcessChoices,
    ProcessOptions,
    Watcher,
)
from hiros_mcap.running.report import Report
from hiros_mcap.running.summary import Summary
from hiros_mcap.running.write import (
    LogOutput,
    open_output,
)
from hiros_mcap.systems import LETTERS, Run, chain_of
from hiros_mcap.wording import instead

__all__ = ["ProcessOptions", "Watcher", "open_input", "process"]

_log = logging.getLogger(__name__)
Sink = Callable[[str, Block], None]
"""Takes what went into the first stage, or came out of any, by channel."""
Output = Callable[[Prepared, Run], AbstractContextManager[Sequence[LogOutput]]]
"""Opens what a run writes, to several places or to none."""


def process(
    source: str | os.PathLike[str],
    target: str | os.PathLike[str] | None = None,
    *,
    config: Config | str | os.PathLike[str] | None = None,
    options: ProcessOptions | None = None,
    progress: Progress | bool = False,
    watcher: Watcher | None = None,
    force: bool = False,
    **choices: Unpack[ProcessChoices],
) -> Summary:
    """Turn the detections of a log into clean skeletons.

    Parameters
    ----------
    source : MCAP log with SkeletonGroup channels and the cameras' transforms.
    target : output log; None runs without writing one.
    config : parameters of the stages, or a TOML file with them. None takes them from a file
        hiros.toml in the log's folder, or in the nearest one above, if there is one.
    options : what is read, run and written.
    progress : follows how far the run is; True shows a bar on a terminal or in a notebook.
    watcher : sees every frame on the way.
    force : replace files that hiros did not write.
    choices : fields of :class:`ProcessOptions`, in place of those of ``options``:
        ``process("lab.mcap", "clean.mcap", system="hiros", calibrate="off")``.

    The logger ``hiros_mcap`` gets the warnings of the summary, the steps of the run (INFO), and
    its notes and events (DEBUG).

    Raises
    ------
    TypeError
        ``choices`` names no field.
    LogError
        ``source`` is damaged, holds no skeletons or lacks a transform; ``target`` cannot be
        written, is ``source``, or exists and was not written by hiros.
    ConfigError
        an argument, a parameter or a side file is wrong.
    """
    if not isinstance(config, Config | str | os.PathLike | None):
        raise ConfigError(f"config: {config!r} is neither a Config nor the name of a file")
    if not isinstance(progress, bool | None) and not hasattr(progress, "update"):
        raise ConfigError(f"progress: {progress!r} is no bool and has no method update()")
    chosen: dict[str, Any] = dict(choices)
    names = signature(ProcessOptions).parameters
    for name in chosen.keys() - names.keys():
        raise TypeError(f"process() has no argument {name!r}{instead(name, names)}")
    options = replace(options or ProcessOptions(), **chosen)
    if not isinstance(config, Config):
        file = settings_beside(source) if config is None else Path(config)
        options = replace(options, settings=file)
        config = load_config(file, system=options.system)
    check_limbs(options)
    path = None if target is None else Path(target)
    check_outputs(
        ((path, "log"), (options.limbs_out, "limb table")),
        (source, options.settings, options.extrinsics, options.limbs_in),
        force=force,
    )
    watch = Stopwatch()
    with watch.timing("open"):  # other detectors' messages are converted there
        opened = open_input(source, config, options)
    with opened as log:
        prepared = prepare(log, config, options, watch)
        with _following(progress) as follower:
            report = run_log(prepared, partial(open_output, path), watcher, follower)
        return conclude(report, None if target is None else str(target))


def conclude(report: Report, target: str | None) -> Summary:
    """Return the summary of a run that has ended, and log what a user should know."""
    summary = report.summary(target)
    for texts, level in ((summary.warnings, logging.WARNING), (summary.notes, logging.DEBUG)):
        for text in texts:
            _log.log(level, "%s: %s", summary.source, text)
    for event in sorted(report.run.events.log, key=lambda event: event.stamp):
        seconds = (event.stamp - report.log.span[0]) * 1e-9
        _log.debug("%s: %.3f s: %s", summary.source, seconds, event.text)
    if target is not None:
        _log.info("%s: wrote %s", summary.source, target)
    return summary


def _keywords_of(function: Callable[..., Any]) -> Signature:
    """Return the signature with the fields of ProcessOptions, for help() and completion."""
    written, names = signature(function), signature(ProcessOptions).parameters.values()
    kept = [p for p in written.parameters.values() if p.kind is not Parameter.VAR_KEYWORD]
    return written.replace(
        parameters=[*kept, *(p.replace(kind=Parameter.KEYWORD_ONLY) for p in names)]
    )


process.__signature__ = _keywords_of(process)  # type: ignore[attr-defined]


@contextmanager
def _following(progress: Progress | bool) -> Iterator[Progress | None]:
    """Yield what follows the run: nothing, what was given, or a bar."""
    if isinstance(progress, bool):
        with bar("process", quiet=not progress, notebook=True) as shown:
            yield shown
    else:
        yield progress


def open_input(
    source: Source, config: Config, options: ProcessOptions, rig: RgbRig | None = None
) -> Log:
    """Open a log as a run with these options reads it; see :func:`hiros_mcap.io.log.open_log`.

    ``rig`` : how the RGB cameras stand; None = it is found out.
    """
    return open_log(
        source,
        topics=options.topics or None,
        extrinsics=options.extrinsics,
        fixed_frame=config.input.fixed_frame or None,
        recover=options.recover,
        memory=int(options.memory * 2**30),
        skeletons=skeletons_read(config)._replace(
            rig=rig, refine=poses_are_refined(config, options)
        ),
    )


def skeletons_read(config: Config) -> Selection:
    """Return which skeleton a log is read as, in which unit, and with which axes."""
    return Selection(config.input.model, config.input.unit, config.input.negate)


def check_limbs(options: ProcessOptions) -> None:
    """Raise ConfigError if limb lengths are given or wanted that no stage uses."""
    table = options.limbs_in or options.limbs_out
    chain = chain_of(options.system, options.stages)
    if table and LETTERS["O"] not in chain:
        raise ConfigError(
            f"{table}: nothing uses or finds limb lengths: system {options.system} with the stages "
            f"{', '.join(chain)} has no optimizer"
        )


def run_log(
    prepared: Prepared, output: Output, watcher: Watcher | None, progress: Progress | None = None
) -> Report:
    """Run the stages over a log that is prepared, write what comes out, and report."""
    log, options, watch = prepared.log, prepared.options, prepared.watch
    cameras = ", ".join(name for camera in log.cameras for name in camera.sources.values())
    _log.info("%s: %s; fixed frame %s", log.path, cameras, log.fixed_frame)
    for pose in prepared.poses.cameras:
        _log.info("%s: pose of %s: %s", log.path, pose.name, pose.verdict)
    run, chain = set_up(prepared), chain_of(options.system, options.stages)
    if watcher is not None:
        run = replace(run, derivatives=None)  # it sees them in every channel
    _log.info("%s: system %s: %s", log.path, options.system, ", ".join(chain))
    observer = Observer(chain, lambda: log.reader.prompt)
    reading = log.read(slim=True)
    report = Report(prepared, run, observer, reading)
    with output(prepared, run) as outputs:
        written = [out.write for out in outputs]
        sinks = [observer.see, *_shown_to(watcher, log, chain), *written]
        detections = prepared.detections(reading)
        _consume(stream(detections, run, chain, sinks, watch), log, progress or Bar())
        watch.charge("read", log.reader.cpu_s)
        prepared.clocks.note_events(run.events)
        prepared.poses.note_events(run.events)
        if options.strict:
            _refuse_skipped(reading, report.summary(None))
        with watch.timing("write"):
            for out in outputs:
                out.commit(report.summary(None))
        watch.charge("write", sum(out.cpu_s for out in outputs))
    if watcher is not None:
        watcher.end(run.events)
    if options.limbs_out:
        run.limbs.save(options.limbs_out)
    return report


def stream(
    detections: Iterable[Block],
    run: Run,
    chain: Sequence[str],
    sinks: Sequence[Sink],
    watch: Stopwatch,
) -> Iterator[Block]:
    """Join the stages: each pulls from the one before it, and the sinks see every block.

    A person of whom a stage knows no marker goes on to the next stage, but is no result.
    """

    def see(channel: str, block: Block) -> None:
        for sink in sinks:
            sink(channel, block)

    def publish(channel: str, block: Block) -> None:
        see(channel, block.without_empty())

    blocks = watch.timed("read", detections, partial(see, DETECTIONS))
    for name, stage in stages_of(run, chain).items():
        shown = see if name == LETTERS["T"] else publish  # each detection is tracked, or not
        blocks = watch.timed(name, stage(blocks), partial(shown, name))
    yield from blocks


def _shown_to(watcher: Watcher | None, log: Log, chain: Sequence[str]) -> Iterator[Sink]:
    """Yield the sink of a watcher, if there is one; it gets the frames one by one."""
    if watcher is None:
        return
    watcher.begin(log, chain)

    def show(channel: str, block: Block) -> None:
        for frame in block.frames():
            watcher.frame(channel, frame)

    yield show


def _consume(blocks: Iterator[Block], log: Log, progress: Progress) -> None:
    """Pull everything through the stages."""
    for block in blocks:
        start, end = log.span
        progress.update(int(block.log_times[-1]) - start, end - start)
    start, end = log.span
    progress.update(end - start, end - start)


def _refuse_skipped(reading: Reading, summary: Summary) -> None:
    """Raise LogError if any message was skipped."""
    for camera in summary.cameras:
        for reason, n in camera.skipped.items():
            error = reading.accounts[camera.topic].first_error
            detail = f" ({error})" if error and reason == DAMAGED else ""
            fault = f"{n} messages skipped: {reason}{detail}"
            raise LogError(fault, path=reading.log.path, topic=camera.topic)
