"""Which skeleton model the messages of a log have."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from hiros_mcap.errors import LogError
from hiros_mcap.io.codec import Decoder, ModelBuilder, OtherSkeletonError
from hiros_mcap.io.container import Batch, McapReader, Message, Records
from hiros_mcap.io.layout import Layout
from hiros_mcap.kernels.record_index import CHANNEL, START
from hiros_mcap.skeletons import SkeletonModel


class SeveralModelsError(LogError):
    """The channels of a log have different skeletons, which are converted then."""


def learn_model(
    reader: McapReader, layouts: Mapping[int, Layout]
) -> tuple[SkeletonModel, dict[int, Message]]:
    """Learn the skeleton model, and each channel's first message on the way.

    The first messages are enough when they hold every marker and link that the detectors claim to
    know; at worst the whole log is read. A message that is damaged, or contradicts the former
    ones, teaches nothing; whoever decodes it will say so. Raises SeveralModelsError if the first
    skeletons of a channel contradict another channel.
    """
    learner = _Learner(layouts)
    for records, rows in reader.runs(layouts.keys()):
        some = records._replace(messages=records.messages[rows])
        for message in some.at(learner.new_in(some)):
            learner.take(message, reader.channels[message.channel_id].topic)
            if learner.done:
                break
        if learner.done:
            break
    model = learner.builder.build()
    if learner.fault and not model.n_markers:
        raise LogError(f"no message has a skeleton with markers; first error: {learner.fault}")
    return model, learner.first


class _Learner:
    """What is known of the model after some messages of the channels with ``layouts``."""

    def __init__(self, layouts: Mapping[int, Layout]) -> None:
        self.builder = ModelBuilder()
        self.first: dict[int, Message] = {}
        self.fault = ""
        """Why the first message that teaches nothing does so."""
        self._layouts = layouts
        self._taught: set[int] = set()
        self._decoder = Decoder(self.builder.build(), layouts=layouts)

    @property
    def done(self) -> bool:
        """Whether no further message teaches anything."""
        return self.builder.complete and len(self.first) == len(self._layouts)

    def new_in(self, records: Records) -> list[int]:
        """Return which messages are the first of a channel, or do not fit the model so far."""
        channels, first = np.unique(records.messages[:, CHANNEL], return_index=True)
        places = zip(channels.tolist(), first.tolist(), strict=True)
        new = {k for i, k in places if i not in self.first}
        batch = Batch([records], None)
        for some in () if self.builder.complete else self._decoder.decode(batch):
            faulty = some.keys[list(some.faults), 2]  # where the messages start
            new.update(np.flatnonzero(np.isin(records.messages[:, START], faulty)).tolist())
        return sorted(new)

    def take(self, message: Message, topic: str) -> None:
        """Learn from a message if it may hold anything new."""
        ident = message.channel_id
        if ident not in self.first or not (self.builder.complete or self._reads(message)):
            try:
                self.builder.add(message.data, topic, self._layouts[ident])
                self._taught.add(ident)
                self._decoder = Decoder(self.builder.build(), layouts=self._layouts)
            except LogError as error:
                if isinstance(error, OtherSkeletonError) and ident not in self._taught:
                    raise SeveralModelsError("the cameras have different skeletons") from None
                self.fault = self.fault or f"{topic}: {error.fault}"
        self.first.setdefault(ident, message)

    def _reads(self, message: Message) -> bool:
        """Whether a message has nothing that the model lacks; faster than learning it."""
        try:
            self._decoder.decode_message(message.data, channel=message.channel_id)
        except LogError:
            return False
        return True
