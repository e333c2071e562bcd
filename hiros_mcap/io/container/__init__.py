"""The MCAP container: strict reading, reproducible writing. Knows nothing of skeletons."""

from hiros_mcap.io.container.file import MemorySink
from hiros_mcap.io.container.losses import Recovery
from hiros_mcap.io.container.reader import Batch, Keys, LogOrder, McapReader, Records
from hiros_mcap.io.container.records import Channel, Chunk, Message, Schema
from hiros_mcap.io.container.salvage import RecoveringReader
from hiros_mcap.io.container.writer import ChunkCopier, McapWriter

__all__ = [
    "Batch",
    "Channel",
    "Chunk",
    "ChunkCopier",
    "Keys",
    "LogOrder",
    "McapReader",
    "McapWriter",
    "MemorySink",
    "Message",
    "Records",
    "RecoveringReader",
    "Recovery",
    "Schema",
]
