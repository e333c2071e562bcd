"""Who is there and what happened, as diagnostics: what a dashboard of ROS shows of a run."""

from __future__ import annotations

from collections.abc import Mapping

import hiros_schemas
from hiros_mcap.events import Events, counted
from hiros_mcap.frames import Block
from hiros_mcap.io.channels import LATCHED_QOS, OUTPUT_PREFIX, add_ros_channel
from hiros_mcap.io.container import McapWriter
from hiros_mcap.io.ros_cdr import CdrWriter

SUMMARY = f"{OUTPUT_PREFIX}/summary"
_OK, _WARN = 0, 1
_RECENT_NS = 10_000_000_000  # how long an event that is a warning makes the status one


class SummaryExport:
    """Writes a latched diagnostic_msgs/DiagnosticArray, once a second and when somebody comes.

    Parameters
    ----------
    writer : the output. events : of the run.
    """

    def __init__(self, writer: McapWriter, events: Events) -> None:
        self._writer, self._events = writer, events
        self._channel = add_ros_channel(writer, SUMMARY, hiros_schemas.DIAGNOSTICS, LATCHED_QOS)
        self._since: dict[int, int] = {}  # person -> stamp, ns, at which they were first seen
        self._here: set[int] = set()
        self._due = 0

    def write(self, block: Block) -> None:
        """Take the frames of the last stage."""
        for frame in block.frames():
            here = {person for _, person in frame.tracked()}
            for person in here - self._since.keys():
                self._since[person] = frame.stamp
            if here != self._here or frame.stamp >= self._due:
                self._here, self._due = here, frame.stamp + 1_000_000_000
                message = self._message(frame.stamp, frame.frame_id)
                self._writer.write(self._channel, frame.log_time, message)

    def _message(self, stamp: int, frame_id: str) -> bytes:
        seconds = {p: f"for {(stamp - self._since[p]) * 1e-9:.1f} s" for p in sorted(self._here)}
        latest = max(self._events.log, key=lambda event: event.stamp, default=None)
        warns = latest is not None and latest.is_warning and stamp - latest.stamp < _RECENT_NS
        kinds = sorted({kind for kind, _ in self._events.counts})
        out = CdrWriter()
        out.header(stamp, frame_id)
        out.uint32(2)
        people = {f"person {person}": text for person, text in seconds.items()}
        shown = "1 person" if len(people) == 1 else f"{len(people)} people"
        _put(out, _OK, "hiros: people", shown, people)
        totals = {kind: counted(kind, self._events.total(kind)) for kind in kinds}
        text = "none" if latest is None else latest.text
        _put(out, _WARN if warns else _OK, "hiros: events", text, totals)
        return out.finish()


def _put(out: CdrWriter, level: int, name: str, message: str, values: Mapping[str, str]) -> None:
    """Write a diagnostic_msgs/DiagnosticStatus, fields in the order of its definition."""
    out.byte(level)
    out.string(name)
    out.string(message)
    out.string("")  # hardware_id
    out.uint32(len(values))
    for key, value in values.items():
        out.string(key)
        out.string(value)
