"""The ranges of a `field_log` in the messages that other packages publish them in."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from field_log import UWB, Row, Rows
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

HEAD = "std_msgs/Header header\n"
LINKTRACK = "uint8 role\nuint8 id\nuint32 local_time\nuint32 system_time\nfloat32 voltage\n"
SEPARATOR = "=" * 80 + "\n"


@dataclass(frozen=True)
class Format:
    """A type, its definition, and from a store, a range with the robot and its other node to the type's fields.

    Attributes:
      topic: {} stands for the node.
    """

    name: str
    text: str
    fields: Callable[[Any, Any, int], dict[str, Any]]
    topic: str = "/uwb"


def _frame0(store: Any, m: Any, node: int) -> dict[str, Any]:
    heard = np.zeros(8, np.float32)
    heard[node // 10] = m.range
    return _linktrack() | {"pos_3d": np.zeros(3, np.float32), "dis_arr": heard}


def _linktrack() -> dict[str, Any]:
    return {"role": 2, "id": 0, "local_time": 0, "system_time": 0, "voltage": 5.0}


def _nodes(store: Any, m: Any, node: int) -> dict[str, Any]:
    of = store.types["nlink/msg/LinktrackNode2"]
    return _linktrack() | {"nodes": [of(role=1, id=node, dis=m.range, fp_rssi=-81.0, rx_rssi=-80.0)]}


def _array(store: Any, m: Any, node: int) -> dict[str, Any]:
    one = store.types["b/msg/Range"](stamp=m.header.stamp, anchor_id=str(node), distance=m.range)
    return {"header": m.header, "ranges": [one]}


FORMATS = {
    "sensor_range": Format(
        "sensor_msgs/msg/Range",
        "",
        lambda _, m, __: {
            "header": m.header, "radiation_type": 1, "field_of_view": 0.0, "min_range": 0.0, "max_range": 99.0,
            "range": m.range,
        },
        "/uwb/anchor_{}/range",
    ),
    "uwb_driver": Format(
        "uwb_driver/msg/UwbRange",
        HEAD + "uint8 requester_id\nuint8 responder_id\nint8 requester_idx\nfloat32 distance\nfloat32 distance_err\n",
        lambda _, m, node: {
            "header": m.header, "requester_id": 0, "responder_id": node, "requester_idx": 0, "distance": m.range,
            "distance_err": 0.1,
        },
    ),
    "twowayrange": Format(
        "uwb_msgs/msg/TwoWayRangeStamped",
        HEAD + "uint8 uwb_id1\nuint8 uwb_id2\nfloat64 range_raw\nfloat64 range_corr\nfloat64 r\n",
        lambda _, m, node: {
            "header": m.header, "uwb_id1": 0, "uwb_id2": node, "range_raw": 9.0, "range_corr": m.range, "r": 0.1,
        },
    ),
    "gtec": Format(
        "gtec_msgs/msg/Ranging",
        "int16 anchor_id\nint16 tag_id\nint32 range\nint32 seq\nfloat64 rss\nfloat64 error_estimation\n",
        lambda _, m, node: {
            "anchor_id": node, "tag_id": 0, "range": round(m.range * 1000), "seq": 1, "rss": 0.0,
            "error_estimation": 0.0,
        },
    ),
    "tagframe0": Format("nlink/msg/LinktrackTagframe0", LINKTRACK + "float32[3] pos_3d\nfloat32[8] dis_arr\n", _frame0),
    "nodeframe2": Format(
        "nlink/msg/LinktrackNodeframe2",
        LINKTRACK + f"nlink/LinktrackNode2[] nodes\n{SEPARATOR}MSG: nlink/LinktrackNode2\n"
        "uint8 role\nuint8 id\nfloat32 dis\nfloat32 fp_rssi\nfloat32 rx_rssi\n",
        _nodes,
    ),
    "rangearray": Format(
        "b/msg/RangeArray",
        HEAD + f"b/Range[] ranges\n{SEPARATOR}MSG: b/Range\nbuiltin_interfaces/Time stamp\nstring anchor_id\n"
        "float32 distance\n",
        _array,
    ),
    "seconds_in_a_float": Format(
        "v_msgs/msg/Ranging",
        "float64 timestamp\nuint16 anchor_id\nuint16 tag_id\nfloat32 range\n",
        lambda _, m, node: {
            "timestamp": m.header.stamp.sec + m.header.stamp.nanosec / 1e9, "anchor_id": node, "tag_id": 0,
            "range": m.range,
        },
    ),
    "counter_of_the_radio": Format(
        "w_msgs/msg/Ranging",
        "uint64 timestamp\nuint16 anchor_id\nuint16 tag_id\nfloat32 range\n",
        lambda _, m, node: {
            "timestamp": 64 * (m.header.stamp.sec % 100 * 10**9 + m.header.stamp.nanosec), "anchor_id": node,
            "tag_id": 0, "range": m.range,
        },
    ),
}  # fmt: skip
"""By the name of the format."""


def published(rows: Rows, name: str) -> tuple[Rows, Any]:
    """The rows with the robot's ranges, there are no others, in a format; and a store that has its type."""
    wanted = FORMATS[name]
    store: Any = get_typestore(Stores.ROS2_HUMBLE)
    types = get_types_from_msg(wanted.text, wanted.name) if wanted.text else {}
    store.register({key: value for key, value in types.items() if key not in store.fielddefs})
    found = []
    for row in rows:
        if row.topic == UWB:
            node = max(row.message.source, row.message.target)
            message = store.types[wanted.name](**wanted.fields(store, row.message, node))
            row = Row(wanted.topic.format(node), row.log, message)
        found.append(row)
    return found, store
