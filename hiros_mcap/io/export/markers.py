"""The last stage as MarkerArray, JointState and Log, for RViz, Foxglove and Lichtblick.

Bones are one LINE_STRIP per chain of limbs, which all of these draw. Rerun (0.41) shows JointState
and Log of an MCAP file, but draws a MarkerArray only where a blueprint maps its points to line
strips; it would join those of a LINE_LIST to a single line.
"""

from __future__ import annotations

import numpy as np

import hiros_schemas
from hiros_mcap.body.anatomy import ANGLE_NAMES, anatomical_angles
from hiros_mcap.events import Event, Events
from hiros_mcap.frames import Block
from hiros_mcap.io.channels import OUTPUT_PREFIX, add_ros_channel
from hiros_mcap.io.container import McapWriter
from hiros_mcap.io.ros_cdr import CdrWriter
from hiros_mcap.skeletons import Floats, Frame, SkeletonModel

RGB = tuple[int, int, int]
PEOPLE: tuple[RGB, ...] = (
    (255, 140, 0),
    (0, 174, 255),
    (248, 169, 189),
    (19, 168, 123),
    (119, 244, 247),
    (111, 109, 233),
    (222, 237, 21),
    (228, 74, 89),
    (60, 217, 115),
    (201, 121, 176),
)
"""Ten colours for a dark ground, the first ones the most different.

Also to eyes without red or green cones (Machado 2009), they are apart by at least 15 of CIEDE2000
among four people, 12 among six, 11 among ten.
"""


def person_colour(person: int) -> RGB:
    """Colour of an id, the same in every output."""
    return PEOPLE[person % len(PEOPLE)]


MARKERS, LABELS = f"{OUTPUT_PREFIX}/markers", f"{OUTPUT_PREFIX}/labels"
JOINTS, LOG = f"{OUTPUT_PREFIX}/joint_states", f"{OUTPUT_PREFIX}/log"
LIFETIME_NS = 250_000_000
"""Markers vanish by themselves when their person has left."""
_LINE_STRIP, _TEXT, _ADD = 4, 9, 0
_INFO, _WARN = 20, 30
_WIDTH_M, _TEXT_M, _ABOVE_M = 0.03, 0.15, 0.2
_ORIGIN, _NO_POINTS = np.zeros(3), np.zeros((0, 3))


class MarkerExport:
    """Writes the frames of one stage into channels of their own.

    Parameters
    ----------
    writer : the output. model : of the frames. events : of the run; written as they come.
    by_stamp : log times are those of the data, not of the message that caused the result.
    """

    def __init__(
        self, writer: McapWriter, model: SkeletonModel, events: Events, *, by_stamp: bool = False
    ) -> None:
        self._writer = writer
        self._model = model
        self._events = events
        self._by_stamp = by_stamp
        self._logged = 0
        self._last_angles: dict[int, Floats] = {}
        self._chains = limb_chains(model)
        self._markers = add_ros_channel(writer, MARKERS, hiros_schemas.MARKER_ARRAY)
        self._labels = add_ros_channel(writer, LABELS, hiros_schemas.MARKER_ARRAY)
        self._joints = add_ros_channel(writer, JOINTS, hiros_schemas.JOINT_STATE)
        self._log = add_ros_channel(writer, LOG, hiros_schemas.LOG)

    def write(self, block: Block) -> None:
        """Write frames, and the events since the last one."""
        all_angles = anatomical_angles(self._model, block.people.markers[:, :, :3], unwrapped=False)
        for frame, (begin, end) in zip(block.frames(), block.rows.tolist(), strict=True):
            self._write(frame, self._continue(frame, all_angles[begin:end]))

    def _continue(self, frame: Frame, angles: Floats) -> Floats:
        """(P, A) angles, rad, that go on beyond 180 degrees where a person turns on."""
        angles = angles.copy()
        for row, person in frame.tracked():
            now = angles[row]
            before = self._last_angles.get(person, now)
            now += 2 * np.pi * np.round(np.nan_to_num(before - now) / (2 * np.pi))
            self._last_angles[person] = np.where(np.isnan(now), before, now)
        return angles

    def _write(self, frame: Frame, angles: Floats) -> None:
        time = frame.stamp if self._by_stamp else frame.log_time
        self._writer.write(self._markers, time, marker_array(frame, self._chains))
        self._writer.write(self._labels, time, label_array(frame))
        self._writer.write(self._joints, time, joint_state(frame, angles))
        for event in self._events.log[self._logged :]:
            self._writer.write(
                self._log, event.stamp if self._by_stamp else time, log_message(event)
            )
        self._logged = len(self._events.log)


def limb_chains(model: SkeletonModel) -> tuple[tuple[int, ...], ...]:
    """Marker slots of the paths that the links make, each from one branching to the next."""
    children: dict[int, list[int]] = {}
    for parent, child in model.links.tolist():
        if parent >= 0 and child >= 0:
            children.setdefault(parent, []).append(child)
    inner = {child for group in children.values() for child in group}
    chains = []
    for start in children:
        if start in inner and len(children[start]) == 1:
            continue  # in the middle of a chain
        for child in children[start]:
            chain = [start, child]
            while len(children.get(chain[-1], [])) == 1 and children[chain[-1]][0] not in chain:
                chain.append(children[chain[-1]][0])
            chains.append(tuple(chain))
    return tuple(chains)


def marker_array(frame: Frame, chains: tuple[tuple[int, ...], ...]) -> bytes:
    """visualization_msgs/MarkerArray: the bones of everybody with an id."""
    strips = [
        (person, k, piece)
        for row, person in frame.tracked()
        for k, piece in enumerate(_pieces(frame.positions[row], chains))
    ]
    out = CdrWriter()
    out.uint32(len(strips))
    for person, k, points in strips:
        _put(out, frame, person, f"person {person}", k, points=points)
    return out.finish()


def label_array(frame: Frame) -> bytes:
    """visualization_msgs/MarkerArray: everybody's id above the head."""
    tops = [(who, _top(frame.positions[row])) for row, who in frame.tracked()]
    labelled = [(person, top) for person, top in tops if top is not None]
    out = CdrWriter()
    out.uint32(len(labelled))
    for person, top in labelled:
        _put(out, frame, person, "names", person, top, text=str(person))
    return out.finish()


def _pieces(positions: Floats, chains: tuple[tuple[int, ...], ...]) -> list[Floats]:
    """(K, 3) points of each chain, in pieces where joints are missing."""
    pieces = []
    for chain in chains:
        points = positions[list(chain)]
        gaps = np.nonzero(np.isnan(points).any(axis=1))[0]
        for piece in np.split(points, gaps):
            present = piece[~np.isnan(piece).any(axis=1)]
            if len(present) > 1:
                pieces.append(present)
    return pieces


def _top(positions: Floats) -> Floats | None:
    present = positions[~np.isnan(positions).any(axis=1)]
    if not len(present):
        return None
    return np.array([*present[:, :2].mean(axis=0), present[:, 2].max() + _ABOVE_M])


def _put(
    out: CdrWriter,
    frame: Frame,
    person: int,
    namespace: str,
    ident: int,
    position: Floats = _ORIGIN,
    points: Floats = _NO_POINTS,
    text: str = "",
) -> None:
    """Write a visualization_msgs/Marker, fields in the order of its definition.

    It is a text at a position (3,), m, or a line through points (K, 3), m.
    """
    out.header(frame.stamp, frame.frame_id)
    out.string(namespace)
    out.int32(ident, _TEXT if text else _LINE_STRIP, _ADD)
    out.array(position)
    out.float64(0.0, 0.0, 0.0, 1.0)
    out.float64(_WIDTH_M, 0.0, _TEXT_M if text else 0.0)
    out.float32(*(part / 255 for part in person_colour(person)), 1.0)
    out.time(LIFETIME_NS)
    out.byte(0)  # frame_locked
    out.uint32(len(points))
    out.array(points)
    out.uint32(0)  # colors
    out.string("")  # texture_resource
    out.header(0, "")  # texture: format, data
    out.string("")
    out.uint32(0)
    out.uint32(0)  # uv_coordinates
    out.string(text)
    out.string("")  # mesh_resource
    out.string("")  # mesh_file: filename, data
    out.uint32(0)
    out.byte(0)  # mesh_use_embedded_materials


def joint_state(frame: Frame, angles: Floats) -> bytes:
    """sensor_msgs/JointState: the known angles (P, A), rad, of everybody with an id."""
    names: list[str] = []
    values: list[float] = []
    for row, person in frame.tracked():
        present = np.flatnonzero(~np.isnan(angles[row])).tolist()
        names += [f"person_{person}/{ANGLE_NAMES[k].replace(' ', '_')}" for k in present]
        values += angles[row, present].tolist()
    out = CdrWriter()
    out.header(frame.stamp, frame.frame_id)
    out.strings(names)
    out.sequence(np.array(values))
    out.sequence(np.zeros(0))  # velocity
    out.sequence(np.zeros(0))  # effort
    return out.finish()


def log_message(event: Event) -> bytes:
    """rcl_interfaces/Log: what happened, to whom, seen by which camera."""
    out = CdrWriter()
    out.time(event.stamp)
    out.byte(_WARN if event.is_warning else _INFO)
    out.string("hiros")
    out.string(event.text)
    out.string("")
    out.string("")
    out.uint32(0)
    return out.finish()
