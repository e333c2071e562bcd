"""Writes the output log: copied input, one channel per stage, and how it came about."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TYPE_CHECKING

import hiros_schemas
from hiros_mcap._version import __version__
from hiros_mcap.body.rotations import Rigid
from hiros_mcap.config import to_toml
from hiros_mcap.frames import Block
from hiros_mcap.io.channels import (
    CONFIG_ATTACHMENT,
    EVENTS_ATTACHMENT,
    OUTPUT_PREFIX,
    OUTPUT_TOPICS,
    PROVENANCE,
    REPORT_ATTACHMENT,
    TRUTH_PREFIX,
    ChannelInfo,
    add_ros_channel,
    add_skeleton_channel,
    add_static_poses,
    is_static_topic,
    is_transform_topic,
    kept_for_late,
    needs_latching,
)
from hiros_mcap.io.codec import Encoder
from hiros_mcap.io.container import ChunkCopier, McapWriter
from hiros_mcap.io.container.losses import RECOVERY_METADATA
from hiros_mcap.io.detectors.keypoint_messages import is_keypoints
from hiros_mcap.io.detectors.rgb_keypoints import RGB_TOPIC
from hiros_mcap.io.log import Log, digest_of
from hiros_mcap.io.marker_uncertainty import UNCERTAINTY_TOPIC, uncertainty_messages
from hiros_mcap.running.observe import DETECTIONS
from hiros_mcap.running.preparation import Prepared
from hiros_mcap.running.process_options import ProcessOptions
from hiros_mcap.running.summary import Summary
from hiros_mcap.systems import LETTERS, Run, chain_of, merging_order, sections_of

if TYPE_CHECKING:
    from hiros_mcap.io.export.markers import MarkerExport
    from hiros_mcap.io.export.run_summary import SummaryExport


@contextmanager
def open_output(target: Path | None, prepared: Prepared, run: Run) -> Iterator[Sequence[LogOutput]]:
    """Yield the outputs of a run, one or none; nothing appears at ``target`` without a commit.

    Raises LogError if ``target`` is the input or cannot be written.
    """
    if target is None:
        yield ()
        return
    log, options = prepared.log, prepared.options
    with (
        McapWriter(target, inputs=[log.path], compression=options.compression) as writer,
        digest_of(Path(log.path)) as digest,
    ):
        kept = kept_channels(log, options, moved=is_moved(prepared))
        # Where players need /tf_static latched, it is copied at once.
        latched = [info for info in log.channels if info.id in kept and needs_latching(info)]
        copier = ChunkCopier(log.reader, writer, set(kept) - {info.id for info in latched})
        for info in latched:
            channel = kept_for_late(log.reader.channels[info.id])
            schema = log.reader.schema(channel)
            ident = writer.add_schema(schema.name, schema.data, schema.encoding) if schema else 0
            copy = writer.add_channel(info.topic, ident, metadata=channel.metadata)
            for message in log.reader.messages([info.id]):
                writer.write_message(copy, message)
        yield [LogOutput(writer, copier, prepared, run, digest.result)]


class LogOutput:
    """An MCAP file with the input and the results.

    Parameters
    ----------
    writer : of the file. copier : copies the input into it in step with the results; None = it
        is copied as it is read.
    prepared, run : of the run. digest : gives the SHA-256 of the input at the end.
    """

    def __init__(
        self,
        writer: McapWriter,
        copier: ChunkCopier | None,
        prepared: Prepared,
        run: Run,
        digest: Callable[[], str],
    ) -> None:
        params, log, options = run.config.output, prepared.log, prepared.options
        chain = chain_of(options.system, options.stages)
        self._writer, self._run, self._chain = writer, run, chain
        self._copier = copier
        if options.extrinsics is not None and options.keep is None:
            _write_poses(writer, log)
        elif is_moved(prepared) and options.keep is None:
            _write_transforms(writer, log)
        self._channels = {
            name: add_skeleton_channel(writer, f"{OUTPUT_PREFIX}/{name}") for name in chain
        }
        self._encoders = {
            name: Encoder(
                log.model,
                derivatives=name in params.with_derivatives(chain),
                precision=params.precision,
                boxes=True,
            )
            for name in chain
        }
        self._model, self._uncertainty = log.model, 0
        is_causal = {"causal": True, "stamp": False}.get(params.log_time, log.is_live)
        self._by_stamp = not is_causal
        self._given, self._digest = _given(options), digest
        self._input_messages = log.reader.counts
        self._recovery = log.recovery_mark
        self.exports: list[MarkerExport | SummaryExport] = []
        """Further outputs that are made of the last stage's frames."""
        if options.markers:
            from hiros_mcap.io.export.markers import MarkerExport

            self.exports.append(
                MarkerExport(writer, log.model, run.events, by_stamp=self._by_stamp)
            )

    @property
    def cpu_s(self) -> float:
        """CPU time of the writer's thread, s."""
        return self._writer.cpu_s

    def write(self, channel: str, block: Block) -> None:
        """Write the frames of a stage, behind the input up to that time."""
        if channel == DETECTIONS:
            return
        times = block.stamps if self._by_stamp else block.log_times
        if self._copier is not None:
            self._copier.until(int(times[0]))
        messages = self._encoders[channel].encode_block(block)
        self._writer.write_each(self._channels[channel], times.tolist(), messages)
        if block.uncertainty is not None and channel == self._chain[-1]:
            self._write_uncertainty(block, times.tolist())
        for export in self.exports if channel == self._chain[-1] else ():
            export.write(block)

    def _write_uncertainty(self, block: Block, times: list[int]) -> None:
        """Write how well the markers are known beside the poses."""
        if not self._uncertainty:
            topic, kind = UNCERTAINTY_TOPIC, hiros_schemas.UNCERTAINTY
            self._uncertainty = add_ros_channel(self._writer, topic, kind)
        self._writer.write_each(self._uncertainty, times, uncertainty_messages(block, self._model))

    def commit(self, summary: Summary) -> None:
        """Copy the rest of the input, add the provenance, and let the file appear."""
        if self._copier is not None:
            self._copier.finish()
        self._add_provenance(summary)
        self._writer.commit()

    def _add_provenance(self, summary: Summary) -> None:
        """Add how the file came about; nothing that differs from run to run."""
        run, writer = self._run, self._writer
        sections = sections_of(run.system)
        config = to_toml(run.config, sections).encode()
        provenance = {
            "version": __version__,
            "system": run.system,
            "stages": ",".join(self._chain),
            "fixed_frame": run.fixed_frame,
            "config_sha256": hashlib.sha256(config).hexdigest(),
            "input_messages": str(sum(self._input_messages.values())),
            "input_sha256": self._digest(),
            **self._given,
        }
        if "merge" in sections and LETTERS["M"] in self._chain:
            provenance["merging"] = ",".join(merging_order(run.config.merge))
        writer.add_metadata(PROVENANCE, provenance)
        if self._recovery:
            writer.add_metadata(RECOVERY_METADATA, self._recovery)
        writer.add_attachment(CONFIG_ATTACHMENT, config, "application/toml")
        writer.add_attachment(EVENTS_ATTACHMENT, run.events.to_json().encode(), "application/json")
        report = json.dumps(summary.reproducible(), indent=1, sort_keys=True)
        writer.add_attachment(REPORT_ATTACHMENT, report.encode(), "application/json")


def is_moved(prepared: Prepared) -> bool:
    """Whether cameras have other poses than the log says."""
    rig = prepared.log.rig
    return prepared.poses.replaced or (rig is not None and rig.is_moved)


def _write_poses(writer: McapWriter, log: Log) -> None:
    """Write the poses that replace the log's transforms, so that the output can be used alone."""
    named = {name for camera in log.cameras for name in camera.frames}
    named |= set(log.rig.homes.values()) if log.rig else set()
    frames = sorted(named - {log.fixed_frame})
    poses = {name: log.transforms.lookup(name, log.fixed_frame, 0) for name in frames}
    add_static_poses(writer, poses, log.fixed_frame, log.span[0])


def _write_transforms(writer: McapWriter, log: Log) -> None:
    """Write all static transforms, those of the cameras as they are used."""
    by_time: dict[tuple[int, str], dict[str, Rigid]] = {}
    for time, parent, child, pose in log.transforms.static_poses():
        by_time.setdefault((max(time, log.span[0]), parent), {})[child] = pose
    for (time, parent), poses in sorted(by_time.items(), key=lambda item: item[0]):
        add_static_poses(writer, poses, parent, time)


def _given(options: ProcessOptions) -> Mapping[str, str]:
    """Return what a run was given besides its log and its parameters."""
    files = {"extrinsics_sha256": options.extrinsics, "limbs_sha256": options.limbs_in}
    given = {
        name: hashlib.sha256(path.read_bytes()).hexdigest()
        for name, path in files.items()
        if path is not None
    }
    if options.topics:
        given["topics"] = ",".join(options.topics)
    if options.calibrate != "auto":
        given["calibrate"] = options.calibrate
    return given


def kept_channels(log: Log, options: ProcessOptions, *, moved: bool = False) -> list[int]:
    """Return the ids of the input channels that are copied.

    ``moved`` tells that the static transforms are replaced.
    """
    read = {camera.channel.id for camera in log.cameras}
    if any(camera.channel.topic == RGB_TOPIC for camera in log.cameras):
        read |= {info.id for info in log.channels if is_of_rgb(info)}
    return [
        info.id
        for info in log.channels
        if is_kept(info, options, is_read=info.id in read, moved=moved)
    ]


def is_kept(
    info: ChannelInfo, options: ProcessOptions, *, is_read: bool, moved: bool = False
) -> bool:
    """Whether a channel of the input is copied; ``is_read``: its skeletons are read."""
    if options.keep is None:
        # Transforms that a file replaced would contradict the result.
        replaced = options.extrinsics or (moved and is_static_topic(info.topic))
        if is_transform_topic(info.topic):
            return is_read or not replaced
        return is_read or info.topic.startswith(f"{TRUTH_PREFIX}/")
    if info.topic in (*OUTPUT_TOPICS, UNCERTAINTY_TOPIC):  # of a former run
        return False
    return any(fnmatchcase(info.topic, glob) for glob in options.keep)


def is_of_rgb(info: ChannelInfo) -> bool:
    """Whether a channel has the keypoints or the lens of an RGB camera."""
    return is_keypoints(info) or info.has_type(hiros_schemas.CAMERA_INFO)


def unmatched_globs(log: Log, options: ProcessOptions) -> list[str]:
    """Return a note for each glob of ``keep`` that fits no channel."""
    topics = [info.topic for info in log.channels]
    return [
        f"keep: the log has no channel {glob}"
        for glob in options.keep or ()
        if not any(fnmatchcase(topic, glob) for topic in topics)
    ]
