"""The parameters of all stages together: presets, a TOML file, single assignments.

Later layers win: defaults < system < preset < file < ``stage.param=value``. Only names that exist
are accepted, and an error names the layer, the parameter and what would have been right.
"""

from __future__ import annotations

import difflib
import math
import textwrap
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import tomli_w
from pydantic import ConfigDict, Field, ValidationError, model_validator

from hiros_mcap._version import __version__
from hiros_mcap.defaults import DEFAULT_SYSTEM, NO_PRESET, takes_presets
from hiros_mcap.errors import ConfigError
from hiros_mcap.outside import parse, read_toml
from hiros_mcap.params import Params, advanced, explain, is_advanced
from hiros_mcap.stages.associate_params import AssociateParams
from hiros_mcap.stages.cluster_params import ClusterParams
from hiros_mcap.stages.constrain_params import ConstrainParams
from hiros_mcap.stages.filter_params import FilterParams
from hiros_mcap.stages.fuse_params import FuseParams
from hiros_mcap.stages.kalman_params import KalmanParams
from hiros_mcap.stages.merge_params import MergeParams
from hiros_mcap.stages.moving_average_params import MovingAverageParams
from hiros_mcap.stages.optimize_params import OptimizeParams
from hiros_mcap.stages.plausible_params import PlausibleParams
from hiros_mcap.stages.predict_params import PredictParams
from hiros_mcap.stages.sides_params import SidesParams
from hiros_mcap.stages.straighten_params import StraightenParams
from hiros_mcap.stages.track_params import TrackParams

Table = dict[str, dict[str, Any]]
"""Values by section and parameter."""

WIDTH = 80


class InputParams(Params):
    """What is read, and in which frame the results are."""

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
    unit: Literal["m", "cm", "mm"] = Field("m", description="Unit of the log's positions.")

    clocks: Literal["lookahead", "causal", "off"] = Field(
        "lookahead",
        description="How the cameras' clocks are judged. lookahead: by the whole log and by the "
        "people in it. causal: each message by those before it, as a live system has to. off: "
        "stamps are taken as they are.",
    )
    poses: Literal["refined", "given"] = advanced(
        "refined",
        description="The cameras' poses. refined: compared with the people before the run, better "
        "ones are used (--calibrate). given: those of the log or of --extrinsics, as published "
        "methods take them.",
    )


_MOST_S = 4e9
"""No correction of a clock is larger: the stamps of messages span 137 years."""


class ClockParams(Params):
    """What is added to the stamps of cameras, by camera."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[
        str, Annotated[float, Field(allow_inf_nan=False, ge=-_MOST_S, le=_MOST_S)]
    ]

    @property
    def seconds(self) -> dict[str, float]:
        """Camera -> s to add to its stamps."""
        return dict(self.__pydantic_extra__)


Factor = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class NoiseParams(Params):
    """White noise of the detectors, as ``hiros calibrate noise`` writes it; what is given counts.

    sigma, power, guessed and the tables joints and cameras; see
    :class:`hiros_mcap.calibrate.noise.NoiseModel`.
    """

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, Factor | dict[str, Factor]]

    @model_validator(mode="after")
    def _known(self) -> Self:
        for name, value in self.__pydantic_extra__.items():
            if name not in (*_NOISE_NUMBERS, *_NOISE_TABLES):
                raise ValueError(f"{name}: there is no such key")
            if isinstance(value, dict) != (name in _NOISE_TABLES):
                raise ValueError(f"{name} should be a {_NOISE_KINDS[name in _NOISE_TABLES]}")
        return self

    @property
    def numbers(self) -> dict[str, float]:
        """Those of sigma (m), power and guessed that are given."""
        return {k: v for k, v in self.__pydantic_extra__.items() if isinstance(v, float)}

    def table(self, name: str) -> dict[str, float]:
        """Joint -> factor of the deviation ("joints"), or camera -> of the variance ("cameras")."""
        found = self.__pydantic_extra__.get(name, {})
        return found if isinstance(found, dict) else {}


_NOISE_NUMBERS, _NOISE_TABLES = ("sigma", "power", "guessed"), ("joints", "cameras")
_NOISE_KINDS = "number", "table"


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


class Config(Params):
    """Every parameter of a run, one section per step."""

    input: InputParams = Field(InputParams(), description="Reading the cameras.")
    clock: ClockParams = Field(
        ClockParams(), description="Seconds to add to the stamps of a camera: camera = seconds."
    )
    noise: NoiseParams = Field(
        NoiseParams(), description="White noise of the detectors, by hiros calibrate noise."
    )
    output: OutputParams = Field(OutputParams(), description="Writing the results.")
    track: TrackParams = Field(TrackParams(), description="Tracking (Hi-ROS 3.1).")
    plausible: PlausibleParams = Field(
        PlausibleParams(), description="Detections against the person's own limbs, before merging."
    )
    sides: SidesParams = Field(
        SidesParams(), description="Left and right of each view, before merging."
    )
    merge: MergeParams = Field(
        MergeParams(), description="Merging: one skeleton per person (Hi-ROS 3.2)."
    )
    optimize: OptimizeParams = Field(
        OptimizeParams(), description="Optimizing: constant limb lengths (Hi-ROS 3.3)."
    )
    filter: FilterParams = Field(
        FilterParams(), description="Filtering: smooth motion (Hi-ROS 3.4)."
    )
    fuse: FuseParams = Field(
        FuseParams(), description="Fusing in fuse: one smooth trajectory per joint."
    )
    constrain: ConstrainParams = Field(
        ConstrainParams(), description="Constant lengths and the person's own motion in fuse."
    )
    associate: AssociateParams = Field(
        AssociateParams(), description="Tracking in malaguti and the baselines (Malaguti III-A)."
    )
    kalman: KalmanParams = Field(
        KalmanParams(), description="Fusion in malaguti and openptrack (Malaguti III-B to III-D)."
    )
    straighten: StraightenParams = Field(
        StraightenParams(), description="Constant limb lengths in malaguti (Malaguti III-E)."
    )
    moving_average: MovingAverageParams = Field(
        MovingAverageParams(), description="Moving average in the baseline maf."
    )
    cluster: ClusterParams = Field(
        ClusterParams(), description="Merging in lee: one skeleton per person (Lee 2.2)."
    )
    predict: PredictParams = Field(
        PredictParams(), description="Filtering in lee: smooth motion (Lee 2.2.3)."
    )


# People around occlusions: nothing of it is in a paper.
_AS_PUBLISHED: dict[str, Any] = {
    "reidentify": 0.0,
    "max_jump": math.inf,
    "fade": 0.0,
    "gate_growth": 0.0,
    "merge_tracks": False,
    "confirm_alone": 0.5,
}

_PAPER: Table = {
    "input": {"poses": "given"},
    # A detection that no track takes is a person at once; nothing waits for later frames.
    "track": {
        "orientation_weight": 1.0,
        "flip_aware": False,
        **_AS_PUBLISHED,
        "confirm_detections": 1,
        "confirm_seconds": 0.0,
        "confirm_alone": 0.0,
        "contradiction": math.inf,
        "lookahead": 0.0,
        "reorder": 0.1,
    },
    "plausible": {"limbs": False},
    "sides": {"over_time": False},
    # Equation 12 as printed, on the views as they are; turned-round views are dropped.
    "merge": {
        "facing": "pelvis",
        "flips": "drop",
        "past_votes": False,
        "compensate_motion": False,
        "confidence_power": 1.0,
        "robust_scale": 0.0,
        "offset_time": 0.0,
        "bridge": 0.0,
        "carry": 0.0,
    },
    "optimize": {
        "lookahead": 0.0,
        "max_free": 0.0,
        "debias": False,
        "refine": False,
        "lengths": "paper",
        "max_length_error": 0.1,
        "outliers": "remove",
        "align_links": True,
    },
    # Causal, at the low end of the 6 to 10 Hz that section 3.4 names.
    "filter": {"cutoff": 6.0, "lookahead": 0.0, "bridge": 0.0, "keep_lengths": False},
}

PRESETS: Mapping[str, Table] = {
    "default": {},
    "realtime": {
        "input": {"clocks": "causal"},
        "track": {"lookahead": 0.0, "reorder": 0.1, "reidentify": 0.0},
        "sides": {"lookahead": 0.0},
        "optimize": {"lookahead": 0.0},
        "filter": {"lookahead": 0.0, "cutoff": 8.0},
    },
    "paper": _PAPER,
    "upstream": {
        **_PAPER,
        "track": {**_PAPER["track"], "max_distance": 0.8, "min_distance": 0.1, "max_gap": 0.5},
        "merge": {**_PAPER["merge"], "past_votes": True},
        "optimize": {**_PAPER["optimize"], "short_link": 0.0},
    },
}
"""Named changes to the defaults.

realtime: no stage waits for later frames. paper: what Hi-ROS 2023 prints, where it prints it.
upstream: the same with workable launch values of the published code; its defects are not rebuilt.
"""


SYSTEM_DEFAULTS: Mapping[str, Table] = {
    "hiros-realtime": PRESETS["realtime"],
    # 0.04 s of a usual camera, and 0.1 s in all.
    "fuse-realtime": {
        "input": {"clocks": "causal"},
        "track": {"lookahead": 0.0, "reorder": 0.002, "reidentify": 0.0},
        "sides": {"lookahead": 0.0},
        "fuse": {
            "lookahead": 0.1,
            "max_lag": 0.1,
            "window": 0.0,
            "freedom": 8.0,
            "follow_noise": True,
        },
        "constrain": {"window": 0.0, "enough": 5.0},
        "filter": {"lookahead": 0.0, "cutoff": 8.0},
    },
    # Numbers of the public code (OpenPTrack v2): variances 100 and 0.036.
    "openptrack": {
        "kalman": {
            "measurement_noise": 0.19,
            "process_noise": 10.0,
            "use_confidence": False,
            "min_confidence": 0.0,
            "history": 0,
            "range_noise": 0.0026,
            "max_gap": 8.0,
        },
        "associate": {"max_gap": 8.0},
    },
    "average": {
        "merge": {
            "flips": "drop",
            "max_facing_delta": 0.0,
            "max_position_delta": 0.0,
            "max_orientation_delta": 0.0,
            "confidence_power": 0.0,
            "robust_scale": 0.0,
            "offset_time": 0.0,
            "bridge": 0.0,
            "carry": 0.0,
            "past_votes": False,
            "compensate_motion": False,
        },
    },
    "lee": {"track": _AS_PUBLISHED},
    "lee-a1": {"track": _AS_PUBLISHED, "cluster": {"method": "average", "rearrange": "off"}},
    "lee-a2": {"track": _AS_PUBLISHED, "cluster": {"method": "average"}},
    "lee-a3": {"track": _AS_PUBLISHED, "cluster": {"previous_helps": False}},
    "lee-a4": {"track": _AS_PUBLISHED},
}
"""Systems that are another one with other parameters -> what they change."""


def presets_of(system: str) -> tuple[str, ...]:
    """Return the presets that a system takes: all change hiros and what shares its stages."""
    return tuple(PRESETS) if takes_presets(system) else (NO_PRESET,)


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

    Raises
    ------
    ConfigError
        A name does not exist, a value is out of range, or the file cannot be read.
    """
    if preset not in PRESETS:
        raise ConfigError(f"no preset {preset!r}{_instead(preset, PRESETS)}")
    if preset not in presets_of(system):
        raise ConfigError(
            f"preset {preset} is of hiros and means nothing to {system}; run the system hiros, or "
            f"fuse-realtime without a preset if nothing may wait for later frames"
        )
    layers = [(f"system {system}", SYSTEM_DEFAULTS.get(system, {}))]
    layers += [(f"preset {preset}", PRESETS[preset])]
    if path is not None:
        layers.append((str(path), read_toml(path)))
    layers += list((named or {}).items())
    layers += [("--set", _assignment(text)) for text in overrides]
    merged: Table = {}
    origins: dict[tuple[str, ...], str] = {}
    for origin, table in layers:
        _check_names(table, origin)
        for section, values in table.items():
            merged.setdefault(section, {}).update(values)
            origins[(section,)] = origin
            origins.update({(section, name): origin for name in values})
    try:
        return Config.model_validate(merged)
    except ValidationError as error:
        raise _explained(error, origins) from None


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


def _check_names(table: Mapping[str, Any], origin: str) -> None:
    for section, values in table.items():
        if section not in Config.model_fields:
            raise ConfigError(
                f"{origin}: no section {section!r}{_instead(section, Config.model_fields)}"
            )
        if not isinstance(values, Mapping):
            raise ConfigError(f"{origin}: {section} is a section, not a value")
        if _section(section).model_config.get("extra") == "allow":
            continue
        known = _section(section).model_fields
        for name in values:
            if name not in known:
                raise ConfigError(
                    f"{origin}: no parameter {section}.{name}{_instead(name, known, section)}"
                )


def _section(name: str) -> type[Params]:
    section = Config.model_fields[name].annotation
    if not (isinstance(section, type) and issubclass(section, Params)):
        raise TypeError(f"section {name} is not a Params class")
    return section


def _instead(name: str, known: Iterable[str], section: str = "") -> str:
    """Return what the user may have meant, and everything that there is."""
    names = list(known)
    prefix = f"{section}." if section else ""
    near = difflib.get_close_matches(name, names, n=1)
    guess = f"; did you mean {prefix}{near[0]}?" if near else ""
    return f"{guess} (there are: {', '.join(names)})"


def _explained(error: ValidationError, origins: Mapping[tuple[str, ...], str]) -> ConfigError:
    where, message = explain(error)
    origin = origins.get(tuple(where[:2]))
    key = ".".join(where)
    return ConfigError(": ".join([*([origin] if origin else []), key, message]))


def to_toml(
    config: Config, sections: Collection[str] = Config.model_fields, *, everything: bool = True
) -> str:
    """Return ``config`` as TOML that :func:`load_config` reads back, documented by comments.

    Parameters
    ----------
    sections : those to print, such as :func:`hiros_mcap.systems.sections_of` a system.
    everything : also print advanced parameters that have their default values.
    """
    blocks = [f"# hiros {__version__}: parameters with the values in effect.\n"]
    hidden = 0
    for section in (name for name in Config.model_fields if name in sections):
        params: Params = getattr(config, section)
        names = [
            name for name in type(params).model_fields if everything or _is_shown(params, name)
        ]
        hidden += len(type(params).model_fields) - len(names)
        if params.model_extra:
            title = f"# {Config.model_fields[section].description}\n"
            blocks.append(title + tomli_w.dumps({section: params.model_extra}))
        if names:
            schema = params.model_json_schema()["properties"]
            blocks.append(f"# {Config.model_fields[section].description}\n[{section}]\n")
            blocks += [_entry(params, name, schema[name]) for name in names]
    if hidden:
        blocks.append(f"# {hidden} advanced parameters have their defaults; --all shows them.\n")
    return "\n".join(blocks)


def _is_shown(params: Params, name: str) -> bool:
    """Whether users touch a parameter, or somebody changed it."""
    field = type(params).model_fields[name]
    default = field.get_default(call_default_factory=True)
    return not is_advanced(field) or getattr(params, name) != default


def _entry(params: Params, name: str, schema: Mapping[str, Any]) -> str:
    """One parameter: what it is, what is allowed, what it is by default, its value."""
    field = type(params).model_fields[name]
    value, default = getattr(params, name), field.get_default(call_default_factory=True)
    limits = allowed(schema)
    remarks = [" ".join((field.description or "").split())]
    if limits:
        remarks.append(f"Allowed: {limits}.")
    if value != default:
        remarks.append(f"Default: {toml_value(default)}.")
    comment = "\n".join(
        textwrap.fill(remark, WIDTH, initial_indent="# ", subsequent_indent="# ")
        for remark in remarks
    )
    line = f"# {name} is not set" if value is None else f"{name} = {toml_value(value)}"
    return f"{comment}\n{line}\n"


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
