import struct

import generators as gen
import numpy as np
import pytest

import hiros_schemas
from hiros_mcap.body.rotations import Rigid
from hiros_mcap.errors import LogError, SchemaError
from hiros_mcap.io.channels import check_schema
from hiros_mcap.io.codec import Decoder, Encoder, ModelBuilder, RestPoses
from hiros_mcap.io.container import Batch, Records, Schema
from hiros_mcap.skeletons import Frame, SkeletonModel

NAME = hiros_schemas.SKELETON_GROUP
TEXT = hiros_schemas.text(NAME)


def stick(n_markers=2):
    """A chain of markers m0, m1, ... joined by links l0, l1, ..."""
    links = [(f"l{k}", k, k + 1) for k in range(n_markers - 1)]
    return SkeletonModel.of([f"m{k}" for k in range(n_markers)], links)


def full(model, n_people=1, seed=0):
    """A believable frame with every number given."""
    rng = np.random.default_rng(seed)
    frame = Frame.empty(n_people, model, stamp=5_000_000_007, source="cam", frame_id="map")
    for array in (frame.markers, frame.links, frame.boxes):
        array[:] = rng.normal(size=array.shape)
        array[..., 3:7] /= np.linalg.norm(array[..., 3:7], axis=-1, keepdims=True)
    for array in (frame.confidences, frame.marker_confidences, frame.link_confidences):
        array[:] = rng.random(array.shape)
    return frame


def learn(*messages):
    builder = ModelBuilder()
    for data in messages:
        builder.add(data, "/t")
    return builder.build()


def edited(model, change):
    """A message of one person of whom ``change`` altered something."""
    message = gen.message_of(full(model), model)
    change(message)
    return gen.generic_writer()(message)


def exact(model, data):
    """The only frame of a message, to the bit."""
    (frame,) = Decoder(model, exact=True).decode_message(data)
    return frame


def refusal(data, model=None):
    with pytest.raises(LogError) as caught:
        Decoder(model or stick()).decode_message(data)
    return str(caught.value)


# --- against the generic libraries -----------------------------------------------------------


@pytest.mark.parametrize("block", range(10))
def test_frames_encode_byte_for_byte_as_the_generic_writer_does(block):
    for seed in range(block * 30, block * 30 + 30):
        model, frame = gen.random_case(seed)
        assert Encoder(model).encode(frame) == gen.generic_writer()(gen.message_of(frame, model))


@pytest.mark.parametrize("block", range(10))
def test_messages_decode_as_the_generic_reader_does(block):
    for seed in range(1000 + block * 30, 1030 + block * 30):
        model, frame = gen.random_case(seed)
        data = Encoder(model).encode(frame)
        decoded = exact(model, data)
        assert gen.same(decoded, gen.frame_of(gen.generic_reader()(data), model))


@pytest.mark.parametrize("seed", range(40))
def test_big_endian_messages_give_the_same_frames(seed):
    model, frame = gen.random_case(2000 + seed)
    data = Encoder(model).encode(frame)
    assert gen.same(exact(model, gen.big_endian(data)), exact(model, data))


@pytest.mark.parametrize("n_markers", [15, 16, 21, 32])
def test_skeletons_of_any_size_round_trip_bit_exact(n_markers):
    model = stick(n_markers)
    frame = full(model, 3)
    data = Encoder(model).encode(frame)
    assert learn(data) == model
    assert gen.same(exact(model, data), frame)


@pytest.mark.parametrize("people", [1, 30, 900])
def test_a_message_gets_the_room_that_it_needs(people):
    model = stick(15)
    frame = full(model, people)
    assert gen.same(exact(model, Encoder(model).encode(frame)), frame)


def test_rosbags_reads_what_we_write():
    model, frame = gen.random_case(4000)
    data = Encoder(model).encode(frame)
    message = gen.rosbags_types().deserialize_cdr(data, NAME)
    assert gen.same(gen.frame_of(message, model), exact(model, data))


# --- damaged messages ------------------------------------------------------------------------


@pytest.mark.parametrize("swap", [bytes, gen.big_endian])
def test_every_truncation_is_refused_though_the_rest_lies_behind_it(swap):
    model = stick()
    data = swap(Encoder(model).encode(full(model, 2)))
    decoder = Decoder(model)
    for n in range(len(data)):
        with pytest.raises(LogError):
            decoder.decode_message(memoryview(data)[:n])
        with pytest.raises(LogError):
            ModelBuilder().add(memoryview(data)[:n], "/t")


def test_mutated_messages_are_refused_or_decode_as_the_generic_reader_does():
    model = stick(3)
    good = Encoder(model).encode(full(model, 2))
    decoder, rng = Decoder(model, exact=True), np.random.default_rng(1)
    compared = 0
    for _ in range(6000):
        data = mutate(rng, good)
        try:
            frames = decoder.decode_message(data)
        except LogError:
            continue
        if rng.random() < 0.1 and len(frames) == 1:
            compared += 1
            assert gen.same(frames[0], gen.frame_of(gen.generic_reader()(data), model))
    assert compared > 100


def mutate(rng, good):
    """One to three bytes changed, half of the time where names and counts are."""
    data = bytearray(good)
    for _ in range(rng.integers(1, 4)):
        near = rng.random() < 0.5
        at = int(rng.integers(60 if near else len(data)))
        data[at] = int(rng.choice([0, 1, 0x7F, 0x80, 0xFF, rng.integers(256)]))
    if rng.random() < 0.2:
        data = data[: rng.integers(len(data) + 1)]
    return bytes(data)


def test_mutated_messages_never_break_the_model_builder():
    model = stick(3)
    good = Encoder(model).encode(full(model, 2))
    rng, learnt = np.random.default_rng(2), 0
    for _ in range(3000):
        try:
            learnt += learn(mutate(rng, good)).n_markers > 0
        except LogError:
            continue
    assert learnt > 500


def test_words_set_to_extremes_anywhere_never_crash():
    model = stick()
    good = Encoder(model).encode(full(model))
    decoder = Decoder(model)
    for at in range(4, len(good) - 4, 4):
        for word in (0, 1, 2**31 - 1, 2**31, 2**32 - 1, len(good), 10**9):
            data = good[:at] + struct.pack("<I", word) + good[at + 4 :]
            for read in (decoder.decode_message, learn):
                try:
                    read(data)
                except LogError as error:
                    assert str(error)


def test_padding_of_a_payload_is_tolerated_and_no_more():
    model = stick()
    data = Encoder(model).encode(full(model))
    for n in range(4):
        assert exact(model, data + bytes(n)).n_people == 1
    assert "more than 3 bytes after" in refusal(data + bytes(4))


@pytest.mark.parametrize("head", [b"\0\3", b"\0\7", b"\0\x0a", b"\x12\x34"])
def test_other_encapsulations_are_refused_by_number(head):
    data = Encoder(stick()).encode(full(stick()))
    assert f"encapsulation 0x{head.hex()} is not" in refusal(head + data[2:])


def test_empty_payload_is_refused():
    assert "ends in the middle" in refusal(b"")


# --- what a message may not say --------------------------------------------------------------


def marker_of(message, k):
    return message["skeletons"][0]["markers"][k]


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({"id": 9, "name": "tail"}, "marker 9 'tail' is not in the skeleton model"),
        ({"name": "tail"}, "marker 1 has another name, 'tail'"),
        ({"id": 0, "name": "m0"}, "marker 0 comes twice in skeleton 0"),
        *[({"name": name}, "another name") for name in ("m10", "m", "", "M1", "m2")],
    ],
)
def test_markers_that_are_not_the_models_are_refused(change, fault):
    assert fault in refusal(edited(stick(), lambda m: marker_of(m, 1).update(change)))


def test_two_markers_of_one_id_are_named_before_other_cameras_are_blamed():
    data = edited(stick(), lambda m: marker_of(m, 1).update(id=0))
    with pytest.raises(LogError, match=r"/t: markers 'm?\w+' and '\w+' have one id, 0"):
        ModelBuilder().add(data, "/t")


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({"id": 5}, "link 5 'l0' is not in the skeleton model"),
        ({"name": "tail"}, "link 0 has another name, 'tail'"),
        ({"child_marker": 0}, "link 0 joins other markers"),
    ],
)
def test_links_that_are_not_the_models_are_refused(change, fault):
    data = edited(stick(), lambda m: m["skeletons"][0]["links"][0].update(change))
    assert fault in refusal(data)


def test_repeated_link_is_refused():
    def repeat(message):
        message["skeletons"][0]["links"] *= 2

    assert "link 0 comes twice in skeleton 0" in refusal(edited(stick(), repeat))


@pytest.mark.parametrize("where", ["header", "skeleton"])
def test_nanoseconds_beyond_a_second_are_refused(where):
    def late(message):
        stamps = {"header": message["header"]["stamp"], "skeleton": message["skeletons"][0]}
        (stamps[where] if where == "header" else stamps[where]["src_time"])["nanosec"] = 10**9

    assert "1e9 or more nanoseconds" in refusal(edited(stick(), late))


def test_a_thousand_people_are_read_and_one_more_is_refused():
    model = SkeletonModel.of([], [])
    encoder = Encoder(model)
    assert exact(model, encoder.encode(Frame.empty(1000, model))).n_people == 1000
    assert "more than 1000 skeletons" in refusal(encoder.encode(Frame.empty(1001, model)), model)


def test_string_beyond_64_kib_is_refused():
    encoder = Encoder(stick())
    frame = full(stick())
    assert exact(stick(), encoder.encode(frame.replace(frame_id="x" * 65535)))
    assert "longer than 65536" in refusal(encoder.encode(frame.replace(frame_id="x" * 65536)))


def test_string_without_its_end_is_refused():
    data = bytearray(Encoder(stick()).encode(full(stick())))
    at = data.index(b"map\0")
    data[at + 3] = ord("s")
    assert "without its final NUL" in refusal(bytes(data))


def test_string_that_is_no_utf8_is_refused():
    data = Encoder(stick()).encode(full(stick())).replace(b"map\0", b"m\xff\xfe\0")
    assert "not UTF-8" in refusal(data)


def test_empty_string_of_no_bytes_is_read():
    model = SkeletonModel.of([], [])
    data = Encoder(model).encode(Frame.empty(0, model))
    short = data[:12] + struct.pack("<II", 0, 0)  # length 0, then the count of people
    assert exact(model, short).frame_id == ""


# --- frames ----------------------------------------------------------------------------------


def test_source_and_frame_come_from_the_other_where_one_is_empty():
    encoder, frame = Encoder(stick()), full(stick())
    for source, frame_id, expected in (
        ("cam", "map", ("cam", "map")),
        ("", "map", ("map", "map")),
        ("cam", "", ("cam", "cam")),
    ):
        data = encoder.encode(frame.replace(frame_id=frame_id), source)
        decoded = exact(stick(), data)
        assert (decoded.source, decoded.frame_id) == expected


def several(model):
    """Three people, seen by a, b and a."""
    message = gen.message_of(full(model, 3), model)
    for person, source in zip(message["skeletons"], "aba", strict=True):
        person["src_frame"] = source
    return message


def mixed():
    return gen.generic_writer()(several(stick()))


def test_message_of_several_cameras_is_split():
    a, b = Decoder(stick()).decode_message(mixed())
    assert [a.source, b.source, a.frame_id] == ["a", "b", "map"]
    whole = full(stick(), 3)
    assert np.array_equal(a.markers, whole.markers[[0, 2]])
    assert np.array_equal(b.boxes, whole.boxes[[1]])


def test_times_before_the_epoch_and_unset_ones_are_kept():
    frame = full(stick(), 2).replace(stamp=-1, stamps=np.array([0, -2_500_000_000]))
    decoded = exact(stick(), Encoder(stick()).encode(frame))
    assert decoded.stamp == -1
    assert decoded.stamps.tolist() == [0, -2_500_000_000]


def test_a_time_before_1970_is_none_unless_bits_are_to_be_kept():
    frame = full(stick(), 2).replace(stamps=np.array([-2_500_000_000, 7]))
    (decoded,) = Decoder(stick()).decode_message(Encoder(stick()).encode(frame))
    assert decoded.stamps.tolist() == [0, 7]


def test_frames_own_their_arrays():
    decoder, data = Decoder(stick()), Encoder(stick()).encode(full(stick()))
    (first,), (second,) = decoder.decode_message(data), decoder.decode_message(data)
    first.markers[:] = 0.0
    assert gen.same(second, full(stick()))


def test_order_within_a_message_does_not_matter():
    def reverse(message):
        message["skeletons"][0]["markers"].reverse()

    data = edited(stick(5), reverse)
    assert gen.same(exact(stick(5), data), full(stick(5)))


@pytest.mark.parametrize("stamp", [2**31 * 10**9, -(2**31) * 10**9 - 1])
def test_stamp_that_a_message_cannot_hold_is_refused(stamp):
    for frame in (
        full(stick()).replace(stamp=stamp),
        full(stick()).replace(stamps=np.array([stamp])),
    ):
        with pytest.raises(LogError, match="1901 to 2038"):
            Encoder(stick()).encode(frame)


def test_arrays_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="do not fit"):
        Encoder(stick(3)).encode(full(stick(2)))
    with pytest.raises(ValueError, match="do not fit"):
        Encoder(stick()).encode(full(stick(), 2).replace(boxes=np.zeros((1, 22))))


def test_model_with_ids_out_of_order_is_refused():
    model = SkeletonModel((1, 0), ("a", "b"), (), (), (), (), 2, 0)
    with pytest.raises(ValueError, match="must increase"):
        Decoder(model)


# --- learning the model ----------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(30))
def test_model_is_learnt_from_partial_messages(seed):
    rng = np.random.default_rng(seed)
    model = gen.random_model(rng, 6, 5)
    encoder = Encoder(model)
    frames = [gen.random_frame(rng, model, 2) for _ in range(30)]
    assert learn(*map(encoder.encode, frames)) == model


def test_builder_is_complete_when_all_that_detectors_know_was_seen():
    model, builder, frame = stick(), ModelBuilder(), full(stick())
    for absent, done in (([1], False), ([], True)):
        frame.markers[0, absent] = frame.marker_confidences[0, absent] = np.nan
        builder.add(Encoder(model).encode(frame), "/t")
        assert builder.complete is done
        frame = full(stick())


def test_builder_without_messages_is_not_complete():
    assert not ModelBuilder().complete
    assert ModelBuilder().build().n_markers == 0


def test_cameras_that_name_a_marker_differently_are_refused():
    builder = ModelBuilder()
    builder.add(Encoder(stick()).encode(full(stick())), "/cam0")
    other = edited(stick(), lambda m: marker_of(m, 1).update(name="tail"))
    with pytest.raises(LogError, match="/cam1: marker 1 is 'tail' here and 'm1' on /cam0"):
        builder.add(other, "/cam1")


def test_cameras_whose_links_differ_are_refused():
    builder = ModelBuilder()
    builder.add(Encoder(stick()).encode(full(stick())), "/cam0")
    other = edited(stick(), lambda m: m["skeletons"][0]["links"][0].update(child_marker=0))
    with pytest.raises(LogError, match="/cam1: link 0 .* and 'l0' from 0 to 1 on /cam0"):
        builder.add(other, "/cam1")


def test_link_to_a_marker_that_nobody_shows_is_kept_without_it():
    data = edited(stick(), lambda m: m["skeletons"][0]["links"][0].update(child_marker=77))
    model = learn(data)
    assert model.link_children == (-1,)
    assert exact(model, data).n_people == 1


# --- cleaning --------------------------------------------------------------------------------


def clean(frame):
    """The frame after it was written and read, and what was taken out."""
    decoded = batch_of(stick(), [Encoder(stick()).encode(frame)])
    (frame,) = frames_of(decoded, 0)
    return frame, dict(decoded.cleaned.get(0, {}))


def test_a_frame_with_nothing_wrong_stays_as_it_is():
    for frame in (full(stick(), 3), Frame.empty(0, stick(), source="b", frame_id="b")):
        cleaned, counts = clean(frame)
        assert gen.same(cleaned, frame)
        assert counts == {}


def spoiled(**changes):
    """Clean a frame in which some numbers of the first person were changed."""
    frame = full(stick())
    for name, (place, value) in changes.items():
        getattr(frame, name)[0][place] = value
    return frame, *clean(frame)


@pytest.mark.parametrize("value", [np.inf, -np.inf, 1.1e4, -1e300])
def test_absurd_number_unsets_its_whole_vector(value):
    frame, cleaned, counts = spoiled(markers=((1, 8), value))
    assert counts == {"absurd number": 1}
    assert np.isnan(cleaned.markers[0, 1, 7:10]).all()
    frame.markers[0, 1, 7:10] = np.nan
    assert gen.same(frame, cleaned)


@pytest.mark.parametrize(
    ("element", "place", "value", "kind", "unset"),
    [
        ("links", (0, 2), np.nan, "incomplete vector", (0, slice(3))),
        ("links", (0, slice(3, 7)), 0.0, "quaternion of length 0", (0, slice(3, 7))),
        ("boxes", (21,), np.inf, "absurd number", (slice(19, None),)),
        ("link_confidences", (0,), np.inf, "absurd number", (0,)),
    ],
)
def test_what_is_wrong_is_unset_and_nothing_else(element, place, value, kind, unset):
    frame, cleaned, counts = spoiled(**{element: (place, value)})
    assert counts == {kind: 1}
    getattr(frame, element)[0][unset] = np.nan
    assert gen.same(frame, cleaned)


def test_quaternion_of_wrong_length_is_normalised():
    _, cleaned, counts = spoiled(links=((0, slice(3, 7)), [0.0, 0.0, 3.0, 4.0]))
    assert counts == {"quaternion normalised": 1}
    assert cleaned.links[0, 0, 3:7] == pytest.approx([0, 0, 0.6, 0.8])


def test_small_error_of_a_quaternion_is_put_right_without_a_word():
    _, cleaned, counts = spoiled(links=((0, slice(3, 7)), [0.0, 0.0, 0.0, 1.0005]))
    assert counts == {}
    assert cleaned.links[0, 0, 3:7].tolist() == [0, 0, 0, 1]


def test_quaternion_of_float32_precision_is_left_alone():
    frame, cleaned, _ = spoiled(links=((0, slice(3, 7)), [0.0, 0.0, 0.0, 1.0 + 2e-7]))
    assert gen.same(cleaned, frame)


@pytest.mark.parametrize(
    ("value", "kept", "kind"),
    [
        (1.5, 1.0, "confidence above 1"),
        (100.0, 1.0, "confidence above 1"),
        (-0.1, np.nan, "negative confidence"),
        (-1.0, np.nan, "negative confidence"),
        (-np.inf, np.nan, "absurd number"),
    ],
)
def test_confidence_out_of_range(value, kept, kind):
    _, cleaned, counts = spoiled(marker_confidences=((1,), value))
    assert counts == {kind: 1}
    np.testing.assert_equal(cleaned.marker_confidences[0, 1], kept)


def test_confidence_of_a_person_out_of_range():
    frame = full(stick(), 2).replace(confidences=np.array([-1.0, 7.0]))
    cleaned, counts = clean(frame)
    assert counts == {"confidence above 1": 1, "negative confidence": 1}
    np.testing.assert_equal(cleaned.confidences, [np.nan, 1.0])


def test_cleaning_twice_changes_nothing_more():
    once, _ = clean(
        full(stick()).replace(boxes=gen.random_numbers(np.random.default_rng(1), 1, 22))
    )
    again, counts = clean(once)
    assert gen.same(again, once)
    assert counts == {}


# --- schemas ---------------------------------------------------------------------------------


def check(text, name=NAME, encoding="ros2msg"):
    data = text if isinstance(text, bytes) else text.encode()
    check_schema(Schema(1, data, encoding, name), "/t")


@pytest.mark.parametrize(
    "text",
    [
        TEXT,
        TEXT.replace("int32 id\n", "int32 id # who\n\n   # a comment\nint32 LEFT=1\n"),
        TEXT.replace("string name", "string<=64 name").replace("Link[] links", "Link[<=99] links"),
        TEXT.replace("MSG: geometry_msgs/", "MSG: geometry_msgs/msg/"),
        TEXT.replace("float64 w\n", "float64 w 1\n").replace("\n", "\r\n"),
        TEXT.replace("MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n", "MSG: a/B\n"),
    ],
)
def test_schema_with_the_published_fields_is_read_directly(text):
    check(text)
    check(text, "hiros_skeleton_msgs/SkeletonGroup")


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        (TEXT.replace("float64 height", "float64 tall"), "field .*bounding_box.tall where"),
        (TEXT.replace("int32 id\n", "int32 id\nuint8[] extra\n"), r"extra\[\] where .* is exp"),
        (TEXT.replace("int32 id\nstring name\n", "string name\nint32 id\n"), "name where .*.id is"),
        (TEXT.replace("float64 confidence", "float32 confidence"), "is float32 instead of float64"),
        (TEXT.replace("Marker[] markers", "Marker[2] markers"), r"markers\[2\].id where"),
        (TEXT.replace("Time stamp\n", "Time stamp\nuint32 seq\n"), "seq where .*frame_id is"),
        (TEXT.replace("[] skeletons\n", "[] skeletons\nbool x\n"), "field x is unknown"),
        (TEXT.replace("Link[] links\n", ""), r"field skeletons\[\].links\[\].id is missing"),
        (TEXT.replace("MSG: hiros_skeleton_msgs/Box", "MSG: hiros_skeleton_msgs/B"), "Box is miss"),
        (TEXT.replace("float64 height", "Box inner\nfloat64 height"), "contains itself"),
        (TEXT.replace("int32 id", "int32 id id2 = 3", 1) + "\n" + "=" * 80, "lacks its line"),
        (TEXT + "\n" + "=" * 80 + "\nMSG: std_msgs/Header\nint8 x\n", "defined twice"),
        (TEXT.replace("string name", "???"), "no field"),
        ("int8 x", "field x where"),
        ("\0\0garbage", "no field"),
    ],
)  # fmt: skip
def test_other_schemas_are_refused_by_their_first_fault(text, fault):
    with pytest.raises(SchemaError, match=f"^/t: .*{fault}"):
        check(text)


def test_schema_of_exponential_size_is_refused():
    levels = [f"{'=' * 80}\nMSG: a/T{k}\nT{k + 1} x\nT{k + 1} y\n" for k in range(20)]
    bomb = TEXT.replace("float64 height", "a/T0 t\nfloat64 height")
    last = f"{'=' * 80}\nMSG: a/T20\nint8 x\n"
    with pytest.raises(SchemaError, match="more than 4096 fields"):
        check("\n".join([bomb, *levels, last]))


@pytest.mark.parametrize(
    ("name", "encoding", "fault"),
    [
        (NAME, "ros2idl", "cannot be parsed"),
        (NAME, "", "schema encoding '' is neither ros2msg nor ros2idl"),
        ("std_msgs/msg/String", "ros2msg", "is not hiros_skeleton_msgs"),
        ("SkeletonGroup", "ros2msg", "not the name of a message type"),
    ],
)
def test_other_kinds_of_schema_are_refused(name, encoding, fault):
    with pytest.raises(SchemaError, match=fault):
        check(TEXT, name, encoding)


def test_schema_that_is_no_text_is_refused():
    with pytest.raises(SchemaError, match="not UTF-8"):
        check(b"\xff\xfe")
    with pytest.raises(SchemaError, match="larger than"):
        check(b"#" * (2**20 + 1))


# --- all messages of a chunk at once ---------------------------------------------------------


def records_of(messages, offset=0):
    """Messages in one run of bytes with something in between."""
    data, rows = b"", []
    for k, message in enumerate(messages):
        data += b"junk!"
        rows.append((0, k, k, k, len(data), len(data) + len(message)))
        data += message
    return Records(data + b"end", np.array(rows, np.uint64).reshape(-1, 6), offset)


def batch_of(model, messages, poses=None):
    """Messages decoded at once, from two chunks."""
    half = len(messages) // 2
    chunks = [records_of(messages[:half]), records_of(messages[half:], 10**6)]
    (decoded,) = Decoder(model, poses=poses).decode(Batch(chunks, None))
    return decoded


def frames_of(decoded, i):
    return [
        Frame(decoded.stamps[i], 0, source, frame_id, decoded.people.at(slice(begin, end)))
        for source, frame_id, begin, end in decoded.parts[i]
    ]


def odd_messages(model):
    """Whole messages, truncated, damaged and big-endian ones, some with impossible numbers."""
    rng, messages = np.random.default_rng(5), []
    for seed in range(60):
        frame = full(model, seed % 4, seed)
        if seed % 5 == 1 and frame.n_people:
            frame.markers[0, 1, 0] = np.inf
            frame.confidences[0] = (3.0, 0.5, -1.0)[seed % 3]
        if seed % 5 == 2:
            frame.links[:, 0] = np.nan
        data = bytearray(Encoder(model).encode(frame))
        if seed % 3 == 1:
            data = data[: rng.integers(len(data))]
        elif seed % 3 == 2:
            data[rng.integers(min(len(data), 300))] ^= int(rng.integers(1, 256))
        messages.append(bytes(data))
    return [*messages, gen.big_endian(Encoder(model).encode(full(model, 2)))]


def test_a_batch_of_many_says_what_batches_of_one_say():
    model = stick(4)
    messages = [*odd_messages(model), gen.generic_writer()(several(model))]
    many = batch_of(model, messages)
    for i, message in enumerate(messages):
        one = batch_of(model, [message])
        assert one.faults.get(0) == many.faults.get(i)
        assert one.cleaned.get(0) == many.cleaned.get(i)
        pairs = zip(frames_of(one, 0), frames_of(many, i), strict=True)
        assert all(gen.same(a, b) for a, b in pairs)
    assert 10 < len(many.faults) < len(messages) - 10
    assert len(many.parts[-1]) == 2


def test_a_batch_may_be_empty():
    assert batch_of(stick(), []).parts == []


def test_a_batch_that_needs_much_memory_is_decoded_in_parts(monkeypatch):
    messages = [Encoder(stick()).encode(full(stick(), 3, seed)) for seed in range(9)]
    monkeypatch.setattr(Decoder, "_MOST", 4000)  # 3 people take 1968 bytes
    parts = list(Decoder(stick()).decode(Batch([records_of(messages)], 99)))
    assert [part.until for part in parts] == [2, 4, 6, 7, 99]
    assert [len(part.parts) for part in parts] == [2, 2, 2, 1, 2]
    found = [f for part in parts for i in range(len(part.parts)) for f in frames_of(part, i)]
    assert all(gen.same(f, full(stick(), 3, seed)) for seed, f in enumerate(found))


def without_motion(frame):
    for states in (frame.markers, frame.links):
        states[..., 7:] = np.nan
    return frame


def test_slim_people_have_poses_only_until_a_message_holds_a_velocity_or_acceleration():
    model, still = stick(), without_motion(full(stick()))
    decoder = Decoder(model, slim=True)
    (first,) = decoder.decode_message(Encoder(model).encode(still))
    np.testing.assert_array_equal(first.markers, still.markers[..., :7])
    np.testing.assert_array_equal(first.links, still.links[..., :7])
    assert np.isnan(first.velocities).all()
    assert np.isnan(first.accelerations).all()
    still.links[0, 0, 16:] = 0.5
    (second,) = decoder.decode_message(Encoder(model).encode(still))
    assert gen.same(second, still)


def test_a_slim_batch_says_what_another_says():
    model = stick(4)
    messages = [Encoder(model).encode(without_motion(full(model, 2))), *odd_messages(model)]
    slim = Decoder(model, slim=True).decode(Batch([records_of(messages)], None))
    (part,), whole = slim, batch_of(model, messages)
    assert (part.faults, part.cleaned, part.parts) == (whole.faults, whole.cleaned, whole.parts)
    for i in range(len(messages)):
        pairs = zip(frames_of(part, i), frames_of(whole, i), strict=True)
        assert all(gen.same(a, b) for a, b in pairs)


def test_slim_people_move_as_others_do():
    turn = Rigid(np.array([0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)]), np.array([1.0, 2.0, 3.0]))
    data = Encoder(stick()).encode(without_motion(full(stick(), 2)))
    moved = []
    for slim in (False, True):
        decoder = Decoder(stick(), poses=RestPoses("hall", {"map": turn}.get), slim=slim)
        moved += decoder.decode_message(data)
    for name in ("markers", "links"):
        whole, part = (getattr(frame, name) for frame in moved)
        np.testing.assert_array_equal(whole[..., :7], part)
        assert part.shape[-1] == 7


def test_the_halves_of_a_batch_are_the_earlier_and_the_later_messages():
    backwards = records_of([b"a"] * 4)
    backwards.messages[:, 2] = [40, 10, 30, 20]
    early, late = Batch([backwards], 99).halves()
    assert sorted(early.records[0].messages[:, 2].tolist()) == [10, 20]
    assert sorted(late.records[0].messages[:, 2].tolist()) == [30, 40]
    assert (early.until, late.until) == (30, 99)


def test_a_batch_moves_people_by_the_poses_that_it_knows():
    turn = Rigid(np.array([0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)]), np.array([1.0, 2.0, 3.0]))
    frames = [full(stick(), 2).replace(frame_id=name) for name in ("map", "/map", "other", "hall")]
    messages = [Encoder(stick()).encode(frame) for frame in frames]
    poses = RestPoses("hall", {"map": turn, "hall": turn}.get)
    decoded = batch_of(stick(), messages, poses)
    moved = [frame for k in range(len(messages)) for frame in frames_of(decoded, k)]
    assert [frame.frame_id for frame in moved] == ["hall", "hall", "other", "hall"]
    x, y, z = np.moveaxis(frames[0].positions, -1, 0)
    expected = np.stack([1 - y, 2 + x, 3 + z], axis=-1)
    for frame in moved[:2]:
        np.testing.assert_allclose(frame.positions, expected, atol=1e-12)
    for frame in moved[2:]:
        np.testing.assert_array_equal(frame.positions, frames[0].positions)
