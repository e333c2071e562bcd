"""The parameters of all stages together: presets, a TOML file, single assignments.

Later layers win: defaults < system < preset < file < ``stage.param=value``. Only names that exist
are accepted, and an error names the layer, the parameter and what would have been right.
"""

from __future__ import annotations

import os
import textwrap
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import tomli_w
from pydantic import (
    ConfigDict,
    Field,
    ValidationError,
    ValidationInfo,
    field_validator,
)

from hiros_mcap._version import __version__
from hiros_mcap.body.units import AXES, METRES, by_camera
from hiros_mcap.defaults import DEFAULT_SYSTEM, LIVE_SYSTEM, NO_PRESET
from hiros_mcap.errors import ConfigError
from hiros_mcap.outside import parse, read_toml
from hiros_mcap.params import Params, Seconds, advanced, explain, fixed, is_advanced, is_fixed
from hiros_mcap.stages.detections.detection_params import PlausibleParams, SidesParams
from hiros_mcap.stages.filter.filter_params import FilterParams
from hiros_mcap.stages.fuse.fuse_params import ConstrainParams, FuseParams
from hiros_mcap.stages.lee.lee_params import ClusterParams, PredictParams
from hiros_mcap.stages.malaguti.malaguti_params import (
    AssociateParams,
    KalmanParams,
    MovingAverageParams,
    StraightenParams,
)
from hiros_mcap.stages.merge.merge_params import MergeParams
from hiros_mcap.stages.optimize.optimize_params import OptimizeParams
from hiros_mcap.stages.track.track_params import TrackParams
from hiros_mcap.wording import instead

Table = dict[str, dict[str, Any]]
"""Values by section and parameter."""

WIDTH = 80
SETTINGS = "hiros.toml"
"""A file of this name holds the parameters for the logs in its folder and in those below."""


class InputParams(Params):
    """How the log is read, and the frame of the results."""

    fixed_frame: str = Field(
        "", description="Frame of all results. Empty: the root of the cameras' transforms."
    )

    model: str = Field(
        "",
        description="Skeleton of the results where detectors have different ones: union, "
        "azure-kinect, kinect-v2, zed-18, zed-34, zed-38, zed-70, ros4hri, openpose-25, "
        "mediapipe-33, or the topic of a camera. Empty: as in the log, the union if there are "
        "several.",
    )
    unit: str = Field(
        "m",
        description="Unit of the log's positions: m, cm or mm. Of some cameras: left=mm,right=cm, "
        "by their topics or parts of them.",
    )
    negate: str = Field(
        "",
        description="Axis of the detections, x, y or z, whose sign is changed, because a camera's "
        "axes are left-handed. Of some cameras: left=x,right=x.",
    )

    clocks: Literal["lookahead", "causal", "off"] = Field(
        "lookahead",
        description="How the cameras' clocks are judged. lookahead: by the whole log and by the "
        "people in it. causal: each message by those before it, as a live system has to. off: "
        "stamps are taken as they are.",
    )
    max_delay: Seconds = advanced(
        0.3,
        ge=0,
        description="Longest time, s, for which messages of a live system wait for others that are "
        "late. They wait as long as 97 % of the messages of the slowest camera were late in the "
        "last 10 s, and not at all below 0.04 s, or below the period of cameras faster than 33 Hz.",
    )
    poses: Literal["refined", "given"] = advanced(
        "refined",
        description="The cameras' poses. refined: compared with the people before the run, better "
        "ones are used (--calibrate). given: those of the log or of --extrinsics, as published "
        "methods take them.",
    )
    rays: Literal["found", "none"] | list[str] = Field(
        "found",
        description="Cameras whose 3D skeletons have a depth that the detector guesses from one "
        "image. Only the directions of their joints count, triangulated as keypoints of RGB "
        "cameras are. found: those whose people disagree with other cameras' far more along their "
        "rays than across. none: no camera. Or a list of cameras or topics; live, only that.",
    )
    moved: bool = fixed(True, "Look for cameras that were moved in the middle of the log.")

    @field_validator("unit", "negate")
    @classmethod
    def _are_of_cameras(cls, text: str, info: ValidationInfo) -> str:
        by_camera(text, AXES if info.field_name == "negate" else METRES)
        return text


_MOST_S = 4e9  # no correction of a clock is larger: the stamps of messages span 137 years


class ClockParams(Params):
    """Corrections of the cameras' clocks: seconds to add to their stamps, by camera."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[
        str, Annotated[float, Field(allow_inf_nan=False, ge=-_MOST_S, le=_MOST_S)]
    ]

    @property
    def seconds(self) -> dict[str, float]:
        """Camera -> s to add to its stamps."""
        return dict(self.__pydantic_extra__)


class OutputParams(Params):
    """How results are written."""

    log_time: Literal["auto", "causal", "stamp"] = Field(
        "auto",
        description="Log time of the results; players and `ros2 bag play` replay by it. auto: "
        "stamp for a file, causal for live input. stamp: the time of the data, as in the header; "
        "players then show results beside the recording. causal: the time when a live system "
        "could have produced the result, some seconds after the data.",
    )
    derivatives: Literal["filtered", "all"] = Field(
        "filtered",
        description="Where velocities and accelerations are written. filtered: only in the last "
        "channel of the chain (/hiros/filtered if the system filters); the other channels hold "
        "poses. all: in every channel whose stage computes them.",
    )
    precision: Literal["micrometre", "full"] = Field(
        "micrometre",
        description="Precision of the written numbers. micrometre: 20 bits of mantissa; the error "
        "is at most 0.5 um at 1 m and 1 um at 2 m, and the compressed size is half. full: every "
        "bit.",
    )

    def with_derivatives(self, chain: Sequence[str]) -> Sequence[str]:
        """Return the channels of a chain that hold velocities and accelerations."""
        return chain if self.derivatives == "all" else chain[-1:]


Section = TypeVar("Section", bound=Params)


def _part(params: type[Section], text: str) -> Section:
    """Return the field of a section, with its defaults."""
    field: Section = Field(params(), description=text)
    return field


class Config(Params):
    """Every parameter of a run, one section per step."""

    input: InputParams = _part(InputParams, "Reading the cameras.")
    clock: ClockParams = _part(
        ClockParams, "Seconds to add to the stamps of a camera: camera = seconds."
    )
    output: OutputParams = _part(OutputParams, "Writing the results.")
    track: TrackParams = _part(TrackParams, "Tracking (Hi-ROS 3.1).")
    plausible: PlausibleParams = _part(
        PlausibleParams, "Detections against the person's own limbs, before merging."
    )
    sides: SidesParams = _part(SidesParams, "Left and right of each view, before merging.")
    merge: MergeParams = _part(MergeParams, "Merging: one skeleton per person (Hi-ROS 3.2).")
    optimize: OptimizeParams = _part(
        OptimizeParams, "Optimizing: constant limb lengths (Hi-ROS 3.3)."
    )
    filter: FilterParams = _part(FilterParams, "Filtering: smooth motion (Hi-ROS 3.4).")
    fuse: FuseParams = _part(FuseParams, "Fusing in fuse: one smooth trajectory per joint.")
    constrain: ConstrainParams = _part(
        ConstrainParams, "Constant lengths and the person's own motion in fuse."
    )
    associate: AssociateParams = _part(
        AssociateParams, "Tracking in malaguti and the baselines (Malaguti III-A)."
    )
    kalman: KalmanParams = _part(
        KalmanParams, "Fusion in malaguti and openptrack (Malaguti III-B to III-D)."
    )
    straighten: StraightenParams = _part(
        StraightenParams, "Constant limb lengths in malaguti (Malaguti III-E)."
    )
    moving_average: MovingAverageParams = _part(
        MovingAverageParams, "Moving average in the baseline maf."
    )
    cluster: ClusterParams = _part(
        ClusterParams, "Merging in lee: one skeleton per person (Lee 2.2)."
    )
    predict: PredictParams = _part(PredictParams, "Filtering in lee: smooth motion (Lee 2.2.3).")


PRESETS = (NO_PRESET, "realtime", "paper", "upstream")
"""Named changes to the defaults of hiros; ``systems/presets`` has a file for each."""

_TABLES = Path(__file__).parent / "systems" / "presets"
"""Values of presets, and of systems that are another one with other parameters."""


@cache
def _values_of(name: str) -> Table:
    """Return what a preset or system changes, on top of its ``base``; nothing if it has no file."""
    path = _TABLES / f"{name}.toml"
    if not path.exists():
        return {}
    table = read_toml(path)
    base = _values_of(table.pop("base", NO_PRESET))
    return {s: {**base.get(s, {}), **table.get(s, {})} for s in {**base, **table}}


def presets_of(system: str) -> tuple[str, ...]:
    """Return the presets that a system takes: all change hiros and what shares its stages."""
    return (NO_PRESET,) if system in (DEFAULT_SYSTEM, LIVE_SYSTEM) else PRESETS


def load_config(
    path: Path | None = None,
    overrides: Sequence[str] = (),
    preset: str = NO_PRESET,
    system: str = DEFAULT_SYSTEM,
    named: Mapping[str, Table] | None = None,
) -> Config:
    """Return the configuration of a run.

    Parameters
    ----------
    path : TOML file with a table per section, as :func:`to_toml` writes it.
    overrides : assignments ``section.param=value``; the value is TOML, a bare word is a string.
    preset : a key of :data:`PRESETS`. None but the default fits fuse and fuse-realtime.
    system : a key of :data:`hiros_mcap.systems.SYSTEMS`, whose own defaults come first.
    named : values by the option that the user gave for them, which errors name; they come before
        ``overrides``.

    Raises ConfigError if a name does not exist, a value is out of range, or the file cannot be
    read.
    """
    if preset not in PRESETS:
        raise ConfigError(f"no preset {preset!r}{instead(preset, PRESETS)}")
    if preset not in presets_of(system):
        raise ConfigError(
            f"preset {preset} is of hiros and means nothing to {system}; run the system hiros, or "
            f"fuse-realtime without a preset if nothing may wait for later frames"
        )
    layers = [(f"system {system}", _values_of(system)), (f"preset {preset}", _values_of(preset))]
    layers += [(str(path), read_toml(path))] if path is not None else []
    layers += list((named or {}).items())
    layers += [("--set", _assignment(text)) for text in overrides]
    merged: Table = {}
    origins: dict[tuple[str, ...], str] = {}
    for origin, table in layers:
        is_text = origin in ("--set", str(path))
        for section, values in table.items():
            _check_names(section, values, merged, origin, are_refused=is_text)
            merged.setdefault(section, {}).update(values)
            origins[(section,)] = origin
            origins.update({(section, name): origin for name in values})
    try:
        return Config.model_validate(merged)
    except ValidationError as error:
        raise _explained(error, origins) from None


def settings_beside(log: str | os.PathLike[str]) -> Path | None:
    """Return the file hiros.toml of a log: in its folder, or else in the nearest one above.

    None if there is none; a pipe, a server and a graph have none.
    """
    if str(log) == "-" or "://" in str(log):
        return None
    files = (folder / SETTINGS for folder in Path(log).absolute().parents)
    return next((file for file in files if file.is_file()), None)


@dataclass(frozen=True, slots=True)
class Settings:
    """Where the parameters of a run come from; :func:`load_config` has the meaning of each."""

    system: str = DEFAULT_SYSTEM
    preset: str = NO_PRESET
    file: Path | None = None  # none = the file hiros.toml of each log
    assignments: tuple[str, ...] = ()
    named: Mapping[str, Table] = field(default_factory=dict)

    def of(self, log: str | os.PathLike[str]) -> Settings:
        """Return the settings of a log: with its own file, if none is named."""
        return self if self.file else replace(self, file=settings_beside(log))

    def load(self) -> Config:
        """Return the parameters; raises ConfigError as :func:`load_config` does."""
        return load_config(self.file, self.assignments, self.preset, self.system, self.named)


def _assignment(text: str) -> Table:
    name, equals, value = text.partition("=")
    section, dot, param = name.strip().partition(".")
    if not (equals and dot and section and param):
        raise ConfigError(f"--set: {text!r} is not of the form stage.param=value")
    return {section: {param: _value(value.strip())}}


def _value(text: str) -> Any:
    """Return ``text`` read as a TOML value, itself if it is none (``state_space``, ``a/b``)."""
    try:
        table = parse(f"value = {text}", "TOML", "--set")
    except ConfigError:
        return text
    return table["value"] if len(table) == 1 else text


def _check_names(
    section: str, values: Any, merged: Table, origin: str, *, are_refused: bool
) -> None:  # fmt: skip
    """Refuse names that do not exist, and other values of parameters that are not for users.

    A user may repeat a value that the system, the preset or the code sets, but not change it:
    the account of a run holds it, too.
    """
    if section not in Config.model_fields:
        guess = instead(section, Config.model_fields)
        raise ConfigError(f"{origin}: no section {section!r}{guess}")
    if not isinstance(values, Mapping):
        raise ConfigError(f"{origin}: {section} is a section, not a value")
    params = _section(section)
    there, is_open = params.model_fields, params.model_config.get("extra") == "allow"
    for name, value in values.items():
        if name not in there and not is_open:
            guess = instead(name, there, f"{section}.")
            raise ConfigError(f"{origin}: no parameter {section}.{name}{guess}")
        if name in there and is_fixed(there[name]) and are_refused:
            now = merged.get(section, {}).get(name, there[name].default)
            if value != now:
                raise ConfigError(
                    f"{origin}: only the system and the preset set {section}.{name}, here "
                    f"{toml_value(now)}; leave it out"
                )


def _section(name: str) -> type[Params]:
    section = Config.model_fields[name].annotation
    if not (isinstance(section, type) and issubclass(section, Params)):
        raise TypeError(f"section {name} is not a Params class")
    return section


def _explained(error: ValidationError, origins: Mapping[tuple[str, ...], str]) -> ConfigError:
    where, message = explain(error)
    origin = origins.get(tuple(where[:2]))
    key = ".".join(where)
    return ConfigError(": ".join([*([origin] if origin else []), key, message]))


def to_toml(
    config: Config,
    sections: Collection[str] = Config.model_fields,
    *,
    everything: bool = True,
    fixed: bool = True,
) -> str:
    """Return ``config`` as TOML that :func:`load_config` reads back, documented by comments.

    Parameters
    ----------
    sections : those to print, such as :func:`hiros_mcap.systems.sections_of` a system.
    everything : also print advanced parameters that have their default values.
    fixed : also print what only systems and presets set, which completes the account of a run.
    """
    blocks = [f"# hiros {__version__}: parameters with the values in effect.\n"]
    hidden = 0
    for section in (name for name in Config.model_fields if name in sections):
        params: Params = getattr(config, section)
        fields = settable(params)
        names = [name for name in fields if everything or _is_shown(params, name)]
        hidden += len(fields) - len(names)
        if fixed:
            names += [name for name in type(params).model_fields if name not in fields]
        if params.model_extra:
            title = f"# {Config.model_fields[section].description}\n"
            blocks.append(title + tomli_w.dumps({section: params.model_extra}))
        if names:
            blocks.append(f"# {Config.model_fields[section].description}\n[{section}]\n")
            blocks += [_entry(params, name) for name in names]
    if hidden:
        blocks.append(f"# {hidden} advanced parameters have their defaults; --all shows them.\n")
    return "\n".join(blocks)


def settable(params: Params) -> list[str]:
    """Return the names of the parameters that a user can set."""
    fields = type(params).model_fields.items()
    return [name for name, field in fields if not is_fixed(field)]


def _is_shown(params: Params, name: str) -> bool:
    """Whether users touch a parameter, or somebody changed it."""
    field = type(params).model_fields[name]
    default = field.get_default(call_default_factory=True)
    return not is_advanced(field) or getattr(params, name) != default


def _entry(params: Params, name: str) -> str:
    """One parameter: what it is, what is allowed, what it is by default, its value."""
    field = type(params).model_fields[name]
    value, default = getattr(params, name), field.get_default(call_default_factory=True)
    comment = _explanations(type(params))[name]
    if value != default:
        comment += _comment(f"Default: {toml_value(default)}.")
    line = f"# {name} is not set" if value is None else f"{name} = {toml_value(value)}"
    return f"{comment}{line}\n"


@cache
def _explanations(kind: type[Params]) -> dict[str, str]:
    """Return what each parameter is and what is allowed, as comments; every run writes them."""
    found, schema = {}, kind.model_json_schema()["properties"]
    for name, info in kind.model_fields.items():
        limits = allowed(schema[name])
        found[name] = _comment(" ".join((info.description or "").split()))
        found[name] += _comment(f"Allowed: {limits}.") if limits else ""
    return found


def _comment(text: str) -> str:
    return textwrap.fill(text, WIDTH, initial_indent="# ", subsequent_indent="# ") + "\n"


def toml_value(value: Any) -> str:
    """Return a value as TOML writes it, "not set" for None."""
    if value is None:
        return "not set"
    if isinstance(value, list | tuple):
        return f"[{', '.join(toml_value(item) for item in value)}]"
    return tomli_w.dumps({"x": value}).removeprefix("x = ").rstrip("\n")


def allowed(schema: Mapping[str, Any]) -> str:
    """Return the range or the choices of a parameter from its JSON schema, "" if anything goes."""
    choices = [option for option in schema.get("anyOf", [schema]) if option.get("type") != "null"]
    (option, *others) = choices
    if others:
        return ""
    if "enum" in option:
        return ", ".join(toml_value(choice) for choice in option["enum"])
    words = {
        "exclusiveMinimum": "above",
        "minimum": "at least",
        "exclusiveMaximum": "below",
        "maximum": "at most",
    }
    return ", ".join(f"{word} {option[key]:g}" for key, word in words.items() if key in option)
