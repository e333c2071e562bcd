"""Compiles the kernels into the wheel (CONTRIBUTING.md says how they are used); its README.

The build hook runs this file once more as a program, with numba's settings for the compilation.
"""

from __future__ import annotations

import json
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface
from hatchling.metadata.plugin.interface import MetadataHookInterface

ROOT = Path(__file__).parent
sys.path[:0] = [str(ROOT), str(ROOT / "cli")]


class CustomMetadataHook(MetadataHookInterface):
    """Gives an index a README whose links lead to the repository."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Set the README."""
        from readme_links import absolute

        text = (ROOT / "README.md").read_text(encoding="utf-8")
        text = absolute(text, metadata.get("urls", {}).get("Source", ""))
        metadata["readme"] = {"content-type": "text/markdown", "text": text}


class CustomBuildHook(BuildHookInterface):
    """Adds the kernels' code to a wheel."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile, unless the installation is editable, or nobody wants it."""
        from hiros_mcap.kernels import shipped

        unwanted = os.environ.get(shipped.CHOICE) == "compile"
        if version == "editable" or unwanted or platform.machine() not in ("x86_64", "AMD64"):
            return
        self.app.display_info("compiling the kernels into the wheel")
        # Not in the source tree: two builds at once would mix, and a checkout would use it.
        self._folder = tempfile.mkdtemp(prefix="hiros-wheel-")
        packed = Path(self._folder) / "packed"
        environment = {
            **os.environ,
            shipped.CHOICE: "compile",
            "NUMBA_CPU_NAME": shipped.CPU,
            "NUMBA_CPU_FEATURES": "",
            "NUMBA_CACHE_DIR": self._folder,
        }
        subprocess.run([sys.executable, __file__, packed], env=environment, check=True)
        build_data["force_include"][str(packed)] = f"hiros_mcap/{shipped.FOLDER.name}"
        build_data["pure_python"], build_data["infer_tag"] = False, True

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Remove the folder of the compilation."""
        if hasattr(self, "_folder"):
            shutil.rmtree(self._folder)


def compile_into(target: Path) -> None:
    """Compile all kernels; copy their code, and write the manifest."""
    from hiros_cli.compiling import prepare
    from hiros_mcap import kernels
    from hiros_mcap.kernels import shipped

    prepare(quiet=False)
    for module in kernels.sources():
        kernels.load([module])  # what a process had no memory for is compiled now
        shutil.copytree(kernels.folder_of(module), target, dirs_exist_ok=True)
    (target / shipped.MANIFEST.name).write_text(json.dumps(shipped.identity(), indent=1))


if __name__ == "__main__":
    compile_into(Path(sys.argv[1]))
