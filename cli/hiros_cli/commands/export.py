"""``hiros export`` and ``hiros import``: results and joints as files of other programs."""

from __future__ import annotations

from pathlib import Path

from hiros_cli.compiling import prepare
from hiros_cli.many_logs import ManyLogs, one_log, run
from hiros_cli.options import FORCE, GROUP, MANY, QUIET, argument, by_camera, grouped, option
from hiros_cli.output import check_outputs, print_json, warn
from hiros_mcap.defaults import LEAST_CONFIDENCE
from hiros_mcap.errors import ConfigError
from hiros_mcap.progress import bar


@grouped
def export(
    logs: list[str] = argument("LOG", "Outputs of `hiros process`: files, folders, globs."),
    output: str = option(
        "FILE",
        "Output file; its suffix is the format, such as .csv, .parquet, .trc, .mot, .c3d or .bvh "
        "(a wrong one lists all). With many logs, the folder for all.",
        "-o",
        "--output",
        default=...,
    ),
    file_format: str = option(
        "SUFFIX", "Format of the files of many logs.", "--format", default="csv", panel=MANY
    ),
    what: str = option(
        "PART", "joints, angles or both. Default: all that fits the format.", default=""
    ),
    person: int | None = option("ID", "One person. Default: everybody."),
    channel: str = option("TOPIC", "Channel to export. Default: the last stage.", default=""),
    rate: float | None = option(
        "HZ", "Resample to this rate. Default: only if the format needs it."
    ),
    start: float = option(
        "S",
        "Start, s from the log's start. Default: all.",
        default=float("-inf"),
        show_default=False,
    ),
    end: float = option(
        "S", "End, s from the log's start. Default: all.", default=float("inf"), show_default=False
    ),
    marker_set: str = option(
        "FILE",
        "For .trc and .c3d: TOML file of marker names, ours = theirs, or rajagopal for the "
        "joint centres of that OpenSim model. Default: our names.",
        default="",
    ),
    least_confidence: float = option(
        "0..1",
        "Markers below this confidence are gaps: nobody saw them. 0 writes them all.",
        default=LEAST_CONFIDENCE,
        min=0,
        max=1,
    ),
    many: ManyLogs = GROUP,
) -> None:
    """Write joints and angles as CSV, TRC, MOT, C3D, BVH."""
    from hiros_mcap.io.export.files import export as write
    from hiros_mcap.io.export.files import files_of, format_of, load_marker_set, renamed

    is_many, suffix = many.wanted(logs, output), f".{file_format.lstrip('.').lower()}"
    target = Path("log").with_suffix(suffix) if is_many else Path(output)
    format_of(target)
    if marker_set:
        _check_marker_set(target, what)
    if is_many:
        from hiros_mcap.many.jobs import ExportJob

        prepare(quiet=many.quiet)
        names = str(Path(marker_set).absolute()) if Path(marker_set).is_file() else marker_set
        part = (what, person, channel, rate, start, end)
        job = ExportJob(suffix, *part, names, least_confidence)
        run(job, logs, many, output)
    log = one_log(logs[0])
    prepare(quiet=many.quiet)
    from hiros_mcap.io.result import open_result

    with bar(f"exporting {log.name}", quiet=many.quiet):
        result = open_result(log, channel).select(person, start, end, rate)
        if marker_set:
            result, what = renamed(result, load_marker_set(marker_set, result.model)), "joints"
        files = files_of(target, result.people)
        check_outputs(*((path, "export") for path in files), inputs=(log,), force=many.force)
        warnings: list[str] = []
        written = write(result, target, what, least_confidence, warn=warnings.append)
    for text in warnings:
        warn(text)
    if many.json:
        print_json("export", {"log": logs[0], "files": list(map(str, written))}, warnings)
    for path in () if many.quiet or many.json else written:
        print(f"wrote {path}")


def _check_marker_set(target: Path, what: str) -> None:
    """Raise ConfigError if a file cannot have the marker names of another model."""
    from hiros_mcap.io.export.files import SUFFIXES

    if target.suffix.lower() not in SUFFIXES or what not in ("", "joints"):
        raise ConfigError(f"{target}: --marker-set is for the joints of {' and '.join(SUFFIXES)}")


def import_(
    sources: list[Path] = argument(
        "FILE", "CSV, TRC, C3D, JSON or numpy files, or folders of JSON files, one for each camera."
    ),
    output: Path = option("LOG", "MCAP log to write.", "--output", "-o", default=...),
    mapping: Path | None = option(
        "FILE",
        "TOML file with names, units, axes, cameras and clock of FILE; or openpose, "
        "mediapipe, mediapipe-image, mmpose, freemocap, pose2sim, opencap, motive, azure-kinect, "
        "zed.",
    ),
    calibration: list[Path] | None = option(
        "FILE",
        "Of RGB cameras: lenses and poses, as TOML of Anipose, FreeMoCap, Caliscope, Pose2Sim, as "
        ".qca.txt, or ROS' camera_info as YAML (one per camera).",
    ),
    extrinsics: Path | None = option("FILE", "Poses of RGB cameras, instead of those."),
    rate: list[str] | None = option("HZ", "Rate of files without times; CAMERA=HZ of one."),
    start: list[str] | None = option("CAMERA=S", "Seconds by which a camera began later."),
    joints: str | None = option("MODEL", "Keypoints are those of openpose-25b, halpe-26, ..."),
    force: bool = FORCE,
    quiet: bool = QUIET,
) -> None:
    """Turn files of joints, in a room or in images, into a log.

    hiros process, view and info read it like any other.
    """
    for path in (*sources, *(calibration or ())):
        path.stat()
    check_outputs((output, "log"), inputs=(*sources, mapping), force=force)
    prepare(quiet=quiet)
    from hiros_mcap.io.joints.image_series import RgbSetup
    from hiros_mcap.io.joints.importing import import_joints

    form = "NUMBER or CAMERA=NUMBER"
    rates, starts = by_camera("--rate", rate, form), by_camera("--start", start, form)
    if any(hertz <= 0 for hertz in rates.values()):
        raise ConfigError("--rate: should be above 0")
    setup = RgbSetup(tuple(calibration or ()), extrinsics, joints or "", rates, starts)
    notes: list[str] = []
    with bar(f"importing {sources[0].name}", quiet=quiet) as progress:
        written = import_joints(sources, output, mapping, warn, notes.append, setup, progress)
    if not quiet:
        print(f"wrote {sum(written.values())} messages on {len(written)} channels to {output}")
        for text in notes:
            print(f"note: {text}")
