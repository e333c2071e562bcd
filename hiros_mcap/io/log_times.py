"""When the cameras of a log sent their messages, and which messages are a step apart."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np

from hiros_mcap.io.camera_clock import CameraTimes
from hiros_mcap.io.channels import OUTPUT_PREFIX, CameraChannel
from hiros_mcap.io.codec import Decoder
from hiros_mcap.io.container import Batch
from hiros_mcap.skeletons import Flags, Frame, Stamps

_SPARED = 0.75
"""A message is left out if it comes after a smaller share of the interval: none is regular."""


class Spacing:
    """Leaves messages out: of a channel of one camera, those that come soon after a kept one.

    Parameters
    ----------
    step : usual interval, ns. cameras : the channels.
    spans : log times, ns, outside of which no message is kept; None = all may be.
    """

    def __init__(
        self,
        step: int,
        cameras: Iterable[CameraChannel],
        spans: Sequence[tuple[int, int]] | None = None,
    ) -> None:
        self._least, self._spans = round(_SPARED * step), spans
        self._shared = {
            camera.channel.id
            for camera in cameras
            if len(camera.sources) != 1 or camera.channel.topic == f"{OUTPUT_PREFIX}/tracked"
        }
        self._last: dict[int, int] = {}

    def thinned(
        self, batches: Iterable[Batch], decoder: Decoder, times: list[Stamps] | None
    ) -> Iterator[Batch]:
        """Return the batches with the messages that are kept; the times of all go to ``times``."""

        def thin(batch: Batch) -> Batch:
            some, table = decoder.spaced(batch, self._kept)
            if times is not None:
                times.append(table)
            return some

        return map(thin, batches)

    def _kept(self, channel: int, times: Stamps, log_times: Stamps, shows: Flags) -> Flags:
        """(n,) which of the next messages of a channel are kept, by their times, ns.

        One that ``shows`` nobody is not what others have to keep away from: a detector may send an
        empty message between any two.
        """
        inside = np.full(len(times), self._spans is None)
        for begin, end in self._spans or ():
            inside |= (begin <= log_times) & (log_times <= end)
        if channel in self._shared:
            return inside
        last = self._last.get(channel, -self._least)
        for k in np.flatnonzero(inside).tolist():
            inside[k] = not 0 <= times[k] - last < self._least
            last = int(times[k]) if inside[k] and shows[k] else last
        self._last[channel] = last
        return inside


def times_in(tables: Iterable[Stamps], names: Mapping[int, str]) -> dict[str, CameraTimes]:
    """Return the times of each camera, by its channel's id, of tables of Decoder.read_times."""
    table = np.concatenate([*tables, np.empty((0, 4), np.int64)])
    table = table[np.argsort(table[:, 1], kind="stable")]
    return {name: _camera_times(table[table[:, 0] == ident, 1:]) for ident, name in names.items()}


def times_of(frames: Iterable[Frame]) -> dict[str, CameraTimes]:
    """Return the times of each camera of decoded frames."""
    rows: dict[str, list[tuple[int, int, int]]] = {}
    for frame in sorted(frames, key=lambda frame: frame.log_time):
        rows.setdefault(frame.source, []).append((frame.log_time, frame.stamp, 0))
    return {name: _camera_times(np.array(some, np.int64)) for name, some in rows.items()}


def _camera_times(rows: Stamps) -> CameraTimes:
    """Return the times that tell of a clock; (n, 3) log time, header.stamp, source time, 0 = none.

    A repeated stamp tells nothing.
    """
    log_times, headers, sources = rows.T
    stamps = sources if 2 * np.count_nonzero(sources) >= np.count_nonzero(headers) else headers
    kept = stamps > 0
    kept[1:] &= stamps[1:] != stamps[:-1]
    return CameraTimes(stamps[kept], log_times[kept])
