"""The conditions of a simulation: world, path, beacons, devices and their faults, all in one Scenario.

Nothing here measures or moves; `catalogue` has ready-made ones and `simulate` turns one into messages.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from uwbslam_jax.sim.paths import Path
from uwbslam_jax.sim.worlds import World

INF = float("inf")
"""No limit [s or m]."""
Interval = tuple[float, float]
"""From, to [s since the start]."""


@dataclass(frozen=True)
class Follow:
    """A beacon carried behind the robot from `start` to `end` [s], `lag` [s] behind and `aside` [m] to its left.

    approach: time to walk from where the beacon stood to the robot [s]; 0 for one that is switched off meanwhile.
    """

    start: float
    end: float
    lag: float = 1.0
    aside: float = 0.5
    approach: float = 0.0


@dataclass(frozen=True)
class Walk:
    """A beacon carried straight from where it stood to a place [m] between `start` and `end` [s]."""

    start: float
    end: float
    to: tuple[float, float]


@dataclass(frozen=True)
class Beacon:
    """One UWB beacon.

    Attributes:
      id: node id.
      position: where it stands at first, x, y [m].
      height: of its antenna above the floor [m]. surveyed: whether somebody has measured that.
      alive: when it is switched on.
      moves: when it is carried, in order of time.
    """

    id: int
    position: tuple[float, float]
    height: float = 0.0
    surveyed: bool = True
    alive: tuple[Interval, ...] = ((0.0, INF),)
    moves: tuple[Follow | Walk, ...] = ()


@dataclass(frozen=True)
class Lidar:
    """A scanner; the defaults are a Hokuyo UTM-30LX-EW, whose mirror turns 40 times a second.

    Attributes:
      rate: scans a second [Hz].
      beams, field_of_view: number and arc of the beams [rad], symmetric about straight ahead.
      range_min, range_max: limits of the sensor [m].
      reach: walls farther than this do not return [m].
      sigma: standard deviation of a range [m].
      quantum: ranges are whole multiples of it [m]; 0 for none.
      dropout: share of the beams that do not come back, whatever they meet.
      grazing: walls seen flatter than this return the less the flatter [rad].
      time_increment: time from beam to beam [s]; 0 takes the whole sweep at once.
      jitter: a sweep begins up to this much late [s]; its stamp says so.
      pose: x, y [m], yaw [rad] on the robot.
      blind: intervals without any return.
    """

    rate: float = 10.0
    beams: int = 1081
    field_of_view: float = 1.5 * np.pi
    range_min: float = 0.1
    range_max: float = 30.0
    reach: float = INF
    sigma: float = 0.01
    quantum: float = 0.001
    dropout: float = 0.01
    grazing: float = 0.08
    time_increment: float = 1.0 / 40.0 / 1440.0
    jitter: float = 0.002
    pose: tuple[float, float, float] = (0.0, 0.0, 0.0)
    blind: tuple[Interval, ...] = ()


@dataclass(frozen=True)
class Uwb:
    """Ranging between all nodes in rounds.

    Attributes:
      robot_id: node id of the robot.
      antenna: x, y, z on the robot [m].
      rate: rounds a second [Hz]; less where a round's exchanges take longer.
      exchange: time that one pair takes [s].
      jitter: an exchange takes place up to this much late [s]; its stamp says so.
      loss: share of the exchanges that fail.
      sigma: standard deviation of a range [m].
      quantum: ranges are whole multiples of it [m]; 0 for none.
      beacon_pairs: whether beacons range to each other.
      reach: pairs farther apart do not hear each other [m].
      bias: range bias of a node by id [m]; a pair's is the sum of both.
      scale: excess of every range in proportion to the distance [m/m].
      report_powers: powers are NaN otherwise.
      nlos: whether a wall in between lengthens a range; walls are transparent otherwise.
      nlos_bias: mean of that exponential excess [m].
      nlos_detectable: share of blocked exchanges whose receive power exceeds the first path's by over 10 dB.
      outliers: share of exchanges that are 1-10 m too long without a sign of it.
      early_node, early, early_share: in these intervals this share of the node's ranges is 1-8 m too short.
      silent: intervals without any range.
    """

    robot_id: int = 0
    antenna: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rate: float = 10.0
    exchange: float = 0.003
    jitter: float = 0.0005
    loss: float = 0.02
    sigma: float = 0.1
    quantum: float = 0.01
    beacon_pairs: bool = True
    reach: float = INF
    bias: dict[int, float] = field(default_factory=dict)
    scale: float = 0.0
    report_powers: bool = True
    nlos: bool = False
    nlos_bias: float = 0.8
    nlos_detectable: float = 0.95
    outliers: float = 0.0
    early_node: int = -1
    early: tuple[Interval, ...] = ()
    early_share: float = 0.4
    silent: tuple[Interval, ...] = ()


@dataclass(frozen=True)
class Wheels:
    """Odometry at a rate [Hz] with a scale error and noise: standard deviation a metre and a radian of an increment."""

    rate: float = 20.0
    scale: float = 0.02
    noise: float = 0.05
    noise_yaw: float = 0.05


class Pause(NamedTuple):
    """A recorder that is switched off from `begin` to `end` of the scenario, which lasts so long by the clock [s]."""

    begin: float
    end: float
    lasts: float


@dataclass(frozen=True)
class Scenario:
    """Everything that a simulation depends on; world, path and beacons share one frame [m], duration in s, without what
    a pause lasts longer."""

    name: str
    seed: int
    duration: float
    world: World
    path: Path
    beacons: tuple[Beacon, ...]
    lidar: Lidar = field(default_factory=Lidar)
    uwb: Uwb = field(default_factory=Uwb)
    wheels: Wheels | None = None
    pause: Pause | None = None


def stream(seed: int, purpose: str) -> np.random.Generator:
    """An own generator for each purpose: what one draws never shifts another's numbers."""
    return np.random.default_rng([seed, zlib.crc32(purpose.encode())])


def settings_overrides(scenario: Scenario) -> dict[str, Any]:
    """What a user would configure for this robot: lever arms and surveyed heights; never what is to be found out."""
    antenna, lidar = (tuple(float(x) for x in pose) for pose in (scenario.uwb.antenna, scenario.lidar.pose))
    heights = {str(b.id): float(b.height) for b in scenario.beacons if b.surveyed and b.height != antenna[2]}
    return {"robot": {"id": scenario.uwb.robot_id, "antenna": antenna, "lidar": lidar}, "uwb": {"height": heights}}
