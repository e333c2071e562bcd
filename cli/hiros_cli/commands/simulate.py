"""``hiros simulate`` and ``hiros demo``: logs whose truth is known."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hiros_cli.compiling import prepare
from hiros_cli.options import FORCE, QUIET, argument, option
from hiros_cli.output import check_outputs
from hiros_mcap.errors import ConfigError
from hiros_mcap.progress import bar

if TYPE_CHECKING:
    from hiros_mcap.simulate import SimulateParams


def _scale(what: str) -> Any:
    return option("SCALE", f"{what} Default: 1.")


def _number(what: str, default: str) -> Any:
    return option("NUMBER", f"{what} Default: {default}.")


def simulate(
    output: Path = argument("OUT", "Log to write."),
    people: int | None = _number("Number of people, at most 10.", "1"),
    cameras: str | None = option(
        "NUMBER|FILE",
        "Number of cameras, at most 32. Or a file with their poses, as of `hiros plan`. "
        "Default: 5.",
    ),
    camera: str | None = option(
        "KIND[,KIND]",
        "depth: a camera that reports skeletons. rgb: one that reports keypoints of its image. One "
        "kind for all, or one each, such as depth,rgb,rgb. Default: depth.",
    ),
    joints: str | None = option(
        "NAME", "Joints that RGB cameras find: coco-17, halpe-26, openpose-25. Default: coco-17."
    ),
    action: str | None = option(
        "NAME", "walk, squat, wave, cross, ...; any unknown name lists all. Default: walk."
    ),
    detector: str | None = option(
        "NAME",
        "ideal: each joint errs by itself, and the detector knows what it guesses. kinect: whole "
        "limbs err together, and it is sure of all, as Kinect v2s were measured. Default: ideal.",
    ),
    seconds: float | None = _number("Length of the log, s, at most 86400.", "10"),
    rate: float | None = _number("Frames per second, at most 1000.", "30"),
    seed: int | None = _number("The same seed gives the same bytes.", "0"),
    noise: float | None = _scale("Noise and bias of the joints."),
    occlusion: float | None = _scale("Hidden joints, which the detector guesses."),
    flips: float | None = _scale("Left-right flips."),
    dropouts: float | None = _scale("Lost frames and lost people."),
    clock_jitter: float | None = _scale("Jitter of the frame times."),
    clock_offset: float | None = _number("SD of the constant error of a camera's clock, s.", "0"),
    calibration_error: float | None = _scale("Errors of the published camera poses."),
    phantoms: float | None = _scale("Detections of people who are not there."),
    force: bool = FORCE,
    quiet: bool = QUIET,
) -> None:
    """Write a synthetic log with a known truth.

    The true motion is on /truth/skeletons. SCALE sets how strong an effect is: 0 turns it off,
    1 is as much as a real depth camera has, at most 100.
    """
    given = {
        "people": people,
        "action": action,
        "kinds": None if camera is None else camera.split(","),
        "image": None if joints is None else {"joints": joints},
        "detector": None if detector is None else {"kind": detector},
        "seconds": seconds,
        "rate": rate,
        "seed": seed,
        "noise": noise,
        "occlusion": occlusion,
        "flips": flips,
        "dropouts": dropouts,
        "clock_jitter": clock_jitter,
        "clock_offset": clock_offset,
        "calibration_error": calibration_error,
        "phantoms": phantoms,
    }
    file = None if cameras is None or cameras.lstrip("-").isdigit() else Path(cameras)
    if file is not None:
        file.stat()
    check_outputs((output, "log"), inputs=(file,), force=force)
    prepare(quiet=quiet)
    from hiros_mcap.simulate.cameras import read_rig
    from hiros_mcap.simulate.simulation import write_log

    if file is not None:
        given |= read_rig(file)[1]
    elif cameras is not None:
        given["cameras"] = int(cameras)
    elif camera is not None and "," in camera:
        given["cameras"] = camera.count(",") + 1
    params = simulate_params({name: value for name, value in given.items() if value is not None})
    with bar(f"simulating {output.name}", quiet=quiet) as progress:
        written = write_log(output, params, progress)
    if not quiet:
        print(f"wrote {sum(written.values())} messages on {len(written)} channels to {output}")


def simulate_params(given: dict[str, Any]) -> SimulateParams:
    """Return the parameters of a simulation; raises ConfigError naming the option at fault."""
    from pydantic import ValidationError

    from hiros_mcap.params import explain
    from hiros_mcap.simulate import SimulateParams

    of_rig = {name: given.pop(name) for name in ("rate", "kinds", "clock_offset") if name in given}
    if of_rig:
        given["rig"] = {**given.get("rig", {}), **of_rig}
    try:
        return SimulateParams.model_validate(given)
    except ValidationError as error:
        where, message = explain(error)
        names = where[1:] if where[:1] in (["rig"], ["image"]) else where
        name = "camera" if names[:1] == ["kinds"] else "".join(names[:1]).replace("_", "-")
        option = f"--{name}: " if name else ""
        raise ConfigError(f"{option}{message}") from None


SECONDS = 10.0


def demo(
    output: Path = argument("OUT", "Log to write.", default=Path("demo.mcap")),
    force: bool = FORCE,
    quiet: bool = QUIET,
) -> None:
    """Write a sample log: two people cross before three cameras.

    It is simulated: skeletons with noise, flips and gaps, the cameras' poses, and the truth.
    """
    check_outputs((output, "log"), inputs=(), force=force)
    prepare(quiet=quiet)
    from hiros_cli.commands.process import SUFFIX
    from hiros_mcap.simulate import SimulateParams
    from hiros_mcap.simulate.simulation import write_log

    params = SimulateParams(people=2, cameras=3, action="cross", seconds=SECONDS)
    with bar(f"simulating {output.name}", quiet=quiet) as progress:
        write_log(output, params, progress)
    if not quiet:
        log, result = (shlex.quote(str(p)) for p in (output, output.with_suffix(SUFFIX)))
        print(f"wrote {output}; go on with\n    hiros process {log}\n    hiros view {result}")
