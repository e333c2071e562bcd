import re
import xml.etree.ElementTree as ET

import generators as gen
import pytest

import hiros_schemas

# The fields of the published package, in order.
PUBLISHED = {
    "KinematicState": "geometry_msgs/Pose pose, geometry_msgs/Twist velocity, "
    "geometry_msgs/Accel acceleration",
    "Box": "hiros_skeleton_msgs/KinematicState center, float64 height, float64 length, "
    "float64 width",
    "Marker": "int32 id, string name, float64 confidence, "
    "hiros_skeleton_msgs/KinematicState center",
    "Link": "int32 id, string name, int32 parent_marker, int32 child_marker, float64 confidence, "
    "hiros_skeleton_msgs/KinematicState center",
    "Skeleton": "int32 id, builtin_interfaces/Time src_time, string src_frame, "
    "uint32 max_markers, uint32 max_links, float64 confidence, "
    "hiros_skeleton_msgs/Box bounding_box, hiros_skeleton_msgs/Marker[] markers, "
    "hiros_skeleton_msgs/Link[] links",
    "SkeletonGroup": "std_msgs/Header header, hiros_skeleton_msgs/Skeleton[] skeletons",
    # Ours.
    "SkeletonGroupUncertainty": "std_msgs/Header header, string[] cameras, int32[] markers, "
    "hiros_skeleton_msgs/SkeletonUncertainty[] skeletons",
    "SkeletonUncertainty": "int32 id, float32[] deviations, uint32[] cameras",
}
PUBLISHED["StampedSkeleton"] = f"std_msgs/Header header, {PUBLISHED['Skeleton']}"

ALL = (*hiros_schemas.NAMES, hiros_schemas.TF_MESSAGE)


def fields(name):
    found = hiros_schemas.parse(name, hiros_schemas.text(name))[hiros_schemas.short_name(name)]
    return ", ".join(f"{field.type}{field.array} {field.name}" for field in found)


@pytest.mark.parametrize("name", PUBLISHED)
def test_fields_are_the_published_ones_in_order(name):
    assert fields(f"hiros_skeleton_msgs/msg/{name}") == PUBLISHED[name]


def test_all_types_are_there():
    assert [name.split("/")[-1] for name in hiros_schemas.NAMES] == sorted(PUBLISHED)


@pytest.mark.parametrize("name", hiros_schemas.NAMES)
def test_hashes_are_those_of_rosbags(name):
    assert hiros_schemas.type_hash(name) == gen.rosbags_types().hash_rihs01(name)


def test_hash_of_a_group_is_the_one_that_recorders_write():
    digest = "c67adbc57f0a3095ec378923227ad9b404d3e7e5bbf0dcca7d9f732c73513730"
    assert hiros_schemas.type_hash(hiros_schemas.SKELETON_GROUP) == f"RIHS01_{digest}"


def test_hash_of_transforms_is_that_of_rosbags():
    store = gen.rosbags_types()
    assert hiros_schemas.type_hash("tf2_msgs/TFMessage") == store.hash_rihs01(ALL[-1])


@pytest.mark.parametrize("name", ALL)
def test_text_defines_every_type_once_and_has_no_comments(name):
    text = hiros_schemas.text(name)
    titles = re.findall(r"^={80}\nMSG: (\w+/\w+)$", text, re.MULTILINE)
    assert len(titles) == len(set(titles)) == text.count("=" * 80)
    assert "#" not in text
    assert hiros_schemas.leaves(hiros_schemas.parse(name, text), name)


@pytest.mark.parametrize("name", ALL)
def test_texts_parse_in_rosbags_as_in_the_generic_library(name):
    from mcap_ros2._dynamic import generate_dynamic
    from rosbags.typesys import get_types_from_msg

    text = hiros_schemas.text(name)
    others = re.findall(r"MSG: (\w+)/(\w+)", text)
    assert set(get_types_from_msg(text, name)) == {name, *(f"{p}/msg/{t}" for p, t in others)}
    assert name in generate_dynamic(name, text)


def test_text_of_transforms_is_as_recorders_write_it():
    head, block, *_ = hiros_schemas.text(hiros_schemas.TF_MESSAGE).split("=" * 80)
    assert head == "geometry_msgs/TransformStamped[] transforms\n\n"
    assert block.startswith("\nMSG: geometry_msgs/TransformStamped\nstd_msgs/Header header\n")


def test_short_and_long_names_mean_the_same():
    assert hiros_schemas.text("hiros_skeleton_msgs/Box") == hiros_schemas.text(
        "hiros_skeleton_msgs/msg/Box"
    )


@pytest.mark.parametrize("name", ["std_msgs/msg/String", "hiros_skeleton_msgs/msg/../Box"])
def test_other_names_are_refused(name):
    with pytest.raises((KeyError, hiros_schemas.DefinitionError)):
        hiros_schemas.text(name)


def test_ros_package_names_every_file_and_every_package():
    folder = hiros_schemas.ROS_PACKAGE
    files = {f"msg/{path.name}" for path in (folder / "msg").iterdir()}
    cmake = (folder / "CMakeLists.txt").read_text(encoding="utf-8")
    assert set(re.findall(r'"(msg/\w+\.msg)"', cmake)) == files
    assert {f"msg/{name}.msg" for name in PUBLISHED} == files
    tree = ET.parse(folder / "package.xml")
    needed = {element.text for element in tree.iter("depend")}
    assert needed == set(re.search(r"DEPENDENCIES ([\w ]+)", cmake)[1].split())
    assert needed == {"builtin_interfaces", "geometry_msgs", "std_msgs"}


@pytest.mark.parametrize(
    ("text", "field"),
    [
        ("float64 x 1.5 # m", hiros_schemas.Field("x", "float64", "")),
        ("string<=5[<=3]   names", hiros_schemas.Field("names", "string<=5", "[<=3]")),
        ("Other[4] o", hiros_schemas.Field("o", "a/Other", "[4]")),
        ("b/msg/Other o", hiros_schemas.Field("o", "b/Other", "")),
    ],
)
def test_field_lines(text, field):
    assert hiros_schemas.parse("a/T", f"int32 X = 4\n{text}\n")["a/T"] == (field,)


@pytest.mark.parametrize(
    "text", ["float64", "float64 1x", "float64[0] x", "Other<=3 x", "a/b/c/d x", "int8 x\nint8 x"]
)
def test_lines_that_are_no_fields_are_refused(text):
    with pytest.raises(hiros_schemas.DefinitionError):
        hiros_schemas.parse("a/T", text)


def test_empty_message_takes_a_byte():
    types = hiros_schemas.parse("a/T", f"E e\n{'=' * 80}\nMSG: a/E\n")
    assert hiros_schemas.leaves(types, "a/T") == [
        ("e.structure_needs_at_least_one_member", "uint8")
    ]
