"""Channels that repeat another one: a relay, or a converter whose input was recorded, too.

Two cameras never see a person's joints at the same numbers, so copies would confirm each other.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from hiros_mcap.io.channels import CameraChannel, is_ours
from hiros_mcap.io.codec import Decoder
from hiros_mcap.io.container import Batch, McapReader
from hiros_mcap.kernels.batch import SAME, TELLING
from hiros_mcap.kernels.record_index import CHANNEL, LOG_TIME
from hiros_mcap.skeletons import POSITION, Floats

_BEFORE, _AFTER = 500_000_000, 2_000_000_000
"""Log times, ns, around the first people of a channel that are looked at: a relay may be late."""
_FEWEST, _MOST = 3, 12
"""Messages with people that a channel is judged by."""
_SHARE = 0.75
"""Part of them that the other one has, too: at the ends of what is looked at, some may lack."""


def copied_channels(
    reader: McapReader, decoder: Decoder, cameras: Sequence[CameraChannel]
) -> dict[str, str]:
    """Return the topics that repeat another one, and which. Of two, that with more messages stays.

    ``decoder`` gives people in the coordinates of the cameras. Results and truths are no cameras:
    stages may well show the same.
    """
    cameras = [c for c in cameras if c.frames and not is_ours(c.channel.topic)]
    if len(cameras) < 2:
        return {}
    shown = _people(reader, decoder, cameras)
    copies: dict[str, str] = {}
    originals: list[CameraChannel] = []
    for camera in sorted(cameras, key=_rank):
        mine = shown[camera.channel.id]
        others = (o for o in originals if _repeats(mine, shown[o.channel.id]))
        if original := next(others, None):
            copies[camera.channel.topic] = original.channel.topic
        else:
            originals.append(camera)
    return copies


def _rank(camera: CameraChannel) -> tuple[int, int, str]:
    topic = camera.channel.topic
    return -camera.channel.count, len(topic), topic


def _people(
    reader: McapReader, decoder: Decoder, cameras: Sequence[CameraChannel]
) -> dict[int, list[Floats]]:
    """Return what each channel shows around the first people of any: (P, M, 3) of each message."""
    begins = np.array(sorted(camera.begin for camera in cameras))
    shown: dict[int, list[Floats]] = {camera.channel.id: [] for camera in cameras}
    for batch in _between(reader, list(shown), begins - _BEFORE, begins + _AFTER):
        for decoded in decoder.decode(batch):
            positions = decoded.people.markers[:, :, POSITION]
            for channel, parts in zip(decoded.channels, decoded.parts, strict=True):
                people = [positions[begin:end] for *_, begin, end in parts if end > begin]
                shown[channel] += [np.concatenate(people)] if people else []
    return shown


def _between(
    reader: McapReader, channels: Sequence[int], begins: Floats, ends: Floats
) -> Iterator[Batch]:
    """Yield messages with a log time in one of the spans."""
    for records, rows in reader.runs(channels):
        messages = records.messages[rows]
        times = messages[:, LOG_TIME].astype(np.float64)
        inside = (begins <= times[:, None]) & (times[:, None] <= ends)
        kept = inside.any(axis=1) & np.isin(messages[:, CHANNEL], channels)
        if kept.any():
            yield Batch([records._replace(messages=messages[kept])], None)
        if times[0] > ends[-1]:
            return


def _repeats(mine: Sequence[Floats], others: Sequence[Floats]) -> bool:
    """Whether what one channel shows is what another one shows."""
    if len(mine) < _FEWEST or not others:
        return False
    chosen = np.linspace(0, len(mine) - 1, min(len(mine), _MOST)).astype(int)
    theirs = np.concatenate(others)
    telling = min(TELLING, theirs.shape[1])
    found = 0
    for message in chosen.tolist():
        distances = np.abs(mine[message][:, None] - theirs).max(axis=-1)
        there = ~np.isnan(distances)
        same = (there.sum(axis=-1) >= telling) & (~there | (distances <= SAME)).all(axis=-1)
        found += bool(same.any(axis=1).all())
    return found >= _SHARE * len(chosen)
