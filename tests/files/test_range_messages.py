"""Ranges in the messages that radios' drivers publish, and in one that the user has described."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from uwbslam_jax.errors import LogError
from uwbslam_jax.files import Recording, settings_file
from uwbslam_jax.files.range_layouts import fields_of_type, find_layout
from uwbslam_jax.files.range_messages import Options, topic_name
from uwbslam_jax.measurements import RangeMessage
from uwbslam_jax.settings import UwbSettings

T0 = 1_700_000_000_000_000_000
LOG = T0 + 7
HEAD = "std_msgs/Header header\n"
SEPARATOR = "=" * 80 + "\n"
Fields = dict[str, Any]


def store_of(name: str, text: str, *, ros1: bool = False) -> Any:
    store: Any = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    store.register({n: d for n, d in get_types_from_msg(text, name).items() if n not in store.fielddefs})
    return store


def fill(store: Any, name: str, fields: Fields) -> Any:
    """A message with these fields, all others 0, empty or NaN."""
    values: Fields = {}
    for label, (kind, about) in store.fielddefs[name][1]:
        given = fields.get(label)
        if kind.name in ("ARRAY", "SEQUENCE"):
            (inner, of), size = about
            if inner.name == "NAME":
                values[label] = [fill(store, of, each) for each in given or []]
            elif of[0] == "string":
                values[label] = given or [""] * (size if kind.name == "ARRAY" else 0)
            else:
                values[label] = np.array(given if given is not None else np.zeros(size), of[0])
        elif about == "std_msgs/msg/Header" and not isinstance(given, dict):
            time = store.types["builtin_interfaces/msg/Time"](*divmod(T0, 10**9))
            head = {"seq": 1} if "seq" in store.types[about].__dataclass_fields__ else {}
            values[label] = store.types[about](**head, stamp=time, frame_id=given or "")
        elif kind.name == "NAME":
            values[label] = fill(store, about, given or {})
        else:
            values[label] = given if given is not None else {"string": "", "bool": False}.get(about[0], 0)
    return store.types[name](**values)


def record(path: Path, name: str, text: str, messages: Sequence[tuple[str, Fields]], *, ros1: bool = False) -> Path:
    """A recording of messages of one type, by topic."""
    store = store_of(name, text, ros1=ros1)
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        definition = store.generate_msgdef(name, ros_version=1 if ros1 else 2)[0].encode()
        schema_name = name.replace("/msg/", "/") if ros1 else name
        schema = writer.register_schema(schema_name, "ros1msg" if ros1 else "ros2msg", definition)
        channels: dict[str, int] = {}
        for k, (topic, fields) in enumerate(messages):
            if topic not in channels:
                channels[topic] = writer.register_channel(topic, "ros1" if ros1 else "cdr", schema)
            pack = store.serialize_ros1 if ros1 else store.serialize_cdr
            writer.add_message(channels[topic], LOG + k, bytes(pack(fill(store, name, fields), name)), LOG + k)
        writer.finish()
    return path


def read(path: Path, robot_id: int = 0, **uwb: Any) -> list[tuple[int, int, int, float]]:
    reader = Recording(path, robot_id=robot_id, uwb=UwbSettings(**uwb))
    found = [m for m in reader if isinstance(m, RangeMessage)]
    return [(m.stamp, m.source, m.target, round(m.range, 4)) for m in found]


LINKTRACK = "uint8 role\nuint8 id\nuint32 local_time\nuint32 system_time\nfloat32 voltage\n"
POSES = "float32[3] pos_3d\nfloat32[3] eop_3d\nfloat32[3] vel_3d\n"
DISTANCES = [0.0, 2.5, 0.0, 3.5, 0.0, 0.0, 0.0, 0.0]
CASES: dict[str, tuple[str, str, Fields, list[tuple[int, int, int, float]]]] = {
    "uwb_driver, long": (
        "uwb_driver/msg/UwbRange",
        HEAD + "uint8 requester_id\nuint8 responder_id\nint8 requester_idx\nuint8 range_status\nuint16 antenna\n"
        "float32 distance\nfloat32 coarse_range\nfloat32 filtered_range\nfloat32 distance_err\n",
        {"requester_id": 4, "responder_id": 9, "distance": 2.5, "coarse_range": 7.0},
        [(T0, 4, 9, 2.5)],
    ),
    "uwb_driver, short": (
        "uwb_driver/msg/UwbRange",
        HEAD + "uint8 responder_id\nfloat32 distance\nfloat32 distance_err\ngeometry_msgs/Point responder_location\n",
        {"responder_id": 9, "distance": 2.5},
        [(T0, 0, 9, 2.5)],
    ),
    "gtec Ranging": (
        "gtec_msgs/msg/Ranging",
        "int16 anchor_id\nint16 tag_id\nint32 range\nint32 seq\nfloat64 rss\nfloat64 error_estimation\n",
        {"anchor_id": 9, "tag_id": 4, "range": 2500},
        [(LOG, 4, 9, 2.5)],
    ),
    "gtec Ranging, ROS 1 spelling, tag and anchor of one id": (
        "gtec_msgs/msg/Ranging",
        "int16 anchorId\nint16 tagId\nint32 range\nint32 seq\n",
        {"anchorId": 4, "tagId": 4, "range": 2500},
        [(LOG, 4, 260, 2.5)],
    ),
    "gtec PozyxRanging": (
        "gtec_msgs/msg/PozyxRanging",
        "int32 origin_id\nint16 origin_type\nint32 destination_id\nint16 destination_type\nint32 range\n",
        {"origin_id": 0x6E2F, "destination_id": 0x6E30, "range": 2500},
        [(LOG, 0x6E2F, 0x6E30, 2.5)],
    ),
    "TwoWayRangeStamped": (
        "uwb_msgs/msg/TwoWayRangeStamped",
        HEAD + "uint8 UWB_ID1\nuint8 UWB_ID2\nstring type_ID1\nuint8 LOS\nfloat64 range_raw\nfloat64 range_corr\n",
        {"UWB_ID1": 4, "UWB_ID2": 9, "range_raw": 2.7, "range_corr": 2.5},
        [(T0, 4, 9, 2.5)],
    ),
    "Tagframe0": (
        "nlink_parser/msg/LinktrackTagframe0",
        LINKTRACK + POSES + "float32[8] dis_arr\nfloat32[4] quaternion\n",
        {"role": 2, "id": 3, "dis_arr": DISTANCES},
        [(LOG, 3, 1, 2.5), (LOG, 3, 259, 3.5)],
    ),
    "Anchorframe0": (
        "nlink_parser/msg/LinktrackAnchorframe0",
        LINKTRACK + f"x/Tag[] nodes\n{SEPARATOR}MSG: x/Tag\nuint8 id\nfloat32[3] pos_3d\nfloat32[8] dis_arr\n",
        {"id": 1, "nodes": [{"id": 6, "dis_arr": DISTANCES}, {"id": 7, "dis_arr": DISTANCES}]},
        [(LOG, 6, 1, 2.5), (LOG, 6, 3, 3.5), (LOG, 7, 1, 2.5), (LOG, 7, 3, 3.5)],
    ),
    "Nodeframe4": (
        "nlink_parser/msg/LinktrackNodeframe4",
        LINKTRACK + f"x/Tag[] tags\n{SEPARATOR}MSG: x/Tag\nuint8 id\nfloat32 voltage\nx/Anchor[] anchors\n"
        f"{SEPARATOR}MSG: x/Anchor\nuint8 id\nfloat32 dis\n",
        {"id": 1, "tags": [{"id": 6, "anchors": [{"id": 2, "dis": 2.5}, {"id": 6, "dis": 3.5}]}]},
        [(LOG, 6, 2, 2.5), (LOG, 6, 262, 3.5)],
    ),
    "Nodeframe5": (
        "nlink_parser/msg/LinktrackNodeframe5",
        LINKTRACK.replace("uint8 id", "uint32 id")
        + f"x/N[] nodes\n{SEPARATOR}MSG: x/N\nuint8 role\nuint32 id\nfloat32 dis\nfloat32 fp_rssi\nfloat32 rx_rssi\n",
        {"role": 2, "id": 100000, "nodes": [{"role": 1, "id": 200000, "dis": 2.5}]},
        [(LOG, 100000, 200000, 2.5)],
    ),
    "RangeArray, each with a stamp and names": (
        "uwb_msgs/msg/RangeArray",
        HEAD
        + f"uwb_msgs/Range[] ranges\n{SEPARATOR}MSG: uwb_msgs/Range\nbuiltin_interfaces/Time stamp\nstring anchorid\n"
        "string listenerid\nbool valid_range\nfloat32 distance\n",
        {
            "ranges": [
                {
                    "stamp": {"sec": 5, "nanosec": 6},
                    "anchorid": "a9",
                    "listenerid": "tag4",
                    "valid_range": True,
                    "distance": 2.5,
                },
                {"anchorid": "a8", "listenerid": "tag4", "valid_range": False, "distance": 3.5},
            ]
        },
        [(5 * 10**9 + 6, 4, 9, 2.5)],
    ),
    "UwbRangeArray": (
        "any_msgs/msg/UwbRangeArray",
        HEAD
        + f"string tag_id\nany_msgs/UwbRange[] ranges\n{SEPARATOR}MSG: any_msgs/UwbRange\nstring id\nfloat64 range\n",
        {"tag_id": "0x0ca8", "ranges": [{"id": "4F1B", "range": 2.5}, {"id": "anchor", "range": 3.5}]},
        [(T0, 0x0CA8, 0x4F1B, 2.5), (T0, 0x0CA8, 256, 3.5)],
    ),
    "mcu_msgs": (
        "mcu_msgs/msg/UWBRanging",
        HEAD + f"uint8 tag_id\nmcu_msgs/UWBRange[] ranges\nfloat32 temperature\n{SEPARATOR}MSG: mcu_msgs/UWBRange\n"
        "uint8 tag_id\nuint8 anchor_id\nfloat32 distance_cm\n",
        {"tag_id": 4, "ranges": [{"tag_id": 4, "anchor_id": 9, "distance_cm": 250.0}]},
        [(T0, 4, 9, 2.5)],
    ),
    "an array of anchors, the tag not named": (
        "dwm_msgs/msg/UWBMeas",
        HEAD + f"x/Anchor[] anchors\n{SEPARATOR}MSG: x/Anchor\nstring id\nfloat64 x\nfloat64 y\nfloat64 distance\n",
        {"anchors": [{"id": "DD05", "distance": 2.5}]},
        [(T0, 0, 0xDD05, 2.5)],
    ),
    "lists beside each other": (
        "any_msgs/msg/UwbDistances",
        HEAD + "uint16[] anchor_ids\nfloat32[] distances\n",
        {"anchor_ids": [9, 8], "distances": [2.5, 3.5]},
        [(T0, 0, 9, 2.5), (T0, 0, 8, 3.5)],
    ),
    "addresses as bytes": (
        "any_msgs/msg/UwbRanging",
        HEAD + "uint8[2] source_id\nuint8[8] target_id\nfloat32 range_m\n",
        {"source_id": [0x0C, 0xA8], "target_id": [0xDE, 0xCA, 0, 0, 0, 0, 0x4F, 0x1B], "range_m": 2.5},
        [(T0, 0x0CA8, 0x4F1B, 2.5)],
    ),
    "ids of 64 bits": (
        "any_msgs/msg/UwbRanging",
        HEAD + "uint64 source\nuint64 target\nfloat32 range\n",
        {"source": 0xDECA000000000CA8, "target": 0xDECA000000004F1B, "range": 2.5},
        [(T0, 0x0CA8, 0x4F1B, 2.5)],
    ),
}


@pytest.mark.parametrize("ros1", [False, True], ids=["ros2", "ros1"])
@pytest.mark.parametrize("case", CASES)
def test_what_radios_drivers_publish(tmp_path: Path, case: str, ros1: bool) -> None:
    name, text, fields, wanted = CASES[case]
    path = record(tmp_path / "a.mcap", name, text, [("/any/topic", fields)], ros1=ros1)
    assert read(path) == wanted


def test_powers_and_json(tmp_path: Path) -> None:
    name, text, fields, _ = CASES["Nodeframe5"]
    fields["nodes"][0] |= {"fp_rssi": -82.0, "rx_rssi": -80.0}
    path = record(tmp_path / "a.mcap", name, text, [("/a", fields)])
    (found,) = Recording(path)
    assert isinstance(found, RangeMessage)
    assert (found.receive_power, found.first_path_power) == (-80.0, -82.0)
    with (tmp_path / "b.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        channel = writer.register_channel("/b", "json", writer.register_schema("UwbRange", "jsonschema", b"{}"))
        for k, content in enumerate(['{"tag": "t1", "beacon": "b7", "range": 3}', "[1]", "{", '{"tag": 1}']):
            writer.add_message(channel, LOG + k, content.encode(), LOG + k)
        writer.finish()
    reader = Recording(tmp_path / "b.mcap")
    assert list(reader) == [RangeMessage(LOG, 1, 7, 3.0, math.nan, math.nan)] or reader.dropped.total() == 3


RANGE = "sensor_msgs/msg/Range"
RANGE_TEXT = HEAD + "uint8 radiation_type\nfloat32 field_of_view\nfloat32 min_range\nfloat32 max_range\nfloat32 range\n"


def ranges_on(topics: Sequence[str], frame: str = "") -> list[tuple[str, Fields]]:
    return [(topic, {"range": 2.5 + k, "header": frame}) for k, topic in enumerate(topics)]


@pytest.mark.parametrize("ros1", [False, True], ids=["ros2", "ros1"])
def test_a_topic_for_each_node(tmp_path: Path, ros1: bool) -> None:
    topics = [f"/robot1/uwb/anchor_{k}/range" for k in (0, 5, 12)]
    path = record(tmp_path / "a.mcap", RANGE, RANGE_TEXT, ranges_on(topics), ros1=ros1)
    # one is called as the robot's own node is: it gets another number
    assert [(m[1], m[2]) for m in read(path)] == [(0, 256), (0, 5), (0, 12)]
    one = Recording(path, uwb_topic="/robot1/uwb/anchor_5/*")
    assert [m.target for m in one if isinstance(m, RangeMessage)] == [5]
    assert set(Recording(path).topics.values()) == {"uwb"}


def test_one_topic_whose_frame_names_the_node(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", RANGE, RANGE_TEXT, [*ranges_on(["/uwb"], "anchor3"), *ranges_on(["/uwb"], "b7")])
    assert [m[2] for m in read(path)] == [3, 7]


def test_sonars_are_no_radio_unless_named(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", RANGE, RANGE_TEXT, ranges_on(["/sonar_1", "/sonar_2"]))
    reader = Recording(path, uwb_topic="/sonar_*")
    assert [m.target for m in reader if isinstance(m, RangeMessage)] == [1, 2]
    with pytest.raises(LogError, match="no scan topic"):
        Recording(path)
    assert "/sonar_1, /sonar_2 are not taken for a radio's" in Recording(path, scan_topic=None).warnings[-1]


def test_what_is_not_read_is_told_with_its_fields(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", "odd/msg/UwbThing", "float32 metres\nuint8 who\n", [("/odd", {"metres": 2.5})])
    (told,) = [w for w in Recording(path, scan_topic=None).warnings if "[uwb.message]" in w]
    assert "/odd" in told
    assert "odd/msg/UwbThing" in told
    assert "metres, who" in told


TOML_FLAT = """
[uwb.message]
type = "odd_msgs/UwbThing"
source = "who.near"
target = "who.far"
range = "millimetres"
unit = "mm"
stamp = "seconds"
receive_power = "dbm"
"""
FLAT = "float64 seconds\nodd_msgs/Who who\nuint32 millimetres\nfloat32 dbm\n"
FLAT += f"{SEPARATOR}MSG: odd_msgs/Who\nstring near\nstring far\n"
TOML_LISTS = """
[uwb.message]
type = "Swarm"
source = "me"
target = "links[].peer"
range = "links[].r"
unit = "cm"
stamp = "links[].ns"
"""
LISTS = f"uint8 me\nodd_msgs/Link[] links\n{SEPARATOR}MSG: odd_msgs/Link\nuint8 peer\nfloat32 r\nuint64 ns\n"


def test_a_message_that_the_user_describes(tmp_path: Path) -> None:
    toml = tmp_path / "a.toml"
    toml.write_text(TOML_FLAT)
    settings = settings_file.load_settings(toml)
    settings_file.save_settings(settings, toml)
    assert settings_file.load_settings(toml) == settings
    fields = {"seconds": 5.5, "who": {"near": "T1", "far": "A2"}, "millimetres": 2500, "dbm": -80.0}
    path = record(tmp_path / "a.mcap", "odd_msgs/msg/UwbThing", FLAT, [("/odd", fields)])
    (found,) = Recording(path, uwb=settings.uwb)
    wanted = RangeMessage(5_500_000_000, 1, 2, 2.5, -80.0)
    assert str(found) == str(wanted)
    toml.write_text(TOML_LISTS)
    links = {"me": 1, "links": [{"peer": 2, "r": 250.0, "ns": 77}, {"peer": 3, "r": 350.0, "ns": 78}]}
    path = record(tmp_path / "b.mcap", "odd_msgs/msg/Swarm", LISTS, [("/odd", links)])
    uwb = settings_file.load_settings(toml).uwb
    assert read(path, message=uwb.message) == [(77, 1, 2, 2.5), (78, 1, 3, 3.5)]


def test_a_description_that_does_not_fit_says_what_there_is(tmp_path: Path) -> None:
    toml = tmp_path / "a.toml"
    toml.write_text(TOML_LISTS.replace("links[].r", "links[].range"))
    path = record(tmp_path / "b.mcap", "odd_msgs/msg/Swarm", LISTS, [("/odd", {"me": 1})])
    uwb = settings_file.load_settings(toml).uwb
    reader = Recording(path, uwb=uwb, scan_topic=None)
    assert any("has no links[].range; it has me, links[].peer" in told for told in reader.warnings)
    with pytest.raises(LogError, match=r"has no links\[\]\.range"):
        Recording(path, uwb=uwb, uwb_topic="/odd")


@pytest.mark.parametrize(
    ("names", "ids"),
    [
        (["3", "anchor_5", "0x0ca8", "0CA8"], [3, 5, 0x0CA8, 256]),
        (["tag0", "anchor0", "anchor1"], [0, 256, 1]),
        (["north", "south", "north"], [256, 257, 256]),
        (["DE:CA:00:00:00:00:4F:1B", "dw7"], [0x4F1B, 7]),
        ([7, np.uint16(8), 9.0], [7, 8, 9]),
    ],
)
def test_names_become_numbers_once_and_for_all(names: list[Any], ids: list[int]) -> None:
    options = Options()
    for _ in range(2):
        assert [options.node(name) for name in names] == ids


@pytest.mark.parametrize("name", ["", "  ", -1, 2.5, None])
def test_what_names_no_node(name: Any) -> None:
    with pytest.raises((ValueError, TypeError)):
        Options().node(name)


def test_the_part_of_a_topic_that_names_the_node() -> None:
    topics = ["/r1/uwb/a1/range", "/r1/uwb/a2/range"]
    assert [topic_name(topic, topics) for topic in topics] == ["a1", "a2"]
    assert topic_name("/uwb", ["/uwb"]) == ""


@pytest.mark.parametrize(
    "text",
    [
        HEAD + "float32[] ranges\nfloat32[] intensities\nfloat32 angle_min\nstring id\n",
        "uint8 role\nuint8 id\nx/N[] nodes\n" + SEPARATOR + "MSG: x/N\nuint8 role\nuint8 id\nuint8[] data\n",
        "uint8 id\nx/N[] nodes\n" + SEPARATOR + "MSG: x/N\nuint8 id\nfloat32[3] pos_3d\n",
        "geometry_msgs/Point from\ngeometry_msgs/Point to\nfloat32 length\n",
    ],
)
def test_what_is_no_range_between_nodes(text: str) -> None:
    store = store_of("x/msg/X", text)
    layout = find_layout(fields_of_type(store.fielddefs, "x/msg/X"))
    assert layout is None or layout.target == "@index"
