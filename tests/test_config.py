"""Layers of parameters, what is refused, and TOML that reads back."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest
from pydantic import Field
from pydantic.fields import FieldInfo
from stick_figures import MODEL

import hiros_mcap
from hiros_mcap.config import PRESETS, Config, load_config, settable, to_toml
from hiros_mcap.defaults import default_system
from hiros_mcap.errors import ConfigError
from hiros_mcap.params import Params, advanced
from hiros_mcap.running.process_options import ProcessOptions
from hiros_mcap.systems import SYSTEMS, Run, sections_of, system


@pytest.mark.parametrize("preset", PRESETS)
def test_every_preset_is_valid_and_reads_back(preset, tmp_path):
    config = load_config(preset=preset, system="hiros")
    path = tmp_path / "hiros.toml"
    path.write_text(to_toml(config))
    assert load_config(path, preset=preset, system="hiros") == config


def test_every_parameter_is_printed_with_its_documentation():
    text = to_toml(Config())
    printed = tomllib.loads(text)
    for section in Config.model_fields:
        params = getattr(Config(), section)
        assert set(printed.get(section, ())) == set(type(params).model_fields)
        users = tomllib.loads(to_toml(Config(), [section], fixed=False)).get(section, ())
        assert [*users] == settable(params)
        for name, field in type(params).model_fields.items():
            assert field.description, f"{section}.{name} has no description"
            # What it cites, a user must be able to look up: a paper's section, an equation.
            assert not re.search(r"\b[A-Z]\d{2}\b|the peer", field.description), field.description


def test_times_noises_and_rates_have_finite_bounds():
    """Squared and summed, a number without a bound is infinite, and a run ends in the middle."""
    bounded = set()
    for section in Config.model_fields:
        params = getattr(Config(), section)
        schemas = params.model_json_schema().get("properties", {})
        for name, schema in ((name, schemas[name]) for name in settable(params)):
            words = f"{name} {schema['description']}"
            of_them = re.search(r"noise|, (s|Hz|m/s2?|m2/s3)[:;., ]|\bSD\b|deviation of", words)
            if schema.get("type") == "number" and of_them and "weight" not in name:
                bounded.add(f"{section}.{name}")
                has_both = {"minimum", "exclusiveMinimum"} & schema.keys() and "maximum" in schema
                assert has_both, f"{section}.{name}"
    assert len(bounded) > 20


@pytest.mark.parametrize(
    "assignment", ["fuse.acceleration=1e9", "fuse.offset=1e9", "filter.cutoff=1e-12"]
)
def test_numbers_beyond_physics_are_one_line(assignment):
    name = assignment.partition("=")[0]
    with pytest.raises(ConfigError, match=f"^--set: {name}.*: should be (less|greater) than"):
        load_config(overrides=[assignment])


class Reads:
    """A configuration that notes which sections are read."""

    def __init__(self, config):
        self.config, self.sections = config, set[str]()

    def __getattr__(self, name):
        self.sections.add(name)
        return getattr(self.config, name)


@pytest.mark.parametrize("name", SYSTEMS)
def test_a_system_states_the_sections_that_it_reads(name):
    reads = Reads(load_config(system=name))
    stages = system(name).stages(Run(MODEL, config=cast(Config, reads)))
    left_out = {"predict"} if len(stages) > len(system(name).chains[-1]) else set()  # of lee
    assert reads.sections - left_out == {*system(name).sections}
    assert sections_of(name) == ("input", "clock", "output", *system(name).sections)


class _Section(Params):
    common: int = Field(1, description="For users.")
    rare: int = advanced(2, description="For experts.")


@pytest.mark.parametrize(
    ("values", "everything", "printed"),
    [
        ({}, False, {"common": 1}),
        ({}, True, {"common": 1, "rare": 2}),
        ({"rare": 3}, False, {"common": 1, "rare": 3}),
        ({"rare": 2}, False, {"common": 1}),
    ],
)
def test_advanced_parameters_are_printed_if_asked_for_or_changed(
    values, everything, printed, monkeypatch
):
    fields = {"input": FieldInfo(annotation=_Section, description="A section.")}
    monkeypatch.setattr(Config, "__pydantic_fields__", fields)
    config = SimpleNamespace(input=_Section(**values))
    text = to_toml(cast(Config, config), ["input"], everything=everything)
    assert tomllib.loads(text) == {"input": printed}
    assert ("1 advanced parameters" in text) == (len(printed) == 1)


@pytest.mark.parametrize("name", SYSTEMS)
def test_what_config_prints_gives_the_same_configuration(name, tmp_path):
    config = load_config(overrides=["output.precision=full"], system=name)
    printed = to_toml(config, sections_of(name), everything=False, fixed=False)
    (tmp_path / "hiros.toml").write_text(printed)
    assert load_config(tmp_path / "hiros.toml", system=name) == config


def test_an_assignment_beats_the_file_and_the_file_beats_the_preset(tmp_path):
    path = tmp_path / "hiros.toml"
    path.write_text("[merge]\nmax_delta_time = 0.02\n[filter]\ncutoff = 7\n")
    config = load_config(path, ["filter.cutoff=8"], "paper", "hiros")
    assert config.merge.max_delta_time == 0.02
    assert config.filter.cutoff == 8.0


@pytest.mark.parametrize(
    ("assignment", "section", "name", "value"),
    [
        ("filter.order=3", "filter", "order", 3),
        ("filter.method=butterworth", "filter", "method", "butterworth"),
        ("filter.method='butterworth'", "filter", "method", "butterworth"),
        ("plausible.limbs=false", "plausible", "limbs", False),
        (" merge.carry = 0.5 ", "merge", "carry", 0.5),
        ("input.fixed_frame=lab/floor", "input", "fixed_frame", "lab/floor"),
        (
            "optimize.calibration_windows=[[1, 2], [3, 4]]",
            "optimize",
            "calibration_windows",
            ((1.0, 2.0), (3.0, 4.0)),
        ),
    ],
)
def test_assignments(assignment, section, name, value):
    assert getattr(getattr(load_config(overrides=[assignment]), section), name) == value


@pytest.mark.parametrize(
    ("assignment", "said"),
    [
        ("merge.max_delta_tim=1", "--set: no parameter merge.max_delta_tim; did you mean merge.ma"),
        ("marge.max_delta_time=1", "--set: no section 'marge'; did you mean merge? (there are: in"),
        (
            "filter.cutoff=-1",
            "--set: filter.cutoff: should be greater than or equal to 0.01, is -1",
        ),
        ("filter.cutoff=fast", "--set: filter.cutoff: should be a valid number, "),
        ("filter.method=x", "--set: filter.method: should be 'state_space' or 'butterworth', is"),
        ("filter.order=4", "--set: filter: order of a state-space filter must be 2 or 3"),
        ("cutoff=4", "--set: 'cutoff=4' is not of the form stage.param=value"),
        ("filter.cutoff", "--set: 'filter.cutoff' is not of the form stage.param=value"),
    ],
)
def test_a_wrong_assignment_says_what_would_be_right(assignment, said):
    with pytest.raises(ConfigError) as caught:
        load_config(overrides=[assignment])
    assert str(caught.value).startswith(said)


def test_a_parameter_that_is_not_for_users_may_be_repeated_but_not_changed(tmp_path):
    path = tmp_path / "hiros.toml"
    path.write_text("track.fade = 0.3\n")
    assert load_config(path) == Config()
    path.write_text("track.fade = 0.5\n")
    message = "only the system and the preset set track.fade, here 0.3; leave it out"
    for origin, file, overrides in ((path, path, []), ("--set", None, ["track.fade=0.5"])):
        with pytest.raises(ConfigError) as caught:
            load_config(file, overrides)
        assert str(caught.value) == f"{origin}: {message}"


def test_what_a_preset_sets_may_be_repeated_with_it_only(tmp_path):
    config = load_config(preset="paper", system="hiros")
    path = tmp_path / "hiros.toml"
    path.write_text(to_toml(config))
    assert load_config(path, preset="paper", system="hiros") == config
    with pytest.raises(ConfigError, match="only the system and the preset set"):
        load_config(path, system="hiros")


def test_the_account_of_a_run_gives_its_configuration_again():
    config = load_config(preset="paper", system="hiros")
    stored = tomllib.loads(to_toml(config))
    assert load_config(system="hiros", named={"out.mcap": stored}) == config


def test_every_table_of_values_is_of_a_preset_or_a_system():
    named = {path.stem for path in (Path(hiros_mcap.__file__).parent / "systems/presets").iterdir()}
    assert named - {"as_published"} <= {*PRESETS, *SYSTEMS}


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"[filter]\ncutof = 4\n", "no parameter filter.cutof; did you mean filter.cutoff?"),
        (b"[filter]\ncutoff = 0\n", "filter.cutoff: should be greater than or equal to 0.01, is 0"),
        (b"filter = 4\n", "filter is a section, not a value"),
        (b"[filter\n", "not TOML: "),
        (b"\xff", "not text: "),
        (b"a = " + b"[" * 100_000, "not TOML: "),
        (b"#" * (1 << 25), "is larger than 16 MiB"),
    ],
)
def test_a_wrong_file_is_named_with_its_fault(content, said, tmp_path):
    path = tmp_path / "hiros.toml"
    path.write_bytes(content)
    with pytest.raises(ConfigError) as caught:
        load_config(path)
    assert str(caught.value).startswith(f"{path}: {said}")


@pytest.mark.parametrize(
    ("preset", "live", "name"),
    [
        ("default", False, "fuse"),
        ("default", True, "fuse-realtime"),
        ("paper", False, "hiros"),
        ("paper", True, "hiros-realtime"),
    ],
)
def test_what_runs_if_no_system_is_named(preset, live, name):
    assert default_system(preset, live=live) == name
    load_config(preset=preset, system=name)
    assert ProcessOptions().system == default_system()


@pytest.mark.parametrize("name", ["fuse", "fuse-realtime"])
@pytest.mark.parametrize("preset", [name for name in PRESETS if name != "default"])
def test_a_preset_of_hiros_is_refused_where_it_means_nothing(preset, name):
    with pytest.raises(ConfigError, match=f"preset {preset} is of hiros and means nothing to"):
        load_config(preset=preset, system=name)


def test_an_unknown_preset_lists_the_known_ones():
    with pytest.raises(ConfigError, match=r"did you mean paper\? .there are: default, realtime"):
        load_config(preset="papr")


def test_a_changed_parameter_shows_its_default_too():
    text = to_toml(load_config(overrides=["filter.cutoff=8"]))
    assert "# Default: 4.5.\ncutoff = 8.0\n" in text


def test_the_table_of_clocks_has_a_camera_of_any_name(tmp_path):
    path = tmp_path / "hiros.toml"
    path.write_text('[clock]\n"camera_1" = -1.5\n"/kinect.2/skeletons" = 2\n')
    config = load_config(path, ["clock.camera_3=0.1"])
    seconds = {"camera_1": -1.5, "/kinect.2/skeletons": 2.0, "camera_3": 0.1}
    assert config.clock.seconds == seconds
    path.write_text(to_toml(config, everything=False))
    assert load_config(path) == config


@pytest.mark.parametrize("value", ["nan", "inf", "'soon'"])
def test_a_correction_of_a_clock_is_a_number(value):
    with pytest.raises(ConfigError, match="camera_1"):
        load_config(overrides=[f"clock.camera_1={value}"])
