"""``hiros info``: what a log holds, and whether ``hiros process`` can use it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from hiros_cli.compiling import prepare
from hiros_cli.many_logs import ManyLogs, one_log, run
from hiros_cli.options import CAMERAS, EXTRINSICS, GROUP, argument, grouped, settings_of
from hiros_cli.output import print_json, warn

if TYPE_CHECKING:
    from hiros_mcap.running.overview import CameraRow, ChannelRow, KeypointRow, Overview


@grouped
def info(
    logs: list[str] = argument("LOG", "MCAP files, ROS bags, folders of them, globs."),
    topic: list[str] | None = CAMERAS,
    extrinsics: Path | None = EXTRINSICS,
    many: ManyLogs = GROUP,
) -> None:
    """Show what an MCAP file or bag holds.

    It lists channels, cameras, people, rates and gaps. Of what hiros wrote, it also shows the
    version, the system and the changed parameters.
    """
    json, quiet, is_many = many.json, many.quiet, many.wanted(logs)
    prepare(quiet=json or quiet)
    if is_many:
        from hiros_mcap.many.jobs import InfoJob

        run(InfoJob(tuple(topic or ()), extrinsics and extrinsics.absolute()), logs, many)
    source = one_log(logs[0])
    from hiros_mcap.running.overview import overview_of
    from hiros_mcap.running.pipeline import ProcessOptions, open_input, skeletons_read

    config = settings_of(logs[0]).load()
    skeletons = skeletons_read(config)
    overview = overview_of(source, topics=topic, extrinsics=extrinsics, skeletons=skeletons)
    if overview.kind == "recording" and overview.cameras:
        from hiros_mcap.running.pose_alignment import pose_faults

        options = ProcessOptions(topics=tuple(topic or ()), extrinsics=extrinsics)
        with open_input(source, config, options) as log:
            faults = pose_faults(log)
        overview = replace(overview, warnings=(*overview.warnings, *faults))
    for text in overview.warnings:
        warn(text)
    if json:
        print_json("info", overview.to_dict())
    elif not quiet:
        _show(overview)


def _show(overview: Overview) -> None:
    from hiros_cli.run_report import listing, page
    from hiros_mcap.wording import number

    kind = "log" if overview.kind == "other" else overview.kind
    size = _size(overview.megabytes)
    channels = listing(
        overview.channels,
        ("Channel", lambda row: row.topic),
        (">Messages", lambda row: row.messages),
        (">Mean rate", lambda row: number(row.rate_hz, 1, " Hz")),
        (">Seconds", lambda row: number(row.seconds, 1)),
        ("Type", _type),
    )
    cameras = listing(
        overview.cameras,
        ("Camera", lambda row: row.name),
        (">Usual rate", lambda row: number(row.rate_hz, 1, " Hz")),
        (">Longest gap", lambda row: number(row.longest_gap_s, 2, " s")),
        (
            ">People (mean)",
            _people,
        ),
        ("Frame", _frame),
    )
    keypoints = listing(
        overview.keypoints,
        ("RGB camera", lambda row: row.camera),
        ("Joints", lambda row: row.joints),
        (">Images", lambda row: row.images),
        (">Rate", lambda row: number(row.rate_hz, 1, " Hz")),
        (">People (mean)", _people),
        (">Pixels", lambda row: f"{row.width} x {row.height}"),
    )
    people = listing(
        overview.people,
        ("Channel", lambda row: row.topic),
        (">Person", lambda row: row.id),
        (">Seconds", lambda row: number(row.seconds, 1)),
        (">Frames", lambda row: row.frames),
    )
    page(
        f"{overview.path}: {kind}, {number(overview.seconds, 1)} s, {size}",
        *(rows for rows in (channels, keypoints, cameras, people) if rows.row_count),
        [*_run(overview), *_facts(overview)],
    )


def _size(megabytes: float) -> str:
    return f"{megabytes:.1f} MB" if megabytes >= 0.1 else f"{1000 * megabytes:.1f} kB"


def _type(row: ChannelRow) -> str:
    """Return the type without its package, for narrow terminals; and any encoding but ROS 2's."""
    name = row.type.rpartition("/")[2] or "no schema"
    return name if row.encoding == "cdr" else f"{name} ({row.encoding or 'no encoding'})"


def _people(row: CameraRow | KeypointRow) -> str:
    from hiros_mcap.wording import number

    return f"{row.least_people} to {row.most_people} ({number(row.mean_people, 2)})"


def _run(overview: Overview) -> list[str]:
    """Return how a result came about, as far as the file tells."""
    run = overview.run
    if run is None:
        return []
    if not run.version:
        return ["how it was made: the file does not say"]
    preset = f", preset {run.preset}" if run.preset else ""
    lines = [f"made by hiros {run.version}: system {run.system}{preset}"]
    lines.append(f"stages: {', '.join(run.stages)}; results in the frame {run.fixed_frame}")
    lines += [
        f"changed: {row.name} = {row.value}" + (f" (preset: {row.default})" if row.default else "")
        for row in run.changed
    ]
    return lines + [f"warning of that run: {text}" for text in run.warnings]


def _frame(row: CameraRow) -> str:
    if row.fault:
        return f"{row.frame or 'none named'} ({row.fault})"
    return f"{row.frame} (resolved)" if row.frame else "none named"


def _facts(overview: Overview) -> list[str]:
    from hiros_mcap.io.log import STALE

    lines = []
    if overview.markers:
        lines.append(f"skeleton: {len(overview.markers)} markers, {len(overview.links)} links")
        lines.append(f"markers: {', '.join(overview.markers)}")
    if overview.fixed_frame:
        lines.append(f"fixed frame: {overview.fixed_frame}")
    elif overview.cameras:
        lines.append(f"fixed frame: none; {overview.fault}")
    else:
        lines.append(f"nothing to process: {overview.fault}")
    if not overview.has_checksums:
        lines.append("no checksums: nobody would notice a damaged message")
    lines += overview.remarks
    lines += overview.clocks
    for topic, reasons in overview.skipped.items():
        for reason, n in reasons.items():
            why = "they repeat the one before, so nothing is lost" if reason == STALE else reason
            lines.append(f"{topic}: {n} messages skipped: {why}")
    return lines
