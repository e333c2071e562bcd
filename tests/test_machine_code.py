"""Kernels as Python calls them: what they take, and their files."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import hiros_mcap
from hiros_mcap import kernels
from hiros_mcap.errors import HirosError
from hiros_mcap.kernels import cache_folder, folder_of, shipped
from hiros_mcap.kernels.array_types import F1
from hiros_mcap.kernels.bytes import load32
from hiros_mcap.kernels.compile import EntryKernel, entry, kernel
from hiros_mcap.kernels.machine_code import MachineCode, load, read, write
from hiros_mcap.kernels.record_index import _walk


def number(numbers: F1, first: int) -> float:
    if first >= len(numbers):
        raise ValueError("there is none")
    return numbers[first]


@kernel
def successor(numbers, k):
    return numbers[k] + 1.0


def successors(numbers: F1) -> float:
    return successor(numbers, 0) + successor(numbers, 1) + successor(numbers, len(numbers) - 1)


@pytest.fixture(scope="module")
def compiled(tmp_path_factory):
    """A kernel that was compiled now, by this machine."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("NUMBA_CACHE_DIR", str(tmp_path_factory.mktemp("kernels")))
        patch.setenv("HIROS_KERNELS", "compile")
        shipped.usable.cache_clear()
        yield entry(number)
    shipped.usable.cache_clear()


def file_of(kernel):
    (path,) = folder_of(kernel.function.__module__).iterdir()
    return path


def test_a_kernel_takes_what_its_annotations_name(compiled):
    numbers = np.array([3.0, 1.0, 2.0])
    assert compiled(numbers, 0) == 3.0
    assert compiled(numbers, np.int64(1)) == 1.0
    for wrong in (numbers.astype(np.float32), numbers[::2], numbers[:, None], [3.0]):
        with pytest.raises(TypeError, match="number takes"):
            compiled(wrong, 0)
    for few in ((numbers,), (numbers, 0.5), (numbers, 0, 0)):
        with pytest.raises(TypeError, match="number takes"):
            compiled(*few)


def test_an_array_that_a_kernel_writes_into_must_be_writable():
    data, table = np.frombuffer(b"", np.uint8), np.zeros((1, 6), np.uint64)
    assert _walk(data, table, table)[0] == 0
    table.flags.writeable = False
    with pytest.raises(TypeError, match="_walk takes"):
        _walk(data, table, table)


def test_an_error_in_a_kernel_is_one_in_python(compiled):
    for call in (compiled, compiled.raw):
        with pytest.raises(ValueError, match="there is none"):
            call(np.zeros(2), 2)


def test_what_was_compiled_is_read_again(compiled, monkeypatch):
    monkeypatch.setattr(EntryKernel, "_compile", lambda _: pytest.fail("compiled twice"))
    assert entry(number)(np.array([5.0]), 0) == 5.0


@pytest.mark.parametrize("damage", [b"", b"[", b"[1, 2]\n", b"cut"])
def test_a_damaged_file_is_compiled_again(damage, compiled, monkeypatch):
    path = file_of(compiled)
    whole, code = path.read_bytes(), read(path, path.name)
    path.write_bytes(whole[:-1] if damage == b"cut" else damage)
    again = []
    monkeypatch.setattr(EntryKernel, "_compile", lambda *_: again.append(1) or code)
    assert entry(number)(np.array([5.0]), 0) == 5.0
    assert again == [1]
    assert path.read_bytes() == whole


FLIP = """
import random, sys
from pathlib import Path
from hiros_mcap.kernels.machine_code import read
path = Path(sys.argv[1])
whole, draw = path.read_bytes(), random.Random(515)
for head in [True] * 150 + [False] * 50:
    bit = draw.randrange(8 * (32 + whole[32:].index(b"\\n") if head else len(whole)))
    damaged = bytearray(whole)
    damaged[bit // 8] ^= 1 << bit % 8
    path.write_bytes(damaged)
    assert read(path, path.name) is None, bit
path.write_bytes(whole)
assert read(path, path.name) is not None
"""


def test_no_flipped_bit_of_a_file_is_loaded(compiled):
    subprocess.run([sys.executable, "-c", FLIP, file_of(compiled)], check=True)


def test_a_kernel_under_the_name_of_another_is_not_loaded(compiled):
    path = file_of(compiled)
    assert read(path, f"{path.name}s") is None


@pytest.mark.parametrize("part", ["function", "environment"])
def test_a_name_that_the_code_does_not_have_is_an_error(part, compiled):
    path = file_of(compiled)
    code = read(path, path.name)
    renamed = code._replace(**{part: f"{getattr(code, part)}x"})
    with pytest.raises(HirosError, match="number has no such function"):
        load(renamed, number)


@pytest.mark.parametrize("mode", [0o775, 0o757])
def test_code_in_a_folder_that_others_may_write_is_not_loaded(mode, compiled, monkeypatch):
    folder = cache_folder()
    code = read(file_of(compiled), file_of(compiled).name)
    again = []
    monkeypatch.setattr(EntryKernel, "_compile", lambda *_: again.append(1) or code)
    for place in (folder, folder_of(number.__module__)):
        place.chmod(mode)
        kernels.is_private.cache_clear()
        entry(number)
        place.chmod(0o755)
    kernels.is_private.cache_clear()
    assert again == [1, 1]


def test_what_an_installation_brings_damaged_is_an_error(compiled, tmp_path, monkeypatch):
    monkeypatch.setattr(shipped, "usable", lambda: True)
    monkeypatch.setattr(shipped, "FOLDER", tmp_path)
    with pytest.raises(HirosError, match=r"number is damaged; install hiros-mcap again"):
        entry(number)


def test_a_file_holds_what_was_written(tmp_path):
    code, folder = MachineCode("k", "f", "e", b"a\nb\x00"), tmp_path / "new"
    write(folder / "k", code)
    assert read(folder / "k", "k") == code
    assert read(folder / "none", "k") is None
    assert [path.name for path in folder.iterdir()] == ["k"]
    assert folder.stat().st_mode & 0o022 == 0


@pytest.mark.usefixtures("compiled")
def test_a_kernel_is_compiled_once_for_all_numbers_that_it_is_called_with():
    from numba.core import event

    with event.install_recorder("numba:compile") as compilations:
        assert entry(successors)(np.array([1.0, 2.0, 3.0])) == 9.0
    assert sum(happened.is_start for _, happened in compilations.buffer) == 2


def test_an_operation_is_for_kernels_only():
    with pytest.raises(TypeError, match="only kernels call this"):
        load32(np.zeros(3), 0)


def test_compiled_kernels_do_without_numba_and_leave_it_whole():
    code = (
        "import sys\n"
        "from hiros_mcap.kernels.record_index import _walk\n"
        "for given in ((b'', b'', b''), (b'',)):\n"
        "    try:\n"
        "        _walk.raw(*given)\n"
        "    except TypeError as error:\n"
        "        print(error)\n"
        "print('numba' in sys.modules)\n"
        "import numba\n"
        "@numba.njit\n"
        "def f(x):\n"
        "    return [x + 1]\n"
        "print(f(1))\n"
    )
    command = [sys.executable, "-c", code]
    for _ in range(2):  # the first one may have to compile
        done = subprocess.run(command, capture_output=True, text=True, check=True)
    refused, few, *rest = done.stdout.splitlines()
    assert "can't unbox array from PyObject" in refused
    assert "expected 3 arguments, got 1" in few
    assert rest == ["False", "[2]"]


def test_every_module_with_a_kernel_is_compiled_in_advance():
    """Else a wheel would lack it."""
    package = Path(hiros_mcap.__file__).parent
    entries = {
        ".".join(path.relative_to(package.parent).with_suffix("").parts)
        for path in package.rglob("*.py")
        if re.search(r"^@entry\b", path.read_text(encoding="utf-8"), re.MULTILINE)
    }
    assert entries == kernels.sources().keys()
