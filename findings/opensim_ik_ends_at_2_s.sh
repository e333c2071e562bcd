#!/usr/bin/env bash
# OpenSim's InverseKinematicsTool, without a time_range, solves only the first 2 s; it says nothing.
#
# Guess: without a time range, the tool solves all rows of the marker file.
# Version: opensim 4.6 from PyPI, Python 3.11.
# Source: OpenSim/Tools/InverseKinematicsTool (opensim-org/opensim-core); the tool's own description of
#   time_range, printed below, names no default.
# Behaviour: a setup without time_range ends at 2.0 s; run() returns True, and there is no warning.
#   With the range of the file, the same tool solves all rows.
# Seen:
#   description: The time range for the study.
#   without time_range: run() True, 21 of 51 rows, the last at 2.0 s
#   with 0 5:           run() True, 51 of 51 rows, the last at 5.0 s
#
# It uses neither this project nor its files: a block that slides along x, and one marker.
# PYTHON chooses the interpreter. Exits 0 if it is so, 1 if it changed.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
"${PYTHON:-python3.11}" -m venv "$work/venv"
"$work/venv/bin/python" -m pip install --quiet --disable-pip-version-check opensim==4.6
cd "$work"
"$work/venv/bin/python" - <<'PYTHON'
import sys
from pathlib import Path

import opensim

opensim.Logger.setLevelString("Warn")
opensim.Logger.removeFileSink()

model = opensim.Model()
model.setName("block")
block = opensim.Body("block", 1.0, opensim.Vec3(0), opensim.Inertia(1, 1, 1))
slider = opensim.SliderJoint("slider", model.getGround(), block)
slider.updCoordinate().setName("x")
model.addBody(block)
model.addJoint(slider)
model.addMarker(opensim.Marker("m", block, opensim.Vec3(0)))
model.finalizeConnections()
model.printToXML("block.osim")

times = [k / 10 for k in range(51)]
head = [
    "PathFileType\t4\t(X/Y/Z)\tblock.trc",
    "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
    "10\t10\t51\t1\tm\t10\t1\t51",
    "Frame#\tTime\tm\t\t",
    "\t\tX1\tY1\tZ1",
    "",
]
rows = [f"{k}\t{t:.6f}\t{0.1 * t:.6f}\t0.000000\t0.000000\t" for k, t in enumerate(times, 1)]
Path("block.trc").write_text("\n".join([*head, *rows]) + "\n")

fresh = opensim.InverseKinematicsTool()
print("description:", fresh.getPropertyByName("time_range").getComment())


def solved(time_range: str) -> list[float]:
    Path("setup.xml").write_text(
        f"""<OpenSimDocument Version="40000"><InverseKinematicsTool name="block">
        <model_file>block.osim</model_file><marker_file>block.trc</marker_file>
        <output_motion_file>solved.mot</output_motion_file>{time_range}
        <IKTaskSet><objects><IKMarkerTask name="m"><apply>true</apply><weight>1</weight>
        </IKMarkerTask></objects></IKTaskSet></InverseKinematicsTool></OpenSimDocument>"""
    )
    done = opensim.InverseKinematicsTool("setup.xml").run()
    found = list(opensim.TimeSeriesTable("solved.mot").getIndependentColumn())
    name = time_range.replace("<time_range>", "with ").replace("</time_range>", "")
    print(
        f"{name or 'without time_range'}: run() {done}, {len(found)} of {len(times)} rows, "
        f"the last at {found[-1]:.1f} s"
    )
    return found


without, with_range = solved(""), solved("<time_range>0 5</time_range>")
surprising = len(with_range) == 51 and len(without) == 21 and abs(without[-1] - 2.0) < 1e-9
print("as found" if surprising else "it changed")
sys.exit(0 if surprising else 1)
PYTHON
