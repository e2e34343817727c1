"""A Result as a ROS 2 recording for Foxglove and RViz: map, path, poses, transforms, beacons and diagnostics.

Messages are made as their type and CDR bytes; `live.publisher` sends the same ones.
"""

from __future__ import annotations

import heapq
import math
import struct
from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from uwbslam_jax.files.mcap_container import RecordWriter
from uwbslam_jax.files.ros_types import CDR, build, definition, header, pose, quaternion, serialize, time, vector
from uwbslam_jax.result import BeaconEstimate, BeaconStatus, MapImage, Result, crop

DIAGNOSTICS_PERIOD, PATH_PERIOD, BEACONS_PERIOD = 100_000_000, 100_000_000, 1_000_000_000
"""Least time between two values, poses of the path, and beacons [ns]: for looking at; /tf has every pose."""
MAP_FRAME, UWB_FRAME = "map", "uwb"
"""Frames [name]: the fixed one (REP 105), and that of recorded ranges at the same place, or viewers miss it."""
_CYLINDER, _TEXT = 3, 9
"""Types of a visualization_msgs/Marker [number]; a text faces the viewer."""
_COLORS = {
    BeaconStatus.STATIC: (0.1, 0.6, 0.2),
    BeaconStatus.MOVING: (0.9, 0.5, 0.0),
    BeaconStatus.SILENT: (0.5, 0.5, 0.5),
    BeaconStatus.DROPPED: (0.8, 0.1, 0.1),
    BeaconStatus.RELATIVE: (0.2, 0.45, 0.8),
}
"""Red, green, blue of a beacon by its status [0 to 1]: from green, at rest, to red, given up."""
_POSE_TYPE, _TF_TYPE = "geometry_msgs/msg/PoseWithCovarianceStamped", "tf2_msgs/msg/TFMessage"
"""Packed by hand [ROS type]: there is one of each a frame, and the type store takes 0.1 ms for each."""
_POSE, _TF = struct.Struct("<4siII4s7d36d"), struct.Struct("<4sIiII4sI10s6x7d")
"""Head, stamp, "map", position and orientation, covariance; head, number of transforms, stamp, "map", "base_link",
padding, both vectors [bytes]."""
_PLANAR = [6 * row + column for row in (0, 1, 5) for column in (0, 1, 5)]
"""Where x, y, yaw stand in a 6 x 6 covariance over x, y, z, roll, pitch, yaw [index]."""
_STAMPED = np.dtype([("time", "<u4", 2), ("length", "<u4"), ("frame", "S4"), ("pose", "<f8", 7)])
"""CDR of a PoseStamped, so that a path is one array [s and ns, bytes, name, m and quaternion]."""


class _Item(NamedTuple):
    """A message to be made when its turn comes, so that only one is in memory: its type and CDR bytes."""

    stamp: int
    topic: str
    make: Callable[[], tuple[str, bytes]]


def write_result_log(result: Result, path: str | Path) -> None:
    """Writes result.mcap, messages in the order of their stamps.

    The final map and path come first, so that a viewer shows them from the start on.

    Raises:
      LogError: the file cannot be opened.
    """
    known = np.flatnonzero(np.isfinite(result.poses).all(axis=1)) if len(result.stamps) else np.zeros(0, int)
    start = int(result.stamps[0]) if len(result.stamps) else 0
    streams = [_once(result, start, known), _poses(result, known), _beacons(result, start), _diagnostics(result)]
    channels: dict[str, int] = {}
    with RecordWriter(path, chunk_size=1 << 20) as records:
        for item in heapq.merge(*streams, key=lambda item: item.stamp):
            schema, data = item.make()
            if item.topic not in channels:
                channels[item.topic] = records.add_topic(item.topic, schema, definition(schema))
            records.write(channels[item.topic], data, item.stamp)


def _once(result: Result, start: int, known: np.ndarray) -> Iterator[_Item]:
    yield _Item(start, "/tf", lambda: _packed(_transform(start, UWB_FRAME, 0.0, 0.0, 0.0)))
    yield _Item(start, "/map", lambda: occupancy(result.map, start))
    yield _Item(start, "/path", lambda: _path(result, start, _thinned(result, known)))


def _thinned(result: Result, known: np.ndarray) -> np.ndarray:
    """The first of the known frames in each PATH_PERIOD, and the last one."""
    _, first = np.unique(result.stamps[known] // PATH_PERIOD, return_index=True)
    return np.union1d(known[first], known[-1:])


def _packed(message: Any) -> tuple[str, bytes]:
    return message.__msgtype__, serialize(message)


def _poses(result: Result, known: np.ndarray) -> Iterator[_Item]:
    for index in known:
        stamp = int(result.stamps[index])
        # /pose is what was published then, with the covariance that it had; /tf belongs to the map and the path
        published, cov = result.online[index].tolist(), result.online_covs[index]
        yield _Item(stamp, "/pose", partial(pose_with_covariance, stamp, *published, cov))
        yield _Item(stamp, "/tf", partial(robot_transform, stamp, *result.poses[index].tolist()))


def _beacons(result: Result, start: int) -> Iterator[_Item]:
    """Beacons as known at each second that has a frame, then the final ones with their ellipses."""
    if not len(result.stamps):
        return
    end = int(result.stamps[-1])
    seconds = np.unique(
        (result.stamps - start) // BEACONS_PERIOD
    )  # not all between: a clock may have been set by years
    for stamp in (start + seconds * BEACONS_PERIOD).tolist():
        if stamp >= end:
            break
        passed = (stamp - start) * 1e-9
        tracks = sorted(result.beacon_tracks.items())
        past = {number: int(np.searchsorted(track[:, 0], passed, side="right")) for number, track in tracks}
        known = {number: track[past[number] - 1] for number, track in tracks if past[number]}
        if known:
            yield _Item(stamp, "/beacons", lambda s=stamp, known=known: _packed(_track_markers(s, known)))
    yield _Item(end, "/beacons", lambda: beacon_markers(end, result.beacons))


def _diagnostics(result: Result) -> Iterator[_Item]:
    last: int | None = None
    for index, stamp in enumerate(result.stamps.tolist() if result.diagnostics else []):
        if last is None or stamp - last >= DIAGNOSTICS_PERIOD:
            last = stamp
            make = partial(_status, stamp, result.diagnostics, index)
            yield _Item(stamp, "/diagnostics", lambda make=make: _packed(make()))


def pose_with_covariance(stamp: int, x: float, y: float, yaw: float, cov: np.ndarray) -> tuple[str, bytes]:
    """PoseWithCovarianceStamped; (3, 3) over x, y, yaw goes to rows and columns 0, 1, 5 of the 6 x 6."""
    full = [0.0] * 36
    for at, value in zip(_PLANAR, cov.ravel().tolist(), strict=True):
        full[at] = value if math.isfinite(value) else 0.0  # RViz refuses a NaN
    place = x, y, 0.0, 0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)
    return _POSE_TYPE, _POSE.pack(CDR, *divmod(stamp, 1_000_000_000), 4, b"map", *place, *full)


def robot_transform(stamp: int, x: float, y: float, yaw: float) -> tuple[str, bytes]:
    """TFMessage of the robot: what `_transform` says, packed."""
    place = x, y, 0.0, 0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)
    return _TF_TYPE, _TF.pack(CDR, 1, *divmod(stamp, 1_000_000_000), 4, b"map", 10, b"base_link", *place)


def _transform(stamp: int, child: str, x: float, y: float, yaw: float) -> Any:
    """TFMessage with one transform from the map."""
    moved = build("geometry_msgs/msg/Transform", translation=vector("Vector3", x, y), rotation=quaternion(yaw))
    stamped = build(
        "geometry_msgs/msg/TransformStamped", header=header(stamp, MAP_FRAME), child_frame_id=child, transform=moved
    )
    return build("tf2_msgs/msg/TFMessage", transforms=[stamped])


def _path(result: Result, stamp: int, known: np.ndarray) -> tuple[str, bytes]:
    """Path of some poses, packed."""
    head = CDR + struct.pack("<iII4sI", *divmod(stamp, 1_000_000_000), 4, b"map", len(known))
    rows = np.zeros(len(known), _STAMPED)
    rows["time"] = np.stack(np.divmod(result.stamps[known], 1_000_000_000), axis=-1)
    rows["length"], rows["frame"] = 4, b"map"
    x, y, yaw = result.poses[known].T
    rows["pose"][:, 0], rows["pose"][:, 1] = x, y
    rows["pose"][:, 5], rows["pose"][:, 6] = np.sin(yaw / 2), np.cos(yaw / 2)
    body = rows.tobytes()
    # numbers of eight bytes stand at multiples of eight: after the first pose's head there are four bytes of nothing
    first = _STAMPED.itemsize - 7 * 8 if len(known) else 0
    return "nav_msgs/msg/Path", b"".join([head, body[:first], bytes(4) if first else b"", body[first:]])


def occupancy(image: MapImage, stamp: int) -> tuple[str, bytes]:
    """OccupancyGrid of the observed part: -1 unknown, else the probability of being occupied in percent."""
    image = crop(image)
    percent = np.rint(100.0 / (1.0 + np.exp(-image.log_odds.astype(np.float64))))
    data = np.where(image.log_odds == 0, -1, percent).astype(np.int8)
    rows, columns = data.shape
    info = build(
        "nav_msgs/msg/MapMetaData",
        map_load_time=time(stamp),
        resolution=float(image.resolution),
        width=columns,
        height=rows,
        origin=pose(float(image.origin[0]), float(image.origin[1]), 0.0),
    )
    return _packed(build("nav_msgs/msg/OccupancyGrid", header=header(stamp, MAP_FRAME), info=info, data=data.ravel()))


def _track_markers(stamp: int, known: dict[int, np.ndarray]) -> Any:
    """MarkerArray of beacons on the way, rows t, x, y, sigma: a post, its id and a 2-sigma circle."""
    markers: list[Any] = []
    for number, (_, x, y, sigma) in known.items():
        markers += _beacon(stamp, number, (float(x), float(y), 0.0), (float(sigma), float(sigma)), BeaconStatus.STATIC)
    return build("visualization_msgs/msg/MarkerArray", markers=markers)


def beacon_markers(stamp: int, beacons: list[BeaconEstimate]) -> tuple[str, bytes]:
    """MarkerArray of the last estimates, with 2-sigma ellipses."""
    markers: list[Any] = []
    for beacon in beacons:
        values, vectors = np.linalg.eigh(np.asarray(beacon.cov, dtype=np.float64))
        small, large = np.sqrt(np.maximum(values, 0.0))
        place = float(beacon.position[0]), float(beacon.position[1]), math.atan2(vectors[1, 1], vectors[0, 1])
        markers += _beacon(stamp, beacon.id, place, (float(large), float(small)), beacon.status)
    return _packed(build("visualization_msgs/msg/MarkerArray", markers=markers))


def _beacon(
    stamp: int, number: int, place: tuple[float, float, float], sigmas: tuple[float, float], status: BeaconStatus
) -> list[Any]:
    """Post, text and ellipse of a beacon at x, y with the ellipse's bearing [m, m, rad]; sigmas of its axes [m]."""
    x, y, bearing = place
    color = _COLORS.get(status, _COLORS[BeaconStatus.SILENT])
    text = str(number) if status is BeaconStatus.STATIC else f"{number} {status}"
    ellipse = tuple(max(4.0 * sigma, 0.01) for sigma in sigmas)  # 2 sigma to both sides, never invisible
    shapes: list[tuple[Any, ...]] = [
        ("beacon", _CYLINDER, (x, y, 0.5), 0.0, (0.12, 0.12, 1.0), (*color, 1.0), ""),
        ("id", _TEXT, (x, y, 1.3), 0.0, (0.0, 0.0, 0.4), (0.1, 0.1, 0.1, 1.0), text),
        ("sigma", _CYLINDER, (x, y, 0.01), bearing, (*ellipse, 0.02), (*color, 0.4), ""),
    ]
    return [
        build(
            "visualization_msgs/msg/Marker",
            header=header(stamp, MAP_FRAME),
            ns=namespace,
            id=number & 0x7FFFFFFF,  # ids are uint32, a marker's number is int32
            type=kind,
            action=0,
            pose=build("geometry_msgs/msg/Pose", position=vector("Point", *xyz), orientation=quaternion(yaw)),
            scale=vector("Vector3", *size),
            color=build("std_msgs/msg/ColorRGBA", **dict(zip("rgba", map(float, rgba), strict=True))),
            text=shown,
            **_plain_marker(),
        )
        for namespace, kind, xyz, yaw, size, rgba, shown in shapes
    ]


@cache
def _plain_marker() -> dict[str, Any]:
    """The fields of a marker that ours leave empty; always the same, never changed."""
    return {
        "lifetime": build("builtin_interfaces/msg/Duration", sec=0, nanosec=0),
        "frame_locked": False,
        "points": [],
        "colors": [],
        "texture_resource": "",
        "texture": build(
            "sensor_msgs/msg/CompressedImage", header=header(0, ""), format="", data=np.zeros(0, np.uint8)
        ),
        "uv_coordinates": [],
        "mesh_resource": "",
        "mesh_file": build("visualization_msgs/msg/MeshFile", filename="", data=np.zeros(0, np.uint8)),
        "mesh_use_embedded_materials": False,
    }


def _status(stamp: int, diagnostics: dict[str, np.ndarray], index: int) -> Any:
    """DiagnosticArray with the values of one frame."""
    values = [
        build("diagnostic_msgs/msg/KeyValue", key=name, value=f"{float(series[index]):.6g}")
        for name, series in diagnostics.items()
    ]
    status = build(
        "diagnostic_msgs/msg/DiagnosticStatus", level=0, name="uwbslam", message="", hardware_id="", values=values
    )
    return build("diagnostic_msgs/msg/DiagnosticArray", header=header(stamp, ""), status=[status])
