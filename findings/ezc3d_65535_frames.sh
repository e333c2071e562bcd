#!/bin/sh
# ezc3d returns the first 65535 frames of a longer C3D file, without an error or a warning.
#
# Guess:     a reader that cannot count the frames of a file fails or warns. Its issues 48, 303, 308
#            and 372 say that longer files are read.
# Version:   ezc3d 1.7.2 (the newest on 27 November 2026), numpy 2.
# Source:    https://www.c3d.org: the header counts frames in 16 bits; of a longer recording,
#            TRIAL:ACTUAL_START_FIELD and ACTUAL_END_FIELD count them, in two words each.
#            https://github.com/pyomeca/ezc3d/issues/372
# Behaviour: ezc3d writes all 70000 frames that it is given, and returns 65535 of them, also where
#            TRIAL counts 70000 and MANUFACTURER:COMPANY is Vicon. The rest is in the file: the header before what follows, read again,
#            gives the other 4465. A POINT:FRAMES that is a float is refused: "FRAMES parameter is
#            not an INT".
# Output:    as TRIAL counts: 65535 of 70000 frames, the last is 65534
#            by the size alone: 65535 of 70000 frames, the last is 65534
#            the rest of the file: 4465 frames, from 65535 to 69999
#            a float for FRAMES: FRAMES parameter is not an INT
# What follows: compare the frames that ezc3d returns with TRIAL and with the size of the file.
#
# Installs the pinned packages in a temporary folder. Fails if the behaviour changes.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet ezc3d==1.7.2 "numpy>=2,<3"
cd "$folder"
cat > long.py <<'PYTHON'
import struct
import warnings
from pathlib import Path

import ezc3d
import numpy as np

warnings.simplefilter("error")
FRAMES = 70_000
file = ezc3d.c3d()
file["parameters"]["POINT"]["UNITS"]["value"] = ["mm"]
file["parameters"]["POINT"]["RATE"]["value"] = [100.0]
file["parameters"]["POINT"]["LABELS"]["value"] = ["A"]
for name, words in (("START", [1, 0]), ("END", [FRAMES % 65536, FRAMES // 65536])):
    file.add_parameter("TRIAL", f"ACTUAL_{name}_FIELD", words)
    parameter = file["parameters"]["TRIAL"][f"ACTUAL_{name}_FIELD"]
    parameter["type"], parameter["value"] = 2, np.array(words)
file.add_parameter("MANUFACTURER", "COMPANY", ["Vicon"])
points = np.ones((4, 1, FRAMES))
points[0, 0] = np.arange(FRAMES)
file["data"]["points"] = points
file.write("trial.c3d")
data = Path("trial.c3d").read_bytes()
Path("size.c3d").write_bytes(data.replace(b"ACTUAL", b"FORMER"))
start = 512 * (int.from_bytes(data[16:18], "little") - 1)
assert len(data) - start >= 16 * FRAMES  # 16 bytes a frame: all are in the file
rest = data[start + 16 * 65535 : start + 16 * FRAMES]
Path("rest.c3d").write_bytes(data[:start] + rest)
at = data.index(b"FRAMES") + 6  # offset of the next parameter, type, dimensions, value
step = int.from_bytes(data[at : at + 2], "little") + 2
whole = struct.pack("<HBBf", step, 4, 0, FRAMES)
Path("float.c3d").write_bytes((data[:at] + whole + data[at + 6 :])[:start] + data[start:])

for name, words in (("trial.c3d", "as TRIAL counts"), ("size.c3d", "by the size alone")):
    x = ezc3d.c3d(name)["data"]["points"][0, 0]
    print(f"{words}: {len(x)} of {FRAMES} frames, the last is {x[-1]:.0f}")
x = ezc3d.c3d("rest.c3d")["data"]["points"][0, 0]
print(f"the rest of the file: {len(x)} frames, from {x[0]:.0f} to {x[-1]:.0f}")
try:
    print("a float for FRAMES:", ezc3d.c3d("float.c3d")["data"]["points"].shape)
except ValueError as error:
    print("a float for FRAMES:", error)
PYTHON
"$folder/venv/bin/python" long.py > output.txt
cat output.txt
cat > expected.txt <<'TEXT'
as TRIAL counts: 65535 of 70000 frames, the last is 65534
by the size alone: 65535 of 70000 frames, the last is 65534
the rest of the file: 4465 frames, from 65535 to 69999
a float for FRAMES: FRAMES parameter is not an INT
TEXT
diff expected.txt output.txt
