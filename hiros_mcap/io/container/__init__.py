"""The MCAP container: strict reading, reproducible writing. Knows nothing of skeletons."""

from hiros_mcap.io.container.order import Keys, LogOrder
from hiros_mcap.io.container.reader import Batch, McapReader, Records
from hiros_mcap.io.container.records import Channel, Chunk, Message, Schema
from hiros_mcap.io.container.recovery import Recovery
from hiros_mcap.io.container.salvage import RecoveringReader
from hiros_mcap.io.container.sinks import MemorySink
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
