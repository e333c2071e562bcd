"""Preparation of a run: the poses and clocks of its cameras, before the first stage.

Every run is prepared here: of a file, of live input, of one system among several, and of a
recording that is scored against itself. :func:`prepare` is the order.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

from hiros_mcap.body.limb_table import LimbTable
from hiros_mcap.calibrate.guessed_depth import DepthErrors
from hiros_mcap.config import ClockParams, Config
from hiros_mcap.errors import ConfigError, LogError
from hiros_mcap.events import Events
from hiros_mcap.frames import Block
from hiros_mcap.io.camera_frames import cameras_called
from hiros_mcap.io.log import Log, Reading, with_rays
from hiros_mcap.running.clock_alignment import ClockAlignment
from hiros_mcap.running.observe import Stopwatch
from hiros_mcap.running.pose_alignment import PoseAlignment, align_cameras
from hiros_mcap.running.pose_follower import PoseFollower
from hiros_mcap.running.process_options import Calibration, ProcessOptions
from hiros_mcap.skeletons import Floats
from hiros_mcap.stages.known_cameras import KnownCameras
from hiros_mcap.stages.merge.instants import by_instants
from hiros_mcap.stages.time_order import Lateness, in_time_order
from hiros_mcap.systems import LETTERS, Run, Stages, chain_of, sections_of, system


@dataclass(frozen=True, slots=True)
class Prepared:
    """A log, and what is known of its cameras."""

    log: Log
    config: Config  # with the clocks of a file with poses
    options: ProcessOptions
    clocks: ClockAlignment
    poses: PoseAlignment
    watch: Stopwatch
    known: KnownCameras = field(default_factory=KnownCameras)

    @property
    def is_causal(self) -> bool:
        """Whether a message is used as soon as may be, for whoever waits for the result."""
        return self.clocks.causal or self.log.is_live

    def detections(self, reading: Reading | None = None) -> Iterator[Block]:
        """Read the log: detections at corrected times and in their order, where better poses are.

        ``reading`` is one of the log; None begins another. Raises LogError where it is damaged.
        """
        reading = reading or self.log.read()
        if not self.is_causal:
            return in_time_order(self.clocks.corrected(reading.blocks()), self.clocks.wait)
        lateness = Lateness(self.config.input.max_delay, self.clocks.reorder)
        self.clocks.needed = lateness.needed
        ordered = in_time_order(self._causally_corrected(reading), lateness)
        # A merger takes instants. They are cut here: an instant that is complete ends a wait.
        chain = chain_of(self.options.system, self.options.stages)
        if LETTERS["M"] not in chain or "merge" not in sections_of(self.options.system):
            return ordered
        merge = self.config.merge
        return by_instants(ordered, merge.cameras, merge.max_delta_time, in_step=merge.in_step)

    def _causally_corrected(self, reading: Reading) -> Iterable[Block]:
        """Correct clocks and poses by the messages so far."""
        if not self.clocks.causal:
            return self.clocks.corrected(reading.blocks())
        movable = self.config.input.poses != "given" and self.options.calibrate != "off"
        clocks = self.clocks.follower()
        follower = PoseFollower(reading, self.poses, self.known, clocks, movable=movable)
        return follower.correct(reading.blocks())


def prepare(log: Log, config: Config, options: ProcessOptions, watch: Stopwatch) -> Prepared:
    """Find out how the cameras of a log stand and how their clocks go.

    Raises
    ------
    LogError
        The cameras' frames are not joined, and the people do not tell their poses either.
    ConfigError
        A parameter names a camera that is not there, or contradicts ``--calibrate require``.
    """
    # Clocks of a file with poses; the user's own come first.
    config = _with_clocks(config, log)
    # Clocks and poses together: by the times of all messages, and by the people.
    mode, reorder = _calibration(log, config, options), _reorder_of(config, options.system)
    with watch.timing("calibrate"):
        log = _rays_given(log, config, options)
        clocks, poses = align_cameras(log, config, mode, reorder)
        if poses.guessed:
            log, faults = _rays_found(log, poses.guessed, config, options)
            alone = config.input.model_copy(update={"rays": "none"})
            at_rest = config.model_copy(update={"input": alone})
            clocks, poses = align_cameras(log, at_rest, mode, reorder)
            poses.contradictions = *faults, *poses.contradictions
    log = poses.used_in(log)
    offsets = () if clocks.given else clocks.offsets
    known = KnownCameras(
        camera_positions(log), poses.to_given, poses.errors, poses.misplaced, offsets
    )
    return Prepared(log, config, options, clocks, poses, watch, known)


def preparation_key(config: Config, options: ProcessOptions) -> tuple[object, ...]:
    """Return what a preparation depends on: runs with equal keys can share one."""
    reorder = _reorder_of(config, options.system)
    settings = config.input.model_dump_json(), config.clock.model_dump_json(), reorder
    return *settings, options.topics, options.extrinsics, options.calibrate, options.recover


def set_up(
    prepared: Prepared,
    config: Config | None = None,
    options: ProcessOptions | None = None,
    read: Callable[[], Iterable[Block]] | None = None,
) -> Run:
    """Return what the stages share, after the passes over the log that they need first.

    Parameters
    ----------
    prepared : the log.
    config, options : of the stages, if they are not those of the preparation.
    read : gives the detections, for a first pass; None reads the log.

    Raises ConfigError for a calibration window that starts after the end of the log.
    """
    log, config = prepared.log, config or prepared.config
    options, read = options or prepared.options, read or prepared.detections
    _check_windows(log, config)
    run = Run(
        model=log.model,
        config=config,
        limbs=LimbTable.load(options.limbs_in) if options.limbs_in else LimbTable(),
        known=prepared.known,
        fixed_frame=log.fixed_frame,
        system=options.system,
        derivatives=config.output.with_derivatives(chain_of(options.system, options.stages)),
    )
    _calibrate_first(run, chain_of(options.system, options.stages), read)
    return run


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


def stages_of(run: Run, chain: Sequence[str]) -> Stages:
    """Return the stages of a run by their output channels, in order.

    Raises ConfigError if a package's system lacks a channel that its chains name.
    """
    table = system(run.system).stages(run)
    if missing := [name for name in chain if name not in table]:
        raise ConfigError(
            f"system {run.system} fills no channel {missing[0]!r}, which its chains name"
        )
    return {name: table[name] for name in chain}


def _calibration(log: Log, config: Config, options: ProcessOptions) -> Calibration:
    """Return how the poses are refined before a run: a causal or published one does not wait."""
    given = config.input.poses == "given"
    if config.input.clocks != "causal" and not given and not log.is_live:
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


def _rays_given(log: Log, config: Config, options: ProcessOptions) -> Log:
    """Take the cameras as rays that the configuration names; raises ConfigError for a stranger."""
    names = config.input.rays
    if isinstance(names, str) or log.is_live or not names:
        return log
    channels = {
        name: camera.channel.topic
        for camera in log.cameras
        for name in (*camera.sources.values(), *camera.frames, camera.channel.topic)
    }
    if unknown := [name for name in names if name not in channels]:
        raise ConfigError(
            f"input.rays: the log has no camera {unknown[0]!r} (there are: "
            f"{', '.join(sorted(channels))})"
        )
    topics = {channels[name] for name in names}
    remark = f"{', '.join(names)}: taken as rays, as input.rays says"
    return with_rays(log, topics, remark, refine=poses_are_refined(config, options))


def _rays_found(
    log: Log, guessed: Mapping[str, DepthErrors], config: Config, options: ProcessOptions
) -> tuple[Log, tuple[str, ...]]:
    """Take the cameras as rays that guess depths; where rays fail, return the log and say why."""
    topics = {
        camera.channel.topic
        for camera in log.cameras
        if not guessed.keys().isdisjoint(camera.sources.values())
    }
    errors = ", ".join(
        f"{name} {1000 * e.along:.0f} against {1000 * e.across:.0f} mm"
        for name, e in guessed.items()
    )
    finding = f"the detector guesses depths ({errors} across the rays)"
    remark = (
        f"{finding}: only the directions of joints count, triangulated as those of RGB cameras; "
        "input.rays=none takes them as they are"
    )
    try:
        return with_rays(log, topics, remark, refine=poses_are_refined(config, options)), ()
    except LogError as error:
        return log, (f"{finding}, but the depths count, as triangulation failed: {error.fault}",)


def poses_are_refined(config: Config, options: ProcessOptions) -> bool:
    """Whether a run may take other poses than the given ones."""
    return options.calibrate != "off" and config.input.poses != "given"


def _with_clocks(config: Config, log: Log) -> Config:
    """Add the clocks of a file with poses to the configuration, whose own come first."""
    clocks = {
        source: seconds
        for name, seconds in log.transforms.clocks.items()
        for camera in cameras_called(name, log.cameras)
        for source in ([name] if name in camera.sources.values() else camera.sources.values())
    }
    if not clocks:
        return config
    clock = ClockParams.model_validate({**clocks, **config.clock.seconds})
    return config.model_copy(update={"clock": clock})


def _reorder_of(config: Config, name: str) -> float:
    """Return the longest time, s, by which a system's first stage takes messages that are late."""
    first = config.track if "track" in sections_of(name) else config.associate
    return first.reorder


def _check_windows(log: Log, config: Config) -> None:
    start, end = log.span
    seconds = (end - start) / 1e9
    for first, last in config.optimize.calibration_windows:
        if 0 < first >= seconds:
            raise ConfigError(
                f"{log.path}: ends after {seconds:.1f} s, before the calibration window "
                f"{first:g}:{last:g} starts"
            )


def _calibrate_first(run: Run, chain: Sequence[str], read: Callable[[], Iterable[Block]]) -> None:
    """Measure the limbs on the whole log before the run, if it is to have two passes."""
    wanted = "optimize" in sections_of(run.system) and "optimized" in chain
    if not wanted or run.config.optimize.calibration != "two-pass" or run.limbs.people:
        return
    from hiros_mcap.stages.optimize.limb_calibration import calibrate_limbs

    first_pass = replace(run, events=Events(), limbs=LimbTable())
    blocks = read()
    for stage in stages_of(first_pass, chain[: chain.index("optimized")]).values():
        blocks = stage(blocks)
    table = calibrate_limbs(blocks, run.model, run.config.optimize, run.events)
    run.limbs.people.update(table.people)
