"""Accounts of the messages that are read: every one is used, or skipped for a reason.

Skeletons that a camera had sent before are left out. The accounts also tell when the cameras sent
their messages, and which messages are a step apart.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from hiros_mcap.events import counted
from hiros_mcap.io.camera_clock import CameraTimes
from hiros_mcap.io.channels import OUTPUT_PREFIX, CameraChannel
from hiros_mcap.io.codec import Decoded, Decoder
from hiros_mcap.io.container import Batch
from hiros_mcap.skeletons import Flags, Frame, People, Stamps, widened
from hiros_mcap.wording import quantity

STALE = "repeat the one before"
DAMAGED = "cannot be decoded"
FAR_FUTURE = "log time after the year 2262"
"""Frames count ns in 63 bits; MCAP has 64."""
LATEST = 2**63 - 1
_NO_TIME = frozenset([0])
_ODD_NS = 3600 * 10**9  # a stamp of nobody that is farther from those of the people means nothing
_NAMED = 3  # joints at 0 0 0 that a note names


@dataclass(slots=True)
class Account:
    """Counts of the messages of a topic: read = used + skipped."""

    topic: str
    read: int = 0
    used: int = 0
    skipped: Counter[str] = field(default_factory=Counter)  # messages that gave no frame, by reason
    stale: int = 0
    """Skeletons left out of used messages because the camera had sent exactly them before."""
    cleaned: Counter[str] = field(default_factory=Counter)
    """Numbers taken out because they cannot be true, by kind (see kernels.batch)."""
    people: int = 0  # skeletons with a joint
    empty_at_first: int = 0  # messages before the first that shows somebody
    zeros: Counter[int] = field(default_factory=Counter)
    """Skeletons with a joint at exactly 0 0 0, which is taken as not seen; by the marker's slot."""
    untimed: int = 0
    """Frames of people without a time of their own, to which the log time was given."""
    first_error: str = ""  # fault of the first message that could not be decoded

    def notes(self, joints: Sequence[str]) -> Iterator[str]:
        """Yield what was odd in the messages; ``joints`` are the names of the markers."""
        if self.stale:
            skeletons = quantity(self.stale, "repeated skeleton")
            yield f"{self.topic}: {skeletons} ignored, in messages that also show somebody anew"
        for kind, n in sorted(self.cleaned.items()):
            yield f"{self.topic}: {counted(kind, n)}"
        named = Counter({joints[slot]: n for slot, n in self.zeros.items()})
        if text := zeros_in_words(named, self.people):
            yield f"{self.topic}: {text}"
        if self.untimed:
            yield (
                f"{self.topic}: {quantity(self.untimed, 'message')} without a time, or with one "
                "before 1970; hiros uses the log time instead"
            )


def zeros_in_words(zeros: Counter[str], people: int) -> str:
    """Return which joints were at exactly 0 0 0, in which part of the skeletons; "" if none was."""
    often = [(joint, 100 * n / people) for joint, n in zeros.most_common() if n]
    if not often:
        return ""
    shares = (f"{'<1' if part < 1 else round(part)} % of {joint}" for joint, part in often[:_NAMED])
    others = quantity(len(often) - _NAMED, "other joint")
    more = f" (and {others}, not more often)" if len(often) > _NAMED else ""
    return f"{', '.join(shares)} at exactly 0 0 0, taken as not seen{more}"


Row = tuple[str, int, int, str, str, int, int]
"""A frame of a block: topic, stamp and log time, ns, camera, coordinate frame, and the rows of its
people: the first, and the one after the last."""
_Sent = tuple[Sequence[int], People, int]
"""The people of a camera's previous message: source time of each, ns, 0 = not given; where they
lie, and the row of the first."""


class CameraInput:
    """One channel being read: its account, and the last message of each of its cameras."""

    def __init__(self, camera: CameraChannel, account: Account) -> None:
        self.topic = camera.channel.topic
        self._names = dict(camera.sources)
        self._only = next(iter(self._names)) if len(self._names) == 1 else ""
        self._frame = camera.frames[0] if len(camera.frames) == 1 else ""
        self._lag = camera.lag  # log time minus stamp, ns, of the latest people with a stamp
        self._latest = 0  # their stamp, ns; 0 before there were any
        self._account = account
        self._previous: dict[str, _Sent] = {}

    def take(
        self, decoded: Decoded, i: int, log_times: Sequence[int], times: Sequence[int]
    ) -> list[Row]:
        """Account for message ``i``; return its frames, named, stamped and without repeats.

        ``log_times`` are of all messages, ``times`` of all people, ns.
        """
        account, log_time, people = self._account, log_times[i], decoded.people
        account.read += 1
        if log_time > LATEST:
            account.skipped[FAR_FUTURE] += 1
            return []
        if i in decoded.faults:
            account.skipped[DAMAGED] += 1
            account.first_error = account.first_error or decoded.faults[i]
            return []
        if i in decoded.cleaned:
            account.cleaned.update(decoded.cleaned[i])
        if i in decoded.zeros:
            account.zeros.update(dict(enumerate(decoded.zeros[i].tolist())))
        rows: list[Row] = []
        stale = 0
        for source, frame_id, begin, end in decoded.parts[i]:
            # A message without people does not name its camera.
            sent, camera = times[begin:end], source if end > begin else self._only or source
            stamp = max(sent, default=0) or max(0, decoded.stamps[i])
            account.people += end - begin
            if sent and stamp:
                self._lag, self._latest = log_time - stamp, stamp
            elif sent:
                account.untimed += 1
            else:
                stamp = self._stamp_of_nobody(stamp, log_time)
            last, n_fresh = self._previous.get(camera), end - begin
            if last is not None and not set(sent).difference(_NO_TIME).isdisjoint(last[0]):
                n_fresh = _repeats_last(people, begin, sent, last)
                sent = people.stamps[begin:end].tolist()
            self._previous[camera] = sent, people, begin
            stale += end - begin - n_fresh
            if n_fresh or not sent:  # else the camera sent all of it before
                name = self._names.get(camera, camera or self.topic)
                frame = frame_id.lstrip("/") or self._frame
                rows.append(
                    (self.topic, stamp or log_time, log_time, name, frame, begin, begin + n_fresh)
                )
        account.empty_at_first += not account.people
        if rows:
            account.used += 1
            account.stale += stale
        else:
            account.skipped[STALE] += 1
        return rows

    def _stamp_of_nobody(self, stamp: int, log_time: int) -> int:
        """Return the time, ns, of a message that shows nobody and needs no stamp, or no right one.

        The camera's clock may be another one than the recorder's.
        """
        likely = max(log_time - self._lag, 0)
        near = any(abs(stamp - time) <= _ODD_NS for time in (likely, self._latest) if time)
        return stamp if stamp and near else likely


def _repeats_last(people: People, begin: int, times: Sequence[int], last: _Sent) -> int:
    """Put people who repeat one of the last message behind the others; return how many do not.

    A repeat has the same source time, and the same bits in every number of markers and links.
    """
    times_before, people_before, first = last
    before = {_bits(people_before, row, time) for row, time in enumerate(times_before, first)}
    here = [_bits(people, row, time) for row, time in enumerate(times, begin)]
    repeated = [bits[0] != 0 and bits in before for bits in here]
    people.reorder(begin, sorted(range(len(here)), key=lambda p: repeated[p]))
    return repeated.count(False)


def _bits(people: People, row: int, time: int) -> tuple[int, bytes, bytes]:
    return time, widened(people.markers[row]).tobytes(), widened(people.links[row]).tobytes()


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
