"""Builds the message packages that no wheel has, into the Python environment that runs this.

::

    python -m hiros_schemas.ros2_packages [PACKAGE ...]

Where ROS 2 is installed, it has tf2_msgs, and colcon builds hiros_skeleton_msgs. Beside the wheels
of ROS 2 (the extra ``ros2-messages``), this builds both with CMake and a compiler. It takes a
minute. Other packages of which hiros knows the definitions, such as zed_msgs, are built by name.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

from hiros_schemas import ROS_PACKAGE, TF_MESSAGE
from hiros_schemas.definitions import STANDARD, short_name

_FIRST = """\
# The wheels were built elsewhere: their targets for Python name a folder that exists only there.
find_package(Python3 REQUIRED COMPONENTS Interpreter Development NumPy)
find_package(ament_cmake REQUIRED)
find_package(geometry_msgs REQUIRED)
get_property(targets DIRECTORY PROPERTY IMPORTED_TARGETS)
foreach(target IN LISTS targets)
  if(target MATCHES "__rosidl_generator_py$")
    set_target_properties(${target} PROPERTIES
      INTERFACE_INCLUDE_DIRECTORIES "${Python3_INCLUDE_DIRS}")
  endif()
endforeach()
"""
_SKELETONS, _TRANSFORMS = ROS_PACKAGE.name, short_name(TF_MESSAGE).split("/")[0]


def main(packages: Sequence[str] = ()) -> int:
    """Build what is missing; return 0, or 1 if a tool is missing or fails."""
    for tool in ("cmake", "c++"):
        if shutil.which(tool) is None:
            print(f"{tool} is not there; install cmake and a C++ compiler", file=sys.stderr)
            return 1
    for package in packages or (_TRANSFORMS, _SKELETONS):
        if find_spec(package) is not None:
            print(f"{package} is there")
            continue
        with tempfile.TemporaryDirectory() as folder:
            code = _build(package, Path(folder))
        if code:
            print(f"{package} was not built; see above", file=sys.stderr)
            return 1
        print(f"{package} was built into {sys.prefix}", flush=True)
    return 0


def _build(package: str, folder: Path) -> int:
    source = folder / package
    shutil.copytree(ROS_PACKAGE, source)
    if package != _SKELETONS:
        _turn_into(package, source)
    first, built = folder / "first.cmake", folder / "build"
    first.write_text(_FIRST)
    # The generators and the bridge to Python are found as a sourced setup would let them be.
    paths = {
        "AMENT_PREFIX_PATH": sys.prefix,
        "CMAKE_PREFIX_PATH": sys.prefix,
        "PYTHONPATH": sysconfig.get_path("purelib"),
    }
    configure = [
        *("cmake", "-S", source, "-B", built, f"-DCMAKE_INSTALL_PREFIX={sys.prefix}"),
        *(f"-DPython3_EXECUTABLE={sys.executable}", "-DBUILD_TESTING=OFF"),
        f"-DCMAKE_PROJECT_{package}_INCLUDE={first}",
    ]
    install = ["cmake", "--build", built, "--target", "install", "--parallel"]
    for command in (configure, install):
        done = subprocess.run(  # noqa: S603
            [str(part) for part in command],
            env=os.environ | paths,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            check=False,
        )
        if done.returncode:
            print(done.stdout, file=sys.stderr)
            return done.returncode
    return 0


def _turn_into(package: str, source: Path) -> None:
    """Make another package of a copy of ours: the same files, with its messages."""
    texts = {k.split("/")[1]: text for k, text in STANDARD.items() if k.split("/")[0] == package}
    for path in (source / "package.xml", source / "CMakeLists.txt"):
        text = path.read_text(encoding="utf-8").replace(_SKELETONS, package)
        lines = [line for line in text.splitlines(keepends=True) if '"msg/' not in line]
        at = next((k for k, s in enumerate(lines, 1) if "rosidl_generate_interfaces" in s), 0)
        lines[at:at] = [f'  "msg/{name}.msg"\n' for name in texts] if at else []
        path.write_text("".join(lines), encoding="utf-8")
    shutil.rmtree(source / "msg")
    (source / "msg").mkdir()
    for name, text in texts.items():
        (source / "msg" / f"{name}.msg").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
