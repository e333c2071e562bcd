"""C3D files of all processors, whole and damaged, without any library."""

from __future__ import annotations

import random
import struct

import numpy as np
import pytest

from hiros_cli.app import run
from hiros_mcap.errors import ConfigError
from hiros_mcap.io.joints.marker_files import read_c3d

POINTS = np.arange(48.0).reshape(8, 2, 3) * 16
"""mm, which also 16 bits hold; A is not seen at last."""
POINTS[-1, 0] = np.nan
ORDER = {84: "<", 85: "<", 86: ">"}
"""Of Intel's, DEC's and SGI's processors."""


def real(values, processor):
    """The bytes of floats; DEC's have the higher word first, and an exponent that is 2 more."""
    data = (np.ravel(values) * (4 if processor == 85 else 1)).astype(f"{ORDER[processor]}f4")
    return (data.view("<u2").reshape(-1, 2)[:, ::-1] if processor == 85 else data).tobytes()


def record(group, name, processor, values=None):
    """A group, or a parameter of texts, floats or a whole number."""
    order, data = ORDER[processor], b"\0"
    if isinstance(values, list):
        width = max(map(len, values), default=4)
        text = "".join(value.ljust(width) for value in values)
        data = struct.pack("bBBB", -1, 2, width, len(values)) + text.encode() + b"\0"
    elif isinstance(values, float):
        data = b"\4\0" + real(values, processor) + b"\0"
    elif values is not None:
        data = b"\2\0" + struct.pack(f"{order}H", values) + b"\0"
    head = struct.pack("bb", len(name), group) + name.encode()
    return head + struct.pack(f"{order}h", 2 + len(data)) + data


def c3d(path, points=POINTS, processor=84, scale=-1.0, header=None, frames=None, **parameters):
    """Write points with an analog sample per frame; ``header`` and ``frames`` count what is not."""
    order, (n, m, _) = ORDER[processor], points.shape
    point = {"USED": m, "SCALE": scale, "FRAMES": n if frames is None else frames, "RATE": 100.0}
    point |= {"LABELS": ["A", "B"][:m], "UNITS": ["mm"]} | parameters
    records = [record(-1, "POINT", processor), record(-2, "ANALOG", processor)]
    records += [record(1, name, processor, values) for name, values in point.items()]
    block = b"\1P\1" + bytes([processor]) + b"".join([*records, record(2, "USED", processor, 1)])
    residuals = np.where(np.isnan(points[..., :1]), -1.0, 0.0)
    words = np.nan_to_num(np.concatenate([points, residuals], axis=2)).reshape(n, 4 * m)
    words = np.insert(words, 4 * m, 7.0, axis=1)
    last = n if header is None else header
    head = struct.pack(f"{order}4HHfHH", m, 1, 1, last, 0, scale, 3, 1)
    data = real(words, processor) if scale < 0 else (words / scale).astype(f"{order}i2").tobytes()
    blocks = [b"\2P" + head, block, data]
    path.write_bytes(b"".join(part + bytes(-len(part) % 512) for part in blocks))
    return path


@pytest.mark.parametrize("processor", ORDER)
@pytest.mark.parametrize("scale", [-1.0, 0.5])
def test_files_of_all_processors_are_read(processor, scale, tmp_path):
    markers = read_c3d(c3d(tmp_path / "a.c3d", processor=processor, scale=scale))
    assert markers.names == ["A", "B"]
    assert markers.times[-1] == pytest.approx(0.07)
    np.testing.assert_allclose(markers.positions[:, 0], POINTS / 1000)


@pytest.mark.parametrize("wrong", [0, 5, 340, 32767, 65535])
@pytest.mark.parametrize("where", ["header", "frames"])
def test_the_number_of_frames_that_agrees_with_the_size_is_right(where, wrong, tmp_path):
    points = np.tile(POINTS, (40, 1, 1))
    markers = read_c3d(c3d(tmp_path / "a.c3d", points, **{where: wrong}))
    np.testing.assert_allclose(markers.positions[:, 0], points / 1000)


def test_numbers_of_frames_that_all_disagree_with_the_size_are_refused(tmp_path):
    points = np.tile(POINTS, (40, 1, 1))
    with pytest.raises(ConfigError, match="is cut off: it has 3.. of 400 frames"):
        read_c3d(c3d(tmp_path / "a.c3d", points, header=5, frames=400))
    with pytest.raises(ConfigError, match="its 7 frames of 2 points are too few or too short"):
        read_c3d(c3d(tmp_path / "a.c3d", points, header=5, frames=7))
    markers = read_c3d(c3d(tmp_path / "a.c3d", points, header=5, frames=5))
    assert (len(markers.times), markers.doubt[:15]) == (5, "counts 5 frames")


@pytest.mark.parametrize("used", [1, 3, 200])
def test_a_number_of_points_that_the_header_does_not_have_is_refused(used, tmp_path):
    with pytest.raises(ConfigError, match="header and parameters count other points or analog"):
        read_c3d(c3d(tmp_path / "a.c3d", USED=used))


def test_a_file_without_points_says_what_it_holds_instead(tmp_path, capsys):
    path = c3d(tmp_path / "plates.c3d", POINTS[:, :0])
    assert run(["import", str(path), "-o", str(tmp_path / "a.mcap"), "-q"]) == 2
    assert "plates.c3d: has no markers, only analog data" in capsys.readouterr().err
    assert not (tmp_path / "a.mcap").exists()


@pytest.mark.parametrize("processor", ORDER)
def test_damaged_parameters_are_right_or_one_error(processor, tmp_path):
    path, chance = c3d(tmp_path / "a.c3d", processor=processor), random.Random(processor)
    whole = path.read_bytes()
    for _ in range(150):
        data = bytearray(whole)
        for _ in range(chance.choice([1, 2, 4])):
            data[chance.randrange(700)] = chance.choice([0, 1, 127, 128, 255])
        path.write_bytes(data[: chance.choice([len(data), chance.randrange(len(data))])])
        try:
            assert read_c3d(path).positions.shape[0] <= 8 + 512 // 18
        except ConfigError as error:
            assert str(path) in str(error)


def test_texts_without_letters_take_no_memory(tmp_path):
    path = c3d(tmp_path / "a.c3d", ANGLES=["none"])
    many = path.read_bytes().replace(b"\xff\2\4\1none", b"\xff\7\0\xff\xff\xff\xff\xff")
    path.write_bytes(many)
    assert read_c3d(path).names == ["A", "B"]


BODIES = [f"{body}:Marker{k}" for body in ("ArmL", "SWL") for k in (1, 2)]
ANNA, BEN = ([f"{who}:{name}" for name in ("HEAD", "C7")] for who in ("Anna", "Ben"))


@pytest.mark.parametrize(
    ("labels", "people", "names", "said"),
    [
        (
            BODIES,
            ["0"],
            ["ArmL_Marker1", "ArmL_Marker2", "SWL_Marker1", "SWL_Marker2"],
            "one person",
        ),
        (
            [*BODIES[:2], *ANNA],
            ["Anna"],
            ["ArmL_Marker1", "ArmL_Marker2", "HEAD", "C7"],
            "one person",
        ),
        ([*ANNA, *BEN, "Sync:Sync"], ["Anna", "Ben"], ["HEAD", "C7"], "bodies Sync are left out"),
        ([*ANNA, *BEN], ["Anna", "Ben"], ["HEAD", "C7"], ""),
        (["Anna:HEAD", "Ben:HEAD"], ["Anna", "Ben"], ["HEAD"], ""),
    ],
)
def test_rigid_bodies_are_no_people(labels, people, names, said, tmp_path):
    points = np.arange(24.0 * len(labels)).reshape(8, -1, 3)
    markers = read_c3d(c3d(tmp_path / "a.c3d", points, LABELS=labels))
    assert ([*markers.people], markers.names) == (people, names)
    assert said in markers.doubt and bool(said) == bool(markers.doubt)
    np.testing.assert_allclose(markers.positions[:, 0, 0], points[:, 0] / 1000)
