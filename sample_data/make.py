"""Make the golden outputs: what `hiros process` makes of the sample logs, filtered channel only.

    python sample_data/make.py          compare with the golden logs, say what differs
    python sample_data/make.py --bless  replace them

They guard the numbers: a change of an algorithm changes them on purpose, and says so.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np

from hiros_mcap.channels import add_skeleton_channel
from hiros_mcap.codec import Encoder
from hiros_mcap.container import McapWriter
from hiros_mcap.log import open_log
from hiros_mcap.pipeline import ProcessOptions, process
from hiros_mcap.skeletons import Frame, SkeletonModel

FOLDER = Path(__file__).parent
LOGS = sorted(FOLDER.glob("*.mcap"))
CHANNEL = "/hiros/filtered"


def golden_of(log: Path) -> Path:
    """Where the golden output of a sample log is."""
    return FOLDER / "golden" / log.name


def filtered(path: Path) -> tuple[list[Frame], SkeletonModel]:
    """Frames of the filtered channel of an output."""
    with open_log(path, topics=[CHANNEL], output_prefix="/none") as log:
        return list(log.frames()), log.model


def run(log: Path) -> tuple[list[Frame], SkeletonModel]:
    """Process a sample log with the defaults."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out.mcap"
        process(log, out, options=ProcessOptions(keep=()))
        return filtered(out)


def differences(frames: list[Frame], golden: list[Frame]) -> list[str]:
    """Say what differs, one line each: times, people, positions in mm, orientations."""
    if [f.stamp for f in frames] != [f.stamp for f in golden]:
        return [f"{len(frames)} frames, golden {len(golden)}, or their times differ"]
    found = []
    for k, (new, old) in enumerate(zip(frames, golden, strict=True)):
        if new.ids.tolist() != old.ids.tolist():
            found.append(f"frame {k}: people {new.ids.tolist()}, golden {old.ids.tolist()}")
        elif not np.allclose(new.positions, old.positions, rtol=0, atol=1e-6, equal_nan=True):
            off = 1000 * np.nanmax(np.abs(new.positions - old.positions))
            found.append(f"frame {k}: positions off by up to {off:.4f} mm")
        elif not np.allclose(new.orientations, old.orientations, rtol=0, atol=1e-6, equal_nan=True):
            found.append(f"frame {k}: orientations differ")
    return found


def bless(log: Path) -> None:
    """Write the golden output of a sample log."""
    frames, model = run(log)
    encoder = Encoder(model)
    with McapWriter(golden_of(log)) as writer:
        channel = add_skeleton_channel(writer, CHANNEL)
        for frame in frames:
            writer.write(channel, frame.log_time, encoder.encode(frame))
        writer.commit()


def main() -> int:
    """Compare or bless; the exit code is 1 if something differs."""
    differ = False
    for log in LOGS:
        if "--bless" in sys.argv:
            bless(log)
        found = differences(run(log)[0], filtered(golden_of(log))[0])
        differ = differ or bool(found)
        print(f"{log.name}: {found[0] if found else 'as golden'}")
    return int(differ)


if __name__ == "__main__":
    sys.exit(main())
