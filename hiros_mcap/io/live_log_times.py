"""Log times of live input that cannot be right.

A recorder with use_sim_time logs at 0 until it hears /clock: such a message gets its stamp with the
delay of the last one, as in :mod:`.log_times`. Where time begins anew, nobody can mend it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace

from hiros_mcap.io.channels import TF_TOPICS, channels_of
from hiros_mcap.io.container.live_reader import LiveReader
from hiros_mcap.io.container.records import Message
from hiros_mcap.io.log_times import EARLY, StampPlace, place_of, remarks, stamp_of

_BACK = 10 * 10**9
"""ns: how far messages out of order may lie behind the newest one."""
_STAY = 100  # messages behind it, one after the other, that show that time goes on from there


class LiveLogTimes:
    """Gives messages right log times in the order in which they come.

    Where time begins anew, which nobody can put in order, ``reader`` reads no further.
    """

    def __init__(self, reader: LiveReader) -> None:
        self._reader = reader
        self._places: dict[int, StampPlace | None] = {}
        self._delay = 0  # log time - stamp, ns, of the last message
        self._last = 0  # log time, ns, of the last message with a stamp
        self._newest = 0  # the latest of these
        self._back = 0  # how many such messages were far behind it, one after the other
        self._mended: Counter[str] = Counter()

    def right(self, message: Message) -> Message:
        """Return a message with a right log time."""
        ident, logged = message.channel_id, message.log_time
        if ident not in self._places:
            (info,) = (info for info in channels_of(self._reader) if info.id == ident)
            is_static = info.topic == TF_TOPICS[0]
            self._places[ident] = None if is_static else place_of(self._reader, info)
        place = self._places[ident]
        if place is None:
            return message
        right, stamp = logged, stamp_of(message, place)
        if logged == 0:
            due = max(stamp + self._delay, 0) if stamp else self._last
            right = due if due > EARLY else 0
        if stamp:
            self._delay, self._last = right - stamp, right
        self._compare(self._last)
        if right == logged:
            return message
        self._mended[self._reader.channels[ident].topic] += 1
        return replace(message, log_time=right)

    def _compare(self, logged: int) -> None:
        """Notice that time goes on from an earlier one."""
        self._newest = max(self._newest, logged)
        self._back = self._back + 1 if self._newest - logged > _BACK else 0
        if self._back == _STAY:
            self._reader.fault = (
                f"time went back by {(self._newest - logged) * 1e-9:.0f} s, and hiros ended there: "
                "a clock was set back, a recording is played again, or a file is not in order of "
                "time; start hiros again, or name the file instead of a pipe"
            )

    def remarks(self) -> Iterator[str]:
        """Say how many messages were mended."""
        return remarks(self._mended)
