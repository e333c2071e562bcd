"""Log times of live input that cannot be right.

A recorder with use_sim_time logs at 0 until it hears /clock, another one while its clock is wrong:
such a message gets its stamp with the usual delay, as in :mod:`.log_times`. One that is far ahead
by its stamp, too, waits until others follow it there; else it is left out. Where time begins anew,
nobody can mend it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import replace
from statistics import median_low

from hiros_mcap.io.channels import info_of
from hiros_mcap.io.container.live_reader import LiveReader
from hiros_mcap.io.container.records import Message
from hiros_mcap.io.log_times import EARLY, FAR, StampPlace, place_of, remarks, stamp_of
from hiros_mcap.wording import quantity

_APART = 10 * 10**9
"""ns: how far messages out of order may lie from the newest one."""
_STAY = 100  # messages behind it, one after the other, that show that time goes on from there
_FOLLOW = 10  # messages ahead of it, none near it between them, that show the same


class LiveLogTimes:
    """Gives messages right log times in the order in which they come.

    Where time begins anew, which nobody can put in order, ``reader`` reads no further.
    """

    def __init__(self, reader: LiveReader) -> None:
        self._reader = reader
        self._places: dict[int, StampPlace | None] = {}
        self._delays: dict[int, int] = {}
        """Channel -> log time - stamp, ns, of its last message."""
        self._delay = 0  # that of the last message of all
        self._last = 0  # log time, ns, of the last message with a stamp
        self._newest = 0  # the latest log time of messages that went on
        self._back = 0  # how many such messages were far behind it, one after the other
        self._ahead: list[Message] = []
        """Messages far ahead of it, which wait until there are enough."""
        self._mended: Counter[str] = Counter()
        self._left_out: Counter[str] = Counter()

    def right(self, messages: Iterable[Message | None]) -> Iterator[Message | None]:
        """Yield messages with right log times, without those that are far ahead alone."""
        for message in messages:
            place = None if message is None else self._place(message.channel_id)
            if message is None or place is None:
                yield message
                continue
            message = self._retimed(message, stamp_of(message, place))
            time = message.log_time
            if time - self._newest > _APART:
                self._ahead.append(message)
                if len(self._ahead) == _FOLLOW:
                    yield from self._followed()
                continue
            if self._newest - time <= _APART:
                self._leave_out(self._ahead)
                self._ahead = []
            self._newest = max(self._newest, time)
            self._compare(time)
            yield message
        yield from self._followed()

    def _followed(self) -> list[Message]:
        """Return the messages that wait, without those far ahead of most: time goes on there."""
        waiting, self._ahead = self._ahead, []
        times = [message.log_time for message in waiting]
        end = median_low(times) + _APART if times else 0
        self._newest = max([self._newest, *(time for time in times if time <= end)])
        self._leave_out(m for m in waiting if m.log_time > end)
        return [m for m in waiting if m.log_time <= end]

    def _leave_out(self, messages: Iterable[Message]) -> None:
        self._left_out.update(self._reader.channels[m.channel_id].topic for m in messages)

    def _place(self, ident: int) -> StampPlace | None:
        """Return where the stamps of a channel's messages lie; None if their times all count."""
        if ident not in self._places:
            self._places[ident] = place_of(self._reader, info_of(self._reader, ident))
        return self._places[ident]

    def _retimed(self, message: Message, stamp: int) -> Message:
        """Return a message at the time that its stamp, ns, tells where its log time is wrong."""
        ident, logged, right = message.channel_id, message.log_time, message.log_time
        delay = self._delays.get(ident, self._delay)
        if logged == 0:
            due = max(stamp + delay, 0) if stamp else self._last
            right = due if due > EARLY else 0
        elif stamp and abs(logged - self._newest) > FAR:
            due = stamp + delay
            right = due if abs(due - self._newest) <= _APART else logged
        if stamp:
            self._delay = self._delays[ident] = right - stamp
            self._last = right
        if right == logged:
            return message
        self._mended[self._reader.channels[ident].topic] += 1
        return replace(message, log_time=right)

    def _compare(self, logged: int) -> None:
        """Notice that time goes on from an earlier one."""
        self._back = self._back + 1 if self._newest - logged > _APART else 0
        if self._back == _STAY:
            self._reader.fault = (
                f"time went back by {(self._newest - logged) * 1e-9:.0f} s, and hiros ended there: "
                "a clock was set back, a recording is played again, or a file is not in order of "
                "time; start hiros again, or name the file instead of a pipe"
            )

    def remarks(self) -> Iterator[str]:
        """Say how many messages were mended, and how many were left out."""
        yield from remarks(self._mended)
        for topic, n in sorted(self._left_out.items()):
            yield (
                f"{topic}: {quantity(n, 'message')} neither read nor copied, logged more than "
                f"{_APART // 10**9} s ahead of all others"
            )
