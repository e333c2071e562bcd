"""The MCAP container: strict reading, reproducible writing. Knows nothing of skeletons."""

from hiros_mcap.io.container.reader import McapReader, Records
from hiros_mcap.io.container.records import Attachment, Channel, Chunk, Message, Schema
from hiros_mcap.io.container.writer import ChunkCopier, McapWriter

__all__ = [
    "Attachment",
    "Channel",
    "Chunk",
    "ChunkCopier",
    "McapReader",
    "McapWriter",
    "Message",
    "Records",
    "Schema",
]
