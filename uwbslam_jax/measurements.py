"""What is measured: host messages (stamped in ns) and the fixed-shape arrays of one frame.

Nothing here reads a file, knows a sensor's protocol or computes an estimate.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

NAN = float("nan")
"""What a device does not report [in any unit]."""


@dataclass(slots=True, unsafe_hash=True)
class RangeMessage:
    """One two-way ranging exchange between two nodes. Nothing changes one; that it is not frozen makes it four times as
    fast to make, and recordings hold hundreds a second.

    Attributes:
      stamp: time of the exchange [ns, int64 epoch].
      source, target: node ids (any uint32).
      range: measured distance between the antennas [m].
      receive_power, first_path_power: DW1000 powers [dBm], NaN where the radio does not say.
    """

    stamp: int
    source: int
    target: int
    range: float
    receive_power: float = NAN
    first_path_power: float = NAN


@dataclass(frozen=True, slots=True)
class ScanMessage:
    """One sweep of a 2D LiDAR, as in sensor_msgs/LaserScan.

    Attributes:
      stamp: time of the first beam [ns].
      angle_min, angle_increment: bearing of beam i is angle_min + i * angle_increment [rad], counter-clockwise.
      time_increment: time between two beams [s]; 0 where the whole sweep is taken at once.
      range_min, range_max: limits of the sensor [m]; a reading outside, at range_max, zero, inf or NaN is no return.
      ranges: (beams,) float32 [m].
    """

    stamp: int
    angle_min: float
    angle_increment: float
    time_increment: float
    range_min: float
    range_max: float
    ranges: np.ndarray


@dataclass(frozen=True, slots=True)
class OdometryMessage:
    """A pose in the odometry's own drifting frame; only increments are used. [ns, m, m, rad]"""

    stamp: int
    x: float
    y: float
    yaw: float


@dataclass(frozen=True, slots=True)
class TruthMessage:
    """Ground truth for evaluation only: the robot (node None) or one beacon. [ns, m, m, rad]

    yaw is NaN for a beacon. The estimator never sees these.
    """

    stamp: int
    node: int | None
    x: float
    y: float
    yaw: float = NAN


Leaf = Any
"""Numpy on the host, where frames are made; JAX arrays inside the step."""

Message = RangeMessage | ScanMessage | OdometryMessage | TruthMessage


class Scan(NamedTuple):
    """One sweep, padded. B = config.max_beams.

    Attributes:
      ranges: distance of each beam [m], 0 where there is no return.
      valid: True where the beam returned within limits.
      angle_min, angle_increment: bearing of beam i [rad].
      time_increment: time from beam to beam [s].
    """

    ranges: Float[Leaf, "B"]
    valid: Bool[Leaf, "B"]
    angle_min: Float[Leaf, ""]
    angle_increment: Float[Leaf, ""]
    time_increment: Float[Leaf, ""]


class Snapshot(NamedTuple):
    """A scan and how the robot moved while it was taken.

    Attributes:
      scan: see there.
      drift: velocity in the robot's own frame [m/s]; yaw_rate [rad/s].
    """

    scan: Scan
    drift: Float[Leaf, "2"]
    yaw_rate: Float[Leaf, ""]


class Ranges(NamedTuple):
    """All exchanges of one frame, padded. M = config.max_ranges; slots index nodes, 0 is the robot.

    Attributes:
      i, j: slots of the two nodes.
      range: measured distance [m].
      age: time of the exchange relative to the frame's stamp [s], <= 0.
      power_gap: receive minus first-path power [dB], NaN where unknown.
      valid: True where there is a measurement.
    """

    i: Int[Leaf, "M"]
    j: Int[Leaf, "M"]
    range: Float[Leaf, "M"]
    age: Float[Leaf, "M"]
    power_gap: Float[Leaf, "M"]
    valid: Bool[Leaf, "M"]


class Odometry(NamedTuple):
    """Motion since the last frame in the robot's frame at that time [m, m, rad]; valid False where there is none."""

    increment: Float[Leaf, "3"]
    valid: Bool[Leaf, ""]


class Frame(NamedTuple):
    """One padded set of measurements, all that a step sees.

    Attributes:
      dt: time since the frame before [s].
      has_scan: False for a frame that carries ranges only.
      scan, ranges, odometry: see there.
    """

    dt: Float[Leaf, ""]
    has_scan: Bool[Leaf, ""]
    scan: Scan
    ranges: Ranges
    odometry: Odometry


@dataclass(frozen=True, slots=True)
class StampedFrame:
    """A frame with the time that float32 cannot hold [ns], and the slots of the nodes known then, by id."""

    stamp: int
    frame: Frame
    slots: dict[int, int] = field(default_factory=dict)


def empty_frame(beams: int, ranges: int) -> Frame:
    """A frame without any measurement, of a size."""
    zero, no = np.float32(0.0), np.bool_(False)
    none, slots = np.zeros(ranges, np.float32), np.zeros(ranges, np.int32)
    return Frame(
        dt=zero,
        has_scan=no,
        scan=Scan(np.zeros(beams, np.float32), np.zeros(beams, bool), zero, np.float32(1e-3), zero),
        ranges=Ranges(slots, slots + 1, none, none, none + np.float32(NAN), np.zeros(ranges, bool)),
        odometry=Odometry(np.zeros(3, np.float32), no),
    )
