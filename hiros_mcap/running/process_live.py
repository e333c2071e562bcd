"""Detections in from a pipe, clean skeletons out to another, message by message.

::

    with open("out.mcap", "wb") as out:
        process_live(McapInput(0, "standard input"), out.fileno(), options=...)
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from functools import cache, partial
from pathlib import Path

import hiros_schemas
from hiros_mcap.config import Config, load_config
from hiros_mcap.defaults import LIVE_SYSTEM
from hiros_mcap.errors import ConfigError
from hiros_mcap.io.channels import (
    HUMANS,
    ChannelInfo,
    info_of,
    is_transform_topic,
    kept_for_late,
    needs_latching,
)
from hiros_mcap.io.container import McapWriter, Message
from hiros_mcap.io.container.file import Pipe, Sink
from hiros_mcap.io.container.live_input import LiveInput
from hiros_mcap.io.container.live_output import MessageSink
from hiros_mcap.io.container.writer import LiveWriter
from hiros_mcap.io.detectors.rgb_keypoints import RGB_TOPIC
from hiros_mcap.io.export.run_summary import SummaryExport
from hiros_mcap.io.live_log import LiveLog, may_be_read, open_live
from hiros_mcap.progress import Progress
from hiros_mcap.running.observe import Stopwatch
from hiros_mcap.running.pipeline import check_limbs, conclude, run_log
from hiros_mcap.running.preparation import Prepared, prepare
from hiros_mcap.running.process_options import ProcessOptions, Watcher
from hiros_mcap.running.summary import Summary
from hiros_mcap.running.write import LogOutput, is_kept, is_of_rgb
from hiros_mcap.systems import Run

Target = int | Path | Sink


def process_live(
    source: LiveInput,
    target: Target | Sequence[Target] | None,
    *,
    config: Config | None = None,
    options: ProcessOptions | None = None,
    watcher: Watcher | None = None,
    started: Callable[[LiveLog], None] | None = None,
    progress: Progress | None = None,
) -> Summary:
    """Turn detections into clean skeletons as they come.

    The input is copied to the output as in a run of a file. Each message goes out as soon as the
    stages give it; how long they wait for later ones is up to the system. The input is
    closed afterwards.

    Parameters
    ----------
    source : the input.
    target : descriptor of a pipe; a file, which appears when the input ends; a
        :class:`~hiros_mcap.io.foxglove_server.FoxgloveServer` or a
        :class:`~hiros_mcap.io.ros_output.RosOutput`; several of these; None for no output.
    config, options, watcher, progress : as of :func:`hiros_mcap.running.pipeline.process`; the
        default system is ``fuse-realtime``. Clocks are corrected as the messages come.
    started : is called with the log when the first messages are read.

    Raises
    ------
    LogError
        see :func:`hiros_mcap.io.live_log.open_live`; also where the input is damaged. What was
        sent to a pipe before stays sent.
    ConfigError
        a parameter is wrong, or needs the whole log at once.
    BrokenPipeError
        the reader of the output is gone.
    """
    options = options or ProcessOptions(system=LIVE_SYSTEM)
    with closing(source):
        config = _causal(config or load_config(system=options.system), options)
        check_limbs(options)
        watch = Stopwatch()
        log = open_live(
            source,
            topics=options.topics or None,
            extrinsics=options.extrinsics,
            fixed_frame=config.input.fixed_frame or None,
            rays=() if isinstance(config.input.rays, str) else config.input.rays,
        )
        if started is not None:
            started(log)
        prepared = prepare(log, config, options, watch)
        single = [] if target is None or isinstance(target, Sequence) else [target]
        targets: Sequence[Target] = target if isinstance(target, Sequence) else single
        report = run_log(prepared, partial(_open_outputs, targets, source, log), watcher, progress)
        files = [str(path) for path in targets if isinstance(path, Path)]
        return conclude(report, files[0] if files else None)


def subscription(options: ProcessOptions) -> Callable[[str, str], bool]:
    """Return what tells from topic and type whether a run reads or copies a channel."""

    def wanted(topic: str, kind: str) -> bool:
        info = ChannelInfo(0, topic, kind, "cdr", 1, {})
        reads = may_be_read(info, options.topics or None)
        # With given poses, transforms may still show humans.
        needed = is_transform_topic(topic) or kind.startswith(HUMANS)
        needed |= info.has_type(hiros_schemas.CAMERA_INFO)
        return reads or needed or is_kept(info, options, is_read=False)

    return wanted


def necessity(options: ProcessOptions) -> Callable[[str, str], bool]:
    """Return what tells from topic and type whether a run cannot do without a channel."""

    def needed(topic: str, kind: str) -> bool:
        info = ChannelInfo(0, topic, kind, "cdr", 1, {})
        is_pose = is_transform_topic(topic) and options.extrinsics is None
        return is_pose or may_be_read(info, options.topics or None)

    return needed


def _causal(config: Config, options: ProcessOptions) -> Config:
    """Return the configuration with clocks that are corrected by what came before."""
    if config.optimize.calibration == "two-pass":
        raise ConfigError(
            "optimize.calibration=two-pass reads the whole log first, which live input does not "
            "allow"
        )
    if options.recover or options.strict:
        raise ConfigError("--recover and --strict are for files; live input is read as it comes")
    if config.input.model or config.input.unit != "m" or config.input.negate:
        raise ConfigError(
            "--model, --unit and --negate are for files; live input is read as it is, in metres"
        )
    if config.input.clocks == "off":
        return config
    return config.model_copy(update={"input": config.input.model_copy(update={"clocks": "causal"})})


@contextmanager
def _open_outputs(
    targets: Sequence[Target], source: LiveInput, log: LiveLog, prepared: Prepared, run: Run
) -> Iterator[Sequence[LogOutput]]:
    """Yield the outputs; pipes and servers get what is written before the input is waited for."""
    compression = prepared.options.compression
    with ExitStack() as stack:
        # What somebody waits for goes first.
        outputs: list[LogOutput] = []
        live: list[LiveWriter] = []
        for target in sorted(targets, key=lambda where: isinstance(where, Path)):
            stream = Pipe(target, "standard output") if isinstance(target, int) else target
            writer = (
                LiveWriter(stream)
                if isinstance(stream, Sink)
                else McapWriter(stream, compression=compression)
            )
            stack.enter_context(writer)
            if isinstance(writer, LiveWriter):
                live.append(writer)
            results_only = isinstance(stream, MessageSink) and stream.results_only
            if not results_only:
                _copy_as_read(log, writer, prepared.options)
            output = LogOutput(writer, None, prepared, run, source.digest)
            if results_only:
                output.exports.append(SummaryExport(writer, run.events))
            outputs.append(output)

        def flush() -> None:
            for writer in live:
                writer.flush()

        log.reader.done = flush
        yield outputs


def _copy_as_read(log: LiveLog, writer: McapWriter, options: ProcessOptions) -> None:
    """Copy the messages of the input: those that were read, and the others when they are."""
    is_rgb = any(camera.channel.topic == RGB_TOPIC for camera in log.cameras)

    @cache
    def copied(ident: int) -> int | None:
        """Return the output's channel for one of the input; None if it is not copied."""
        info = info_of(log.reader, ident)
        is_people = info.has_type(hiros_schemas.SKELETON_GROUP) and info.encoding == "cdr"
        is_people = is_people and may_be_read(info, options.topics or None)
        is_read = is_people or (is_rgb and is_of_rgb(info))
        if not is_kept(info, options, is_read=is_read):
            return None
        channel = log.reader.channels[ident]
        channel = kept_for_late(channel) if needs_latching(info) else channel
        return writer.adopt(channel, log.reader.schema(channel))

    def copy(message: Message) -> None:
        ident = copied(message.channel_id)
        if ident is not None:
            writer.write_message(ident, message)

    for message in log.reader.preface:
        copy(message)
    log.reader.listeners.append(copy)
