"""Decodes live messages: their skeleton may turn out to have more joints when results have begun.

A recording is read to its end for the model of its skeletons. Live, results begin after a second,
and some detectors send only the joints that they see.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from typing import Any

from hiros_mcap.errors import LogError
from hiros_mcap.io.codec import Decoded, Decoder, ModelBuilder
from hiros_mcap.io.container.reader import Batch
from hiros_mcap.kernels.record_index import START, STOP
from hiros_mcap.skeletons import SkeletonModel


class LiveDecoder(Decoder):
    """A decoder that leaves out markers and links which the model does not have.

    For the parameters see :class:`Decoder`.
    """

    def __init__(self, model: SkeletonModel, **options: Any) -> None:
        super().__init__(model, **options)
        self._options = options
        self._builder = ModelBuilder.of(model)
        self._whole = Decoder(model, **options)  # reads all that was ever sent

    @property
    def left_out(self) -> list[str]:
        """Names of the markers that are left out, in the order of their ids."""
        whole, known = self._whole.model, self.model.marker_ids
        pairs = zip(whole.marker_ids, whole.marker_names, strict=True)
        return [name for ident, name in pairs if ident not in known]

    def decode(self, batch: Batch) -> Iterator[Decoded]:
        """Read the messages of a batch; see :meth:`Decoder.decode`."""
        decoded = [*self._whole.decode(batch)]
        if any(some.faults for some in decoded) and self._grow(batch):
            decoded = [*self._whole.decode(batch)]
        is_whole = self._whole.model == self.model
        yield from decoded if is_whole else map(self._reduced, decoded)

    def _grow(self, batch: Batch) -> bool:
        """Learn from messages; say whether they have something new. Damaged ones teach nothing."""
        for records in batch.records:
            for row in records.messages[:, [START, STOP]].tolist():
                start, stop = map(int, row)
                with suppress(LogError):
                    self._builder.add(bytes(records.data[start:stop]), "")
        before, model = self._whole.model, self._builder.build()
        if (model.marker_ids, model.link_ids) == (before.marker_ids, before.link_ids):
            return False
        self._whole = Decoder(model, **self._options)
        return True

    def _reduced(self, decoded: Decoded) -> Decoded:
        """Return what the model has of messages that were read whole."""
        whole, people = self._whole.model, decoded.people
        markers = [whole.marker_ids.index(ident) for ident in self.model.marker_ids]
        links = [whole.link_ids.index(ident) for ident in self.model.link_ids]
        known = people._replace(
            markers=people.markers[:, markers].copy(),
            marker_confidences=people.marker_confidences[:, markers].copy(),
            links=people.links[:, links].copy(),
            link_confidences=people.link_confidences[:, links].copy(),
        )
        zeros = {message: numbers[markers] for message, numbers in decoded.zeros.items()}
        return decoded._replace(people=known, zeros=zeros)
