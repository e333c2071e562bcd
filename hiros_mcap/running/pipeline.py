"""A log in, a log out: read, track, merge, optimize, filter, write.

::

    summary = hiros_mcap.process("lab.mcap", "lab.hiros.mcap")
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from hiros_mcap._version import __version__
from hiros_mcap.body.limb_table import LimbTable
from hiros_mcap.config import Config, load_config, to_toml
from hiros_mcap.errors import ConfigError, LogError
from hiros_mcap.events import Events
from hiros_mcap.frames import Block, frames_of
from hiros_mcap.io.channels import OUTPUT_PREFIX, TF_TOPICS, TRUTH_PREFIX, add_skeleton_channel
from hiros_mcap.io.codec import Encoder
from hiros_mcap.io.container import ChunkCopier, McapWriter
from hiros_mcap.io.log import DAMAGED, Log, open_log
from hiros_mcap.outputs import check_outputs
from hiros_mcap.running.observe import DETECTIONS, Observer, Stopwatch
from hiros_mcap.skeletons import Floats, Frame
from hiros_mcap.stages.limb_calibration import calibrate_limbs
from hiros_mcap.summary import Summary
from hiros_mcap.systems import LETTERS, Run, Stages, chain_of, hiros, merging_order, system

if TYPE_CHECKING:
    from hiros_mcap.io.export.markers import MarkerExport

LIMBS_ATTACHMENT = "hiros/limbs.toml"
EVENTS_ATTACHMENT = "hiros/events.json"


class Progress(Protocol):
    """Is told how far a run is."""

    def update(self, done: int, total: int) -> None:
        """Say that ``done`` of ``total`` ns of the log are done."""


class Silent:
    """A progress that nobody watches."""

    def update(self, done: int, total: int) -> None:
        """Do nothing."""


class Watcher(Protocol):
    """Is shown every frame of a run while it goes on, such as a live view."""

    def begin(self, log: Log, chain: Sequence[str]) -> None:
        """Say what is being read, and which stages it goes through."""

    def frame(self, channel: str, frame: Frame) -> None:
        """Show a frame of "detections", in the fixed frame, or of a stage. Not to be changed."""

    def end(self, events: Events) -> None:
        """Say that the last frame was shown, and what happened on the way."""


@dataclass(frozen=True, slots=True)
class ProcessOptions:
    """What is read, run and written, besides the parameters of the stages."""

    system: str = "hiros"
    """A key of :data:`hiros_mcap.systems.SYSTEMS`."""
    stages: str = ""
    """One of the system's chains of T tracker, M merger, O optimizer, F filter; "" = all."""
    topics: tuple[str, ...] = ()
    """Globs of the detection channels; empty = every SkeletonGroup channel."""
    keep: tuple[str, ...] | None = None
    """Globs of the input channels to copy; None = those read, the transforms and a /truth."""
    extrinsics: Path | None = None
    """File with the cameras' poses, instead of the log's transforms."""
    limbs_in: Path | None = None
    """File with limb lengths of an earlier session."""
    limbs_out: Path | None = None
    """Where to save the limb lengths."""
    strict: bool = False
    """Refuse a log of which a message has to be skipped."""
    markers: bool = False
    """Also write the last stage as MarkerArray and JointState, and what happened as Log."""
    compression: str = "zstd"
    """Of the output: zstd, lz4 or "" for none."""


def process(
    source: str | os.PathLike[str],
    target: str | os.PathLike[str] | None = None,
    *,
    config: Config | None = None,
    options: ProcessOptions | None = None,
    progress: Progress | None = None,
    watcher: Watcher | None = None,
    force: bool = False,
) -> Summary:
    """Turn the detections of a log into clean skeletons.

    Parameters
    ----------
    source : MCAP log with SkeletonGroup channels and the cameras' transforms.
    target : output log; None runs without writing one.
    config : parameters of the stages. options : what is read, run and written.
    progress : is told how far the run is. watcher : is shown every frame on the way.
    force : replace files that hiros did not write.

    Raises
    ------
    LogError
        ``source`` is damaged, holds no skeletons or lacks a transform; ``target`` cannot be
        written, is ``source``, or exists and was not written by hiros.
    ConfigError
        a parameter or a side file is wrong.
    """
    options = options or ProcessOptions()
    config = config or load_config(system=options.system)
    chain = chain_of(options.system, options.stages)
    check_outputs(
        ((None if target is None else Path(target), "log"), (options.limbs_out, "limb table")),
        (source, options.extrinsics, options.limbs_in),
        force=force,
    )
    watch = Stopwatch()
    limbs = LimbTable.load(options.limbs_in) if options.limbs_in else LimbTable()
    log = open_log(
        source,
        topics=options.topics or None,
        extrinsics=options.extrinsics,
        fixed_frame=config.input.fixed_frame or None,
    )
    with log:
        _check_windows(log, config)
        run = Run(
            log.model,
            config,
            Events(),
            limbs,
            camera_positions(log),
            log.fixed_frame,
            options.system,
        )
        if _takes_two_passes(run, chain):
            limbs.people.update(_calibrate_first(log, run, chain).people)
        observer = Observer(log, run, chain, watch)
        observer.notes += _unmatched(log, options)
        show: Sink = _unseen
        if watcher is not None:
            watcher.begin(log, chain)
            show = _shown_to(watcher)
        if target is None:
            _consume(_blocks(log, run, chain, observer, show), log, progress)
        else:
            _write(log, run, chain, observer, Path(target), options, progress, show)
        if watcher is not None:
            watcher.end(run.events)
        _refuse_skipped(log, observer, options.strict)
        if options.limbs_out:
            limbs.save(options.limbs_out)
        return observer.summary(None if target is None else str(target))


def camera_positions(log: Log) -> dict[str, Floats]:
    """Source -> (3,) position of each camera in the fixed frame, m.

    A camera whose detections already are in the fixed frame has no known position.
    """
    positions: dict[str, Floats] = {}
    for camera in log.cameras:
        if len(camera.frames) == 1 and camera.frames[0] != log.fixed_frame:
            pose = log.transforms.lookup(camera.frames[0], log.fixed_frame, 0)
            positions.update(dict.fromkeys(camera.sources.values(), pose.translation))
    return positions


def _stages(run: Run, chain: Sequence[str]) -> Stages:
    table = system(run.system).stages(run)
    return {name: table[name] for name in chain}


Sink = Callable[[str, Block], None]


def _blocks(
    log: Log, run: Run, chain: Sequence[str], observer: Observer, sink: Sink
) -> Iterator[Block]:
    """Join the stages: each pulls from the one before; every output is observed and written."""

    def seen(channel: str, block: Block) -> None:
        observer.see(channel, block)
        sink(channel, block)

    timed = observer.watch.timed
    blocks = timed("read", log.blocks(), partial(seen, DETECTIONS))
    for name, stage in _stages(run, chain).items():
        blocks = timed(name, stage(blocks), partial(seen, name))
    yield from blocks
    observer.watch.charge("read", log.reader.cpu_s)


def _shown_to(watcher: Watcher) -> Sink:
    """Show a watcher the frames of blocks one by one."""

    def show(channel: str, block: Block) -> None:
        for frame in block.frames():
            watcher.frame(channel, frame)

    return show


def _unseen(channel: str, block: Block) -> None:
    """Show nobody anything."""


def _takes_two_passes(run: Run, chain: Sequence[str]) -> bool:
    """Whether limbs are measured on the whole log first; other systems measure on the way."""
    wanted = run.config.optimize.calibration == "two-pass"
    return wanted and _is_hiros(run) and "optimized" in chain and not run.limbs.people


def _is_hiros(run: Run) -> bool:
    return system(run.system).stages is hiros


def _calibrate_first(log: Log, run: Run, chain: Sequence[str]) -> LimbTable:
    """First of two passes: everything before the optimizer, to measure the limbs."""
    blind = replace(run, events=Events(), limbs=LimbTable())
    blocks = log.blocks()
    for stage in _stages(blind, chain[: chain.index("optimized")]).values():
        blocks = stage(blocks)
    return calibrate_limbs(frames_of(blocks), run.model, run.config.optimize, run.events)


def _consume(blocks: Iterator[Block], log: Log, progress: Progress | None) -> None:
    """Run to the end, telling how far it is."""
    progress = progress or Silent()
    start, end = log.span
    for block in blocks:
        progress.update(int(block.log_times[-1]) - start, end - start)
    progress.update(end - start, end - start)


def _write(
    log: Log,
    run: Run,
    chain: Sequence[str],
    observer: Observer,
    target: Path,
    options: ProcessOptions,
    progress: Progress | None,
    show: Sink,
) -> None:
    """Run and write; nothing appears at ``target`` unless everything went well."""
    encoder = Encoder(log.model)
    with McapWriter(target, inputs=[log.path], compression=options.compression) as writer:
        copier = ChunkCopier(log.reader, writer, _kept(log, options))
        channels = {name: add_skeleton_channel(writer, f"{OUTPUT_PREFIX}/{name}") for name in chain}

        by_stamp = run.config.output.log_time == "stamp"
        export = _marker_export(writer, log, run, by_stamp=by_stamp) if options.markers else None

        def sink(channel: str, block: Block) -> None:
            show(channel, block)
            if channel != DETECTIONS:
                copier.until(int(block.log_times[0]))
                times = block.stamps if by_stamp else block.log_times
                writer.write_into(
                    channels[channel], times.tolist(), partial(encoder.encode_into, block)
                )
            if export is not None and channel == chain[-1]:
                for frame in block.frames():
                    export.write(frame)

        _consume(_blocks(log, run, chain, observer, sink), log, progress)
        with observer.watch.timing("write"):
            copier.finish()
            _refuse_skipped(log, observer, options.strict)
            _add_provenance(writer, log, run, chain, observer)
            writer.commit()
        observer.watch.charge("write", writer.cpu_s)


def _marker_export(writer: McapWriter, log: Log, run: Run, *, by_stamp: bool) -> MarkerExport:
    from hiros_mcap.io.export.markers import MarkerExport

    return MarkerExport(writer, log.model, run.events, by_stamp=by_stamp)


def _kept(log: Log, options: ProcessOptions) -> list[int]:
    """Ids of the input channels that are copied."""
    if options.keep is None:
        read = {camera.channel.id for camera in log.cameras}
        # Transforms that a file replaced would contradict the result.
        transforms = () if options.extrinsics else TF_TOPICS
        return [
            i.id
            for i in log.channels
            if i.id in read or i.topic in transforms or i.topic.startswith(f"{TRUTH_PREFIX}/")
        ]
    outputs = {f"{OUTPUT_PREFIX}/{name}" for name in LETTERS.values()}
    return [
        info.id
        for info in log.channels
        if info.topic not in outputs and any(fnmatchcase(info.topic, g) for g in options.keep)
    ]


def _unmatched(log: Log, options: ProcessOptions) -> list[str]:
    """Return a note for each glob of ``keep`` that no channel of the log is called."""
    topics = [info.topic for info in log.channels]
    return [
        f"keep: the log has no channel {glob}"
        for glob in options.keep or ()
        if not any(fnmatchcase(topic, glob) for topic in topics)
    ]


def _check_windows(log: Log, config: Config) -> None:
    """Refuse to calibrate in a time that the log has not: nobody would be calibrated."""
    start, end = log.span
    seconds = (end - start) / 1e9
    for window in config.optimize.calibration_windows:
        if window[0] > 0 and window[0] >= seconds:
            raise ConfigError(
                f"{log.path}: ends after {seconds:.1f} s; the calibration window "
                f"{window[0]:g}:{window[1]:g} lies behind that"
            )


def _add_provenance(
    writer: McapWriter, log: Log, run: Run, chain: Sequence[str], observer: Observer
) -> None:
    """Say in the file how it came about; nothing that differs from run to run."""
    config = to_toml(run.config).encode()
    merges = _is_hiros(run) and LETTERS["M"] in chain
    merging = {"merging": ",".join(merging_order(run.config.merge))} if merges else {}
    writer.add_metadata(
        "hiros.provenance",
        {
            "version": __version__,
            "system": run.system,
            "stages": ",".join(chain),
            **merging,
            "fixed_frame": run.fixed_frame,
            "config_sha256": hashlib.sha256(config).hexdigest(),
            "input_messages": str(sum(log.reader.counts.values())),
        },
    )
    writer.add_attachment("hiros/config.toml", config, "application/toml")
    writer.add_attachment(LIMBS_ATTACHMENT, run.limbs.to_toml().encode(), "application/toml")
    writer.add_attachment(EVENTS_ATTACHMENT, run.events.to_json().encode(), "application/json")
    report = json.dumps(observer.summary(None).reproducible(), indent=1, sort_keys=True)
    writer.add_attachment("hiros/report.json", report.encode(), "application/json")


def _refuse_skipped(log: Log, observer: Observer, strict: bool) -> None:
    """With ``strict``, a message that was skipped is an error."""
    for camera in observer.cameras() if strict else ():
        for reason, n in camera.skipped.items():
            error = log.accounts[camera.topic].first_error
            detail = f" ({error})" if error and reason == DAMAGED else ""
            raise LogError(
                f"{n} messages skipped: {reason}{detail}", path=log.path, topic=camera.topic
            )
