"""Laws of reading, on random input."""

import generators as gen
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import hiros_schemas
from hiros_mcap.errors import LogError, SchemaError
from hiros_mcap.io.codec import Decoder, Encoder, ModelBuilder
from hiros_mcap.io.container import LogOrder
from hiros_mcap.io.layout import Layout, check_schema
from hiros_mcap.skeletons import Frame, SkeletonModel

NAME = hiros_schemas.SKELETON_GROUP
TEXT = hiros_schemas.text(NAME)
INT32 = st.integers(-(2**31), 2**31 - 1)

few = settings(max_examples=60, deadline=None)


@st.composite
def models(draw):
    """Any names and ids, links between any markers, some to a marker that is not there."""
    markers = sorted(draw(st.sets(INT32, max_size=6)))
    links = sorted(draw(st.sets(INT32, max_size=6)))
    names = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=9)
    slots = st.integers(-1, len(markers) - 1)
    return SkeletonModel(
        tuple(markers),
        tuple(draw(names) for _ in markers),
        tuple(links),
        tuple(draw(names) for _ in links),
        tuple(draw(slots) for _ in links),
        tuple(draw(slots) for _ in links),
        *draw(st.tuples(*[st.integers(0, 2**32 - 1)] * 2)),
    )


@few
@given(models(), st.integers(0, 5), st.integers(0, 2**32))
def test_people_survive_writing_and_reading_to_the_bit(model, n_people, seed):
    frame = gen.random_frame(np.random.default_rng(seed), model, n_people)
    if not n_people:
        frame = frame.replace(source=frame.frame_id)  # nobody is left to name the camera
    (decoded,) = Decoder(model, exact=True).decode_message(Encoder(model).encode(frame))
    assert gen.same(decoded, frame)


@few
@given(models().filter(lambda m: m.n_markers and m.n_links), st.floats(0, 1))
def test_a_marker_or_link_with_only_a_confidence_is_not_lost(model, confidence):
    frame = Frame.empty(1, model, source="camera", frame_id="map")
    frame.markers[0, 0, :3] = 1.0  # somebody
    frame.marker_confidences[0, -1] = frame.link_confidences[0, 0] = confidence
    (decoded,) = Decoder(model).decode_message(Encoder(model).encode(frame))
    assert gen.same(decoded, frame)


@few
@given(st.data(), st.integers(0, 2**32))
def test_a_damaged_message_is_an_error_or_a_frame(data, seed):
    model, frame = gen.random_case(seed, most=4)
    message = bytearray(Encoder(model).encode(frame))
    for _ in range(data.draw(st.integers(0, 3))):
        message[data.draw(st.integers(0, len(message) - 1))] ^= data.draw(st.integers(1, 255))
    del message[data.draw(st.integers(0, len(message))) :]
    for read in (Decoder(model).decode_message, lambda m: ModelBuilder().add(m, "/t")):
        try:
            read(bytes(message))
        except LogError as error:
            assert error.fault


@pytest.mark.parametrize("exact", [True, False])
@few
@given(st.binary(max_size=400))
def test_arbitrary_bytes_are_an_error_or_a_frame(exact, message):
    decoder = Decoder(SkeletonModel.of("ab", [("ab", 0, 1)]), exact=exact)
    try:
        assert all(isinstance(frame, Frame) for frame in decoder.decode_message(message))
    except LogError as error:
        assert error.fault


@few
@given(st.one_of(st.text(), st.text("[]<=#/ \n0123abcMSG:_-ADint8stringfloat64", max_size=200)))
def test_arbitrary_text_is_no_schema(text):
    text = text if text.strip() else "x"  # without a text, hiros knows the definition
    with pytest.raises(SchemaError):
        check_schema(NAME, "ros2msg", text.encode())


@settings(max_examples=200, deadline=None)
@given(st.data())
def test_a_changed_schema_is_an_error_or_a_layout(data):
    text = TEXT
    for _ in range(data.draw(st.integers(1, 4))):
        begin = data.draw(st.integers(0, len(text)))
        end = begin + data.draw(st.integers(0, 30))
        piece = data.draw(st.sampled_from(["", "\n", "[]", "[2]", "string x\n", "int8[] y\n", "="]))
        text = text[:begin] + piece + text[end:]
    try:
        layout = check_schema(NAME, "ros2msg", text.encode())
    except SchemaError as error:
        assert error.fault
    else:
        assert isinstance(layout, Layout)


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
