"""Every reader of text from outside, and odd text for it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

from hypothesis import strategies as st

from hiros_mcap.body.foreign_cameras import read_calibration
from hiros_mcap.body.limb_table import LimbTable
from hiros_mcap.body.transforms import read_extrinsics
from hiros_mcap.config import load_config
from hiros_mcap.evaluate.truth_files import load_truth
from hiros_mcap.events import events_from_json
from hiros_mcap.io.export.files import load_marker_set
from hiros_mcap.io.foxglove import FoxgloveInput
from hiros_mcap.io.joints.importing import import_joints
from hiros_mcap.io.result import StoredReport
from hiros_mcap.regression.quantities import load_tolerances
from hiros_mcap.regression.suite import load_suite
from hiros_mcap.skeletons import SkeletonModel

MODEL = SkeletonModel.of(["HEAD"], [])


def imported(path):
    return import_joints([path], path.with_suffix(".mcap"))


def mapped(path):
    rows = path.with_name("a.csv")
    rows.write_text("time,joint,x,y,z\n0,HEAD,0,0,1\n0,FOOT_LEFT,0,0,0\n")
    return import_joints([rows], path.with_suffix(".mcap"), path)


def heard(path):
    source = FoxgloveInput("ws://127.0.0.1:1", lambda topic, kind: True)
    text = path.read_bytes().decode(errors="replace")

    class Connection:
        def send(self, answer):
            json.loads(answer)

    return list(source._advertised(Connection(), text))


def told(path):
    return events_from_json(path.read_bytes().decode())


def reported(path):
    return StoredReport.model_validate_json(path.read_bytes())


READERS: dict[str, tuple[str, Callable[[Path], object]]] = {
    "settings": ("toml", load_config),
    "limbs": ("toml", LimbTable.load),
    "mapping": ("toml", mapped),
    "marker set": ("toml", lambda path: load_marker_set(str(path), MODEL)),
    "tolerances": ("toml", load_tolerances),
    "suite": ("toml", load_suite),
    "poses in TOML": ("toml", read_extrinsics),
    "poses in JSON": ("json", read_extrinsics),
    "lenses in TOML": ("toml", read_calibration),
    "lenses in JSON": ("json", read_calibration),
    "lenses in YAML": ("yaml", read_calibration),
    "lenses in XML": ("xml", read_calibration),
    "joints in JSON": ("json", imported),
    "joints in CSV": ("csv", imported),
    "joints in TRC": ("trc", imported),
    "truth in CSV": ("csv", load_truth),
    "truth in TRC": ("trc", load_truth),
    "server": ("json", heard),
    "events": ("json", told),
    "report": ("json", reported),
}
WORDS_OF_OTHERS = {"server", "events", "report"}
"""Text that is no file: their callers say where it is from."""

_WORDS = st.sampled_from(
    ["time", "start", "offset", "rate", "unit", "column", "axes", "joints", "people", "frames",
     "person", "files", "id", "x", "y", "z", "HEAD", "input", "track", "max_gap", "camera",
     "frame", "parent", "translation", "quaternion_xyzw", "0", "length", "palm", "log", "name",
     "op", "channels", "topic", "schema", "schemaName", "encoding", "stamp", "kind", "warnings",
     "cameras", "metrics", "provenance", "advertise", "1970-01-01", "m", "mm"]
)  # fmt: skip
_NUMBERS = st.one_of(
    st.integers(-3, 3),
    st.integers(),
    st.floats(),
    st.sampled_from([10**30, -(10**400), 1e300, 5e-324, 4e9, 2**63, 2**64]),
)
_LEAVES = st.one_of(st.none(), st.booleans(), _NUMBERS, _WORDS, st.text(max_size=4))
_TREES = st.recursive(
    _LEAVES,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(_WORDS, inner, max_size=5),
    max_leaves=12,
)
_JOINTS = st.dictionaries(_WORDS, st.lists(_NUMBERS, min_size=2, max_size=5), max_size=3)
_PEOPLE = st.lists(st.fixed_dictionaries({"joints": _JOINTS | _LEAVES}), max_size=3)
_FRAMES = st.lists(
    st.fixed_dictionaries({"time": _NUMBERS, "people": _PEOPLE | _LEAVES}) | _LEAVES, max_size=4
)
_CHANNEL = st.fixed_dictionaries(
    dict.fromkeys(("id", "topic", "encoding", "schemaName", "schema"), _LEAVES)
)
_ADVERTISED = st.fixed_dictionaries({"op": st.just("advertise"), "channels": st.lists(_CHANNEL)})


def _toml(value):
    match value:
        case dict():
            return "{" + ", ".join(f"{_toml(k)} = {_toml(v)}" for k, v in value.items()) + "}"
        case list():
            return "[" + ", ".join(map(_toml, value)) + "]"
        case None:
            return "2026-01-01T00:00:00"
        case str():
            return json.dumps(value)
    return json.dumps(value).replace("NaN", "nan").replace("Infinity", "inf")


def _table(tree):
    rows = tree.items() if isinstance(tree, dict) else [("a", tree)]
    return "\n".join(f"{_toml(key)} = {_toml(value)}" for key, value in rows)


def _cells(separator):
    rows = st.lists(st.lists(_NUMBERS.map(str) | _WORDS, min_size=1, max_size=8), max_size=6)
    return rows.map(lambda found: "\n".join(map(separator.join, found)))


_CSV_HEADS = st.sampled_from(
    [
        "time,person,joint,x,y,z\n",
        "time,HEAD_x,HEAD_y,HEAD_z\n",
        "time,marker,x,y,z\n",
        "",
        "Trajectories\n100\n,,P:HEAD,,,P:FOOT\nFrame,Sub Frame,X,Y,Z,X,Y,Z\n,,mm,mm,mm,mm,mm,mm\n",
    ]
)
_TRC_HEADS = st.sampled_from(
    ["PathFileType\nUnits\tNumFrames\nm\t2\nFrame#\tTime\tHEAD\t\t\tFOOT\n\n", "PathFileType\n"]
)
_LENS = {
    **{"image_width": _NUMBERS, "image_height": _NUMBERS, "distortion_model": _LEAVES},
    **dict.fromkeys(("camera_matrix", "distortion_coefficients"), _TREES),
    **dict.fromkeys(("matrix", "size", "distortions", "rotation", "translation"), _TREES),
}
_LENSES = st.fixed_dictionaries({}, optional=_LENS)
_QUALISYS = st.dictionaries(
    st.sampled_from(
        ["focalLengthU", "centerPointU", "sensorMaxU", "viewrotation", "serial", "r11"]
    ),
    _NUMBERS.map(str),
).map(lambda values: " ".join(f'{key}="{value}"' for key, value in values.items()))
_KINDS: dict[str, st.SearchStrategy[str]] = {
    "yaml": (_TREES | _LENSES).map(json.dumps),
    "xml": _QUALISYS.map(
        lambda values: (
            f"<calibration><cameras><camera {values}><intrinsic {values}/><transform "
            f"{values}/></camera></cameras></calibration>"
        )
    ),
    "toml": (_TREES | st.dictionaries(_WORDS, _LENSES)).map(_table),
    "json": (_TREES | _FRAMES | _ADVERTISED | st.dictionaries(_WORDS, _LENSES)).map(json.dumps),
    "csv": st.tuples(_CSV_HEADS, _cells(",")).map("".join),
    "trc": st.tuples(_TRC_HEADS, _cells("\t")).map("".join),
}


@st.composite
def odd_text(draw, kind):
    """Text of a kind with something odd in it: its values, its depth, its end, its bytes."""
    data = draw(_KINDS[kind]).encode(errors="surrogatepass")
    match draw(st.sampled_from(["as it is", "cut", "byte", "deep"])):
        case "cut":
            return data[: draw(st.integers(0, len(data)))]
        case "byte":
            at = draw(st.integers(0, len(data)))
            return data[:at] + draw(st.binary(min_size=1, max_size=3)) + data[at:]
        case "deep":
            opening = draw(st.sampled_from([b"[", b'{"a":', b"a = [", b"{a="]))
            return opening + b"[" * draw(st.sampled_from([70, 100_000])) + data
    return data
