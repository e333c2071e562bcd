"""A recording in memory: read and prepared once, then run by several systems or on some cameras.

::

    recording = Recording.read("lab.mcap", config, options)
    everybody = recording.run(config, options)["filtered"]
    others = recording.run(config, options, recording.sources - {"camera_0"})["filtered"]

Clocks and poses are those that :func:`hiros_mcap.running.pipeline.process` uses, and so are the
results, rounded as in a file. Poses and clocks come from all cameras, also where a run has some of
them.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from hiros_mcap.config import Config
from hiros_mcap.frames import Block, frames_of
from hiros_mcap.io.codec import Precision, rounded
from hiros_mcap.io.detectors.rgb_keypoints import RgbRig
from hiros_mcap.io.log import Source
from hiros_mcap.io.rgb_cameras import RgbCamera, read_rgb_cameras
from hiros_mcap.running.observe import Stopwatch
from hiros_mcap.running.pipeline import open_input, stream
from hiros_mcap.running.preparation import Prepared, prepare, set_up
from hiros_mcap.running.process_options import ProcessOptions
from hiros_mcap.skeletons import Frame, SkeletonModel
from hiros_mcap.systems import chain_of


@dataclass(frozen=True, slots=True)
class Recording:
    """The detections of a log, at corrected times and in the fixed frame."""

    prepared: Prepared
    blocks: Sequence[Block]
    images: Sequence[RgbCamera] = ()  # RGB cameras with their keypoints, at corrected times

    @classmethod
    def read(
        cls, source: Source, config: Config, options: ProcessOptions, rig: RgbRig | None = None
    ) -> Recording:
        """Read a log as a run with these settings does.

        ``rig`` : how the RGB cameras stand, if that is known; those without a lens are left out.

        Raises LogError and ConfigError as :func:`hiros_mcap.running.pipeline.process` does.
        """
        with open_input(source, config, options, rig) as log:
            prepared = prepare(log, config, options, Stopwatch())
            _ = prepared.log.span  # needs the file
            images = read_rgb_cameras(log.reader)
            return cls(prepared, tuple(prepared.detections()), images)

    @property
    def model(self) -> SkeletonModel:
        """Of the detections and of all results."""
        return self.prepared.log.model

    @property
    def topics(self) -> dict[str, str]:
        """Camera -> its topic, in the order of the log's channels."""
        cameras = self.prepared.log.cameras
        return {name: c.channel.topic for c in cameras for name in c.sources.values()}

    @property
    def sources(self) -> frozenset[str]:
        """Cameras that sent anything."""
        return frozenset(source for block in self.blocks for _, source, _ in block.messages())

    def frames(self) -> Iterator[Frame]:
        """Yield the detections."""
        return frames_of(self.blocks)

    def head(self, messages: int) -> Recording:
        """Return the beginning of the recording, of at least so many messages if it has them."""
        sizes = np.cumsum([len(block) for block in self.blocks])
        return replace(self, blocks=self.blocks[: int(np.searchsorted(sizes, messages)) + 1])

    def run(
        self,
        config: Config,
        options: ProcessOptions,
        sources: Collection[str] | None = None,
        *,
        last: bool = False,
    ) -> dict[str, list[Frame]]:
        """Return what comes out of each stage, or of the last one, by the name of its channel.

        ``config`` and ``options`` are of the stages; ``sources`` the cameras to use, None = all.

        Raises ConfigError for a parameter that does not fit the log.
        """
        chain = chain_of(options.system, options.stages)
        results: dict[str, list[Frame]] = {name: [] for name in (chain[-1:] if last else chain)}

        def keep(channel: str, block: Block) -> None:
            if channel in results:
                results[channel] += _as_written(block, config.output.precision).frames()

        run = set_up(self.prepared, config, options, partial(self._blocks_of, sources))
        for _ in stream(self._blocks_of(sources), run, chain, [keep], Stopwatch()):
            pass
        return results

    def _blocks_of(self, sources: Collection[str] | None) -> Iterator[Block]:
        """Yield the detections of some cameras."""
        for block in self.blocks:
            names = block.names if sources is None else sources
            wanted = np.array([name in names for name in block.names])[block.sources]
            if wanted.all():
                yield block
            elif wanted.any():
                yield block.select(np.flatnonzero(wanted))


def _as_written(block: Block, precision: Precision) -> Block:
    """Return a block with the numbers that a file would have."""
    people = block.people
    markers, links = (rounded(states, precision) for states in (people.markers, people.links))
    return replace(block, people=people._replace(markers=markers, links=links))
