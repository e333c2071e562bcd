#!/usr/bin/env bash
# The lowest versions that pyproject.toml allows, installed together, run the sample log.
#
#     benchmarks/lowest.sh         # PYTHON chooses the interpreter; 1.3 GB, some minutes
#
# It fails if a lower bound cannot be reached beside the others, or a command does not run.
set -euo pipefail
cd "$(dirname "$0")/.."

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python=$(command -v "${PYTHON:-python3}")
"$python" -m venv "$work/tool"
"$work/tool/bin/python" -m pip install --quiet --disable-pip-version-check uv packaging
uv="$work/tool/bin/uv"

"$uv" pip compile --quiet --no-header --no-annotate --python "$python" --resolution lowest-direct \
  pyproject.toml --output-file "$work/lowest.txt" >/dev/null
"$work/tool/bin/python" - "$work/lowest.txt" <<'CHECK'
import sys, tomllib
from packaging.requirements import Requirement
from packaging.version import Version
lines = [Requirement(line.strip()) for line in open(sys.argv[1])]
pinned = {line.name: Version(next(iter(line.specifier)).version) for line in lines}
project = tomllib.load(open("pyproject.toml", "rb"))["project"]
wrong = [
    f"{needed.name} {bound.version}: the lowest that installs is {pinned[needed.name.replace('.', '-')]}"
    for needed in map(Requirement, project["dependencies"])
    for bound in needed.specifier
    if bound.operator == ">=" and pinned[needed.name.replace(".", "-")] != Version(bound.version)
]
sys.exit("\n".join(wrong) if wrong else 0)
CHECK

"$uv" venv --quiet --python "$python" "$work/venv"
"$uv" pip install --quiet --python "$work/venv/bin/python" -r "$work/lowest.txt"
export PYTHONPATH="$PWD:$PWD/cli:$PWD/viewer:$PWD/schemas" NUMBA_CACHE_DIR="$work/kernels"
hiros() { "$work/venv/bin/python" -m hiros_cli "$@"; }
out="$work/out.mcap"
hiros process sample_data/two_people_crossing.mcap -o "$out"
hiros info "$out"
hiros eval "$out"
hiros view "$out" --save "$work/out.rrd"
hiros plot "$out" -o "$work/out.html"
hiros plot "$out" -o "$work/out.png"
for suffix in csv parquet trc mot c3d bvh; do
  hiros export "$out" --person 0 -o "$work/out.$suffix"
done
echo "the lowest versions run the sample log"
