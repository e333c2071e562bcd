"""Time of the message layer: microseconds per message, the generic library beside it.

Usage: python benchmarks/bench_codec.py
"""

from __future__ import annotations

from collections.abc import Callable
from time import perf_counter

import numpy as np
from mcap.records import Schema

import hiros_schemas
from hiros_mcap.io.codec import Decoder, Encoder, ModelBuilder
from hiros_mcap.io.container import Batch, Records
from hiros_mcap.io.layout import check_schema
from hiros_mcap.skeletons import ORIENTATION, POSITION, Frame, SkeletonModel

PEOPLE, MARKERS, MANY = 4, 32, 100
NAME = hiros_schemas.SKELETON_GROUP


def best(action: Callable[[], object], repeats: int) -> float:
    """Shortest mean time of seven rounds, us: other programs can only add to it."""
    rounds = []
    for _ in range(7):
        start = perf_counter()
        for _ in range(repeats):
            action()
        rounds.append((perf_counter() - start) / repeats)
    return min(rounds) * 1e6


def typical(model: SkeletonModel) -> Frame:
    """What a depth camera gives: markers have positions, links positions and orientations."""
    rng = np.random.default_rng(0)
    frame = Frame.empty(PEOPLE, model, stamp=1, source="camera", frame_id="camera")
    frame.markers[..., POSITION] = rng.normal(size=(PEOPLE, model.n_markers, 3))
    frame.links[..., POSITION] = rng.normal(size=(PEOPLE, model.n_links, 3))
    rotations = rng.normal(size=(PEOPLE, model.n_links, 4))
    rotations /= np.linalg.norm(rotations, axis=-1, keepdims=True)
    frame.links[..., ORIENTATION] = rotations
    frame.marker_confidences[:] = frame.link_confidences[:] = 0.66
    return frame


def main() -> None:
    """Print the table."""
    from mcap_ros2.decoder import DecoderFactory

    links = [(f"link_{k:02}", k, k + 1) for k in range(MARKERS - 1)]
    model = SkeletonModel.of([f"marker_{k:02}" for k in range(MARKERS)], links)
    frame = typical(model)
    data = Encoder(model).encode(frame)
    text = hiros_schemas.text(NAME).encode()
    schema = Schema(id=1, name=NAME, encoding="ros2msg", data=text)
    generic = DecoderFactory().decoder_for("cdr", schema)
    if generic is None:
        raise SystemExit("the generic library does not take the schema")
    decoder, encoder = Decoder(model), Encoder(model)
    places = [(0, k, k, k, k * len(data), (k + 1) * len(data)) for k in range(MANY)]
    batch = Batch([Records(data * MANY, np.array(places, np.uint64), 0)], None)
    rows = [
        ("decode one", lambda: decoder.decode_message(data), 2000),
        (f"decode {MANY} at once", lambda: list(decoder.decode(batch)), 50),
        ("encode", lambda: encoder.encode(frame), 5000),
        ("learn the model", lambda: ModelBuilder().add(data, ""), 500),
        ("check a schema", lambda: check_schema(NAME, "ros2msg", text), 20),
        ("generic decode", lambda: generic(data), 3),
        ("copy of the bytes", lambda: bytearray(data), 5000),
    ]
    print(f"{PEOPLE} people, {MARKERS} markers, {MARKERS - 1} links, {len(data)} bytes")
    for name, action, repeats in rows:
        print(f"{name:18} {best(action, repeats):10.1f} us")


if __name__ == "__main__":
    main()
