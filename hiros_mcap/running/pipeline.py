"""A log in, a log out: read, track, merge, optimize, filter, write.

::

    summary = hiros_mcap.process("lab.mcap", "lab.hiros.mcap")
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from hiros_mcap.body.limb_table import LimbTable
from hiros_mcap.body.transforms import read_clocks
from hiros_mcap.config import ClockParams, Config, load_config
from hiros_mcap.errors import ConfigError, LogError
from hiros_mcap.events import Events
from hiros_mcap.frames import Block, frames_of
from hiros_mcap.io.detectors.conversion import SkeletonChoice
from hiros_mcap.io.log import DAMAGED, Log, open_log
from hiros_mcap.io.rosbag2 import output_file, refuse_foreign_encodings
from hiros_mcap.outputs import check_outputs, target_kind
from hiros_mcap.running.clock_alignment import ClockAlignment
from hiros_mcap.running.observe import DETECTIONS, Observer
from hiros_mcap.running.pose_alignment import align_cameras
from hiros_mcap.running.pose_follower import PoseFollower
from hiros_mcap.running.process_options import (
    Calibration,
    ProcessOptions,
    Progress,
    Silent,
    Watcher,
)
from hiros_mcap.running.report import Report
from hiros_mcap.running.stopwatch import Stopwatch
from hiros_mcap.running.write import kept_channels, open_output, unmatched_globs
from hiros_mcap.skeletons import Floats
from hiros_mcap.stages.limb_calibration import calibrate_limbs
from hiros_mcap.summary import Summary
from hiros_mcap.systems import LETTERS, Run, Stages, chain_of, sections_of, system

if TYPE_CHECKING:
    from hiros_mcap.stages.fusion_noise import FusionNoise

__all__ = [
    "ProcessOptions",
    "Progress",
    "Silent",
    "Watcher",
    "camera_positions",
    "open_input",
    "process",
]

Sink = Callable[[str, Block], None]
"""Takes what went into the first stage, or came out of any, by channel."""


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
    target : output log; None runs without writing one. A folder, or a name that ends in "/", gets
        a ROS 2 bag.
    config : parameters of the stages. options : what is read, run and written.
    progress : follows how far the run is. watcher : sees every frame on the way.
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
    _check_limbs(options, chain)
    kind = "log" if target is None else target_kind(target)
    check_outputs(
        ((None if target is None else Path(target), kind), (options.limbs_out, "limb table")),
        (source, options.extrinsics, options.limbs_in),
        force=force,
    )
    watch = Stopwatch()
    with open_input(source, config, options) as log, output_file(target) as path:
        if kind == "rosbag2 folder":
            kept = kept_channels(log, options)
            refuse_foreign_encodings((i for i in log.channels if i.id in kept), Path(path or ""))
        config = with_clocks(config, log, options.extrinsics)
        mode = _calibration(config, options)
        with watch.timing("calibrate"):
            clocks, poses = align_cameras(log, config, mode, _reorder_of(config, options.system))
        run = replace(set_up(log, config, options), to_given=poses.to_given)
        _calibrate_first(log, run, chain, clocks)
        observer = Observer(chain)
        report = Report(log, run, observer, watch, clocks, poses, unmatched_globs(log, options))
        with open_output(path, log, run, chain, options, moved=poses.replaced) as output:
            sinks = [observer.see, *shown_to(watcher, log, chain), output.write]
            detections = clocks.correct(log.blocks())
            if follows_poses(config, options):
                detections = PoseFollower(log, poses).correct(detections)
            blocks = stream(detections, run, chain, watch, sinks)
            _consume(blocks, log, progress or Silent())
            watch.charge("read", log.reader.cpu_s)
            clocks.tell(run.events)
            poses.tell(run.events)
            if options.strict:
                _refuse_skipped(log, report.summary(None))
            with watch.timing("write"):
                output.commit(report.summary(None))
            watch.charge("write", output.cpu_s)
        if watcher is not None:
            watcher.end(run.events)
        if options.limbs_out:
            run.limbs.save(options.limbs_out)
        return report.summary(None if target is None else str(target))


def _check_limbs(options: ProcessOptions, chain: Sequence[str]) -> None:
    """Raise ConfigError if limb lengths are given or wanted that no stage uses."""
    table = options.limbs_in or options.limbs_out
    if table and LETTERS["O"] not in chain:
        raise ConfigError(
            f"{table}: nothing uses or finds limb lengths: system {options.system} with the stages "
            f"{', '.join(chain)} has no optimizer"
        )


def camera_positions(log: Log) -> dict[str, Floats]:
    """Source -> (3,) position of each camera in the fixed frame, m.

    A camera whose detections already are in the fixed frame has no known position.
    """
    poses = [(camera, log.pose_of(camera)) for camera in log.cameras]
    return {
        name: pose.translation
        for camera, pose in poses
        for name in camera.sources.values()
        if pose is not None
    }


def open_input(source: str | os.PathLike[str], config: Config, options: ProcessOptions) -> Log:
    """Open a log as a run with these options reads it; see :func:`hiros_mcap.io.log.open_log`."""
    return open_log(
        source,
        topics=options.topics or None,
        extrinsics=options.extrinsics,
        fixed_frame=config.input.fixed_frame or None,
        recover=options.recover,
        memory=int(options.memory * 2**30),
        skeletons=SkeletonChoice(config.input.model, config.input.unit),
    )


def with_clocks(config: Config, log: Log, extrinsics: Path | None) -> Config:
    """Add the clocks of a file with poses to the configuration, whose own come first."""
    if extrinsics is None:
        return config
    names = {name for camera in log.cameras for name in camera.sources.values()}
    found = {name: s for name, s in read_clocks(extrinsics).items() if name in names}
    clock = ClockParams.model_validate({**found, **config.clock.seconds})
    return config.model_copy(update={"clock": clock})


def _calibration(config: Config, options: ProcessOptions) -> Calibration:
    """Return how the poses are refined before a run: a causal or published one does not wait."""
    given = config.input.poses == "given"
    if config.input.clocks != "causal" and not given:
        return options.calibrate
    if options.calibrate == "require":
        raise ConfigError(
            "--calibrate require contradicts input.poses=given, which the presets paper and "
            "upstream set"
            if given
            else "--calibrate require needs the whole log at once, and a causal run refines poses "
            "as it goes on; find them with hiros calibrate people and pass them with --extrinsics"
        )
    return "off"


def follows_poses(config: Config, options: ProcessOptions) -> bool:
    """Whether a run refines the poses as it goes on, by what was seen before."""
    causal = config.input.clocks == "causal" and config.input.poses != "given"
    return causal and options.calibrate != "off"


def set_up(log: Log, config: Config, options: ProcessOptions) -> Run:
    """Return what the stages share.

    Raises ConfigError for a calibration window that starts after the end of the log.
    """
    start, end = log.span
    seconds = (end - start) / 1e9
    for first, last in config.optimize.calibration_windows:
        if 0 < first >= seconds:
            raise ConfigError(
                f"{log.path}: ends after {seconds:.1f} s, before the calibration window "
                f"{first:g}:{last:g} starts"
            )
    limbs = LimbTable.load(options.limbs_in) if options.limbs_in else LimbTable()
    cameras = camera_positions(log)
    noise = _given_noise(log, config, options)
    return Run(log.model, config, Events(), limbs, cameras, log.fixed_frame, options.system, noise)


def _given_noise(log: Log, config: Config, options: ProcessOptions) -> FusionNoise | None:
    """Return the measured noise of the detectors, if the configuration has some and it is used.

    Raises ConfigError for a joint that the log's skeleton does not have.
    """
    if "fuse" not in sections_of(options.system) or not config.noise.model_extra:
        return None
    from hiros_mcap.stages.fusion_noise import FusionNoise

    fuse, noise = config.fuse, config.noise
    usual = FusionNoise.default(log.model, fuse.acceleration, fuse.offset, fuse.offset_time)
    tables = noise.table("joints"), noise.table("cameras")
    return usual.measured(log.model, noise.numbers, *tables)


def _reorder_of(config: Config, name: str) -> float:
    """Return the longest time, s, by which a system's first stage takes messages that are late."""
    first = config.track if "track" in sections_of(name) else config.associate
    return first.reorder


def _stages(run: Run, chain: Sequence[str]) -> Stages:
    table = system(run.system).stages(run)
    return {name: table[name] for name in chain}


def _calibrate_first(log: Log, run: Run, chain: Sequence[str], clocks: ClockAlignment) -> None:
    """Measure the limbs on the whole log before the run, if it is to have two passes."""
    wanted = "optimize" in sections_of(run.system) and "optimized" in chain
    if not wanted or run.config.optimize.calibration != "two-pass" or run.limbs.people:
        return
    first_pass = replace(run, events=Events(), limbs=LimbTable())
    blocks = clocks.correct(log.blocks())
    for stage in _stages(first_pass, chain[: chain.index("optimized")]).values():
        blocks = stage(blocks)
    table = calibrate_limbs(frames_of(blocks), run.model, run.config.optimize, run.events)
    run.limbs.people.update(table.people)


def stream(
    detections: Iterator[Block],
    run: Run,
    chain: Sequence[str],
    watch: Stopwatch,
    sinks: Sequence[Sink],
) -> Iterator[Block]:
    """Join the stages: each pulls from the one before it, and the sinks see every block."""

    def see(channel: str, block: Block) -> None:
        for sink in sinks:
            sink(channel, block)

    blocks = watch.timed("read", detections, partial(see, DETECTIONS))
    for name, stage in _stages(run, chain).items():
        blocks = watch.timed(name, stage(blocks), partial(see, name))
    yield from blocks


def shown_to(watcher: Watcher | None, log: Log, chain: Sequence[str]) -> Iterator[Sink]:
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
    start, end = log.span
    for block in blocks:
        progress.update(int(block.log_times[-1]) - start, end - start)
    progress.update(end - start, end - start)


def _refuse_skipped(log: Log, summary: Summary) -> None:
    """Raise LogError if any message was skipped."""
    for camera in summary.cameras:
        for reason, n in camera.skipped.items():
            error = log.accounts[camera.topic].first_error
            detail = f" ({error})" if error and reason == DAMAGED else ""
            raise LogError(
                f"{n} messages skipped: {reason}{detail}", path=log.path, topic=camera.topic
            )
