"""Laws of reading, on random input."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import hiros_schemas
from hiros_mcap.errors import SchemaError
from hiros_mcap.io.channels import check_schema
from hiros_mcap.io.container import LogOrder, Schema

NAME = hiros_schemas.SKELETON_GROUP
TEXT = hiros_schemas.text(NAME)
LEAVES = hiros_schemas.leaves(hiros_schemas.parse(NAME, TEXT), NAME)

few = settings(max_examples=60, deadline=None)


@settings(max_examples=200, deadline=None)
@given(st.data())
def test_a_changed_schema_is_an_error_or_the_published_one(data):
    text = TEXT
    for _ in range(data.draw(st.integers(1, 4))):
        begin = data.draw(st.integers(0, len(text)))
        end = begin + data.draw(st.integers(0, 30))
        piece = data.draw(st.sampled_from(["", "\n", "[]", "[2]", "string x\n", "int8[] y\n", "="]))
        text = text[:begin] + piece + text[end:]
    try:
        check_schema(Schema(1, text.encode(), "ros2msg", NAME), "/t")
    except SchemaError as error:
        assert error.fault
    else:
        time = "builtin_interfaces/Time"  # recorders may leave out what ROS 2 has built in
        whole = hiros_schemas.parse(NAME, TEXT)
        changed = {time: whole[time], **hiros_schemas.parse(NAME, text)}
        assert hiros_schemas.leaves(changed, NAME) == LEAVES


@pytest.mark.parametrize("until", [None, 5])
def test_a_chunk_without_messages_hands_out_nothing(until):
    order = LogOrder[str]()
    order.add("empty", np.empty((0, 3), np.uint64))
    assert list(order.before(until)) == []


@few
@given(st.lists(st.lists(st.integers(0, 20), max_size=6), max_size=6), st.integers(0, 2**32))
def test_messages_of_chunks_in_any_order_come_by_time_and_then_by_place(chunks, seed):
    """Chunks begin in the order of their earliest message, as a file's chunks are read."""
    order, rng = LogOrder[int](), np.random.default_rng(seed)
    chunks = sorted(filter(None, chunks), key=min)
    offsets = rng.permutation(len(chunks))
    keys = [[(t, offsets[k], i) for i, t in enumerate(c)] for k, c in enumerate(chunks)]
    found = []
    for k, rows in enumerate(keys):
        order.add(k, np.array(rows, np.uint64))
        until = min(chunks[k + 1]) if k + 1 < len(chunks) else None
        found += [keys[item][row] for item, run in order.before(until) for row in run]
        assert until is None or len(found) == sum(t < until for c in chunks[: k + 1] for t in c)
    assert found == sorted(row for rows in keys for row in rows)
