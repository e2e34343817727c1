"""Settings a user writes (TOML or flags) and the two things they become: static Config and tunable Params.

Settings are plain host data, one dataclass a TOML section. Config is hashable and fixes sizes and switches, so
it may be a static argument of a jitted function. Params are the differentiable leaves; HostParams is the host's copy.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from uwbslam_jax.measurements import Ranges

Metres = Any
"""A float, or an array of several [m]."""
Slot = int | np.ndarray


class Params(NamedTuple):
    """The tunable leaves, all differentiable. K = 1 + max_beacons slots, slot 0 is the robot.

    Attributes:
      gamma, sigma_n, sigma_w, sigma_w_paper, sigma_w_yaw, sigma_w_beacon, sigma_w_carried, sigma_l, independent_beams,
        sigma_map, sigma_map_yaw: see FilterSettings and UwbSettings.
      odom_sigma_xy, odom_sigma_yaw, odom_sigma_floor: see OdomSettings.
      antenna: x, y of the UWB antenna on the robot [m].
      lidar: pose of the LiDAR on the robot [m, m, rad].
      bias: (K,) range bias of each node [m].
      bias_scale: excess of a range in proportion to the distance [m/m].
      height: (K,) height of each node's antenna [m].
    """

    gamma: Float[Array, ""]
    sigma_n: Float[Array, ""]
    sigma_w: Float[Array, ""]
    sigma_w_paper: Float[Array, ""]
    sigma_w_yaw: Float[Array, ""]
    sigma_w_beacon: Float[Array, ""]
    sigma_w_carried: Float[Array, ""]
    sigma_l: Float[Array, ""]
    independent_beams: Float[Array, ""]
    sigma_map: Float[Array, ""]
    sigma_map_yaw: Float[Array, ""]
    odom_sigma_xy: Float[Array, ""]
    odom_sigma_yaw: Float[Array, ""]
    odom_sigma_floor: Float[Array, "2"]
    antenna: Float[Array, "2"]
    lidar: Float[Array, "3"]
    bias: Float[Array, "K"]
    bias_scale: Float[Array, ""]
    height: Float[Array, "K"]


@dataclass(frozen=True)
class Config:
    """Sizes and switches: what a compiled step depends on. Hashable.

    Attributes:
      nodes: slots K, robot included.
      max_ranges: slots for the exchanges of one frame.
      max_beams: slots for the beams of a scan.
      resolution: cell of the finest level [m].
      levels: of the pyramid.
      cells: cells along the window's side at the finest level.
      nlos_gap_db: power rule [dB].
      preset, scan_matching, correction, lidar_only: see FilterSettings.
      draws: whether scans are drawn; not in a run that only localises.
    """

    nodes: int
    max_ranges: int
    max_beams: int
    resolution: float
    levels: int
    cells: int
    nlos_gap_db: float
    preset: Literal["robust", "paper"]
    scan_matching: bool
    correction: bool
    lidar_only: bool
    draws: bool = True


@dataclass(frozen=True)
class Found:
    """What a run has found its ranging to be off by, beyond what is configured.

    Attributes:
      bias: slot -> range bias of the node [m]. height: slot -> of its antenna [m]. scale: of all ranges [m/m].
    """

    bias: dict[int, float] = field(default_factory=dict)
    height: dict[int, float] = field(default_factory=dict)
    scale: float = 0.0


@dataclass(frozen=True)
class HostParams:
    """What the host takes a range for, in float64: the model of `estimator.ranging` the other way round.

    Attributes:
      antenna, bias, bias_scale, height, lidar: see Params.
      sigma_n, nlos_gap_db: see UwbSettings.
      surveyed: (K,) whether the height of a node's antenna was configured.
    """

    antenna: Float[np.ndarray, "2"]
    bias: Float[np.ndarray, "K"]
    bias_scale: float
    height: Float[np.ndarray, "K"]
    lidar: Float[np.ndarray, "3"]
    sigma_n: float
    nlos_gap_db: float
    surveyed: Bool[np.ndarray, "K"]

    def slant(self, measured: Metres, i: Slot, j: Slot) -> Metres:
        """Distance of two antennas in space [m] for a range measured between slots, or for several."""
        return (measured - self.bias[i] - self.bias[j]) / (1.0 + self.bias_scale)

    def rise(self, i: Slot, j: Slot) -> Metres:
        """How much higher the antenna of a slot stands than that of another [m]."""
        return self.height[i] - self.height[j]

    def flat(self, measured: Metres, i: Slot, j: Slot) -> Metres:
        """Distance in the plane [m]; at least 0.1, however short the range is."""
        flat: Any = np.sqrt(np.maximum(self.slant(measured, i, j) ** 2 - self.rise(i, j) ** 2, 0.01))
        return flat

    def beyond(self, found: Found) -> HostParams:
        """The same with what a run has found as well."""
        bias, height = self.bias.copy(), self.height.copy()
        for slot, more in found.bias.items():
            bias[slot] += (1.0 + self.bias_scale) * more
        for slot, more in found.height.items():
            height[slot] += more
        scale = (1.0 + self.bias_scale) * (1.0 + found.scale) - 1.0
        return replace(self, bias=bias, height=height, bias_scale=scale)

    def usable(self, ranges: Ranges) -> Bool[np.ndarray, "M"]:
        """Which ranges of a frame are measured, and not NLOS by their powers; see `ranging.line_of_sight`."""
        return np.asarray(ranges.valid) & ~(np.asarray(ranges.power_gap) > self.nlos_gap_db)


@dataclass(frozen=True)
class RobotSettings:
    """The robot: its UWB node id and where its sensors sit in the robot's frame; where a place is left at its default,
    the transforms of a recording tell it, if it has some."""

    id: int = 0
    """Node id of the robot's UWB radio."""
    antenna: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """UWB antenna x, y, z on the robot [m]."""
    lidar: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """LiDAR x, y [m] and yaw [rad] on the robot."""
    lidar_flip: bool = False
    """Whether the LiDAR is mounted upside down: its bearings then count clockwise, seen from above."""


@dataclass(frozen=True)
class RangeLayout:
    """Where things stand in a message of another radio, by paths: "distance", "tags[].anchors[].dis".

    A path goes through the same lists as that of the range, or beside them: "anchors[].id", "tag.id", "ids[]".
    """

    type: str = ""
    """Name of the message's type, with or without its package, as "UwbFrame"; empty where none is described."""
    source: str = ""
    """Path of the node that ranges; the robot's where not given."""
    target: str = ""
    """Path of the node that it ranges to, "@index" for the place in the list; where not given, the topic names it."""
    range: str = ""
    """Path of the range."""
    unit: Literal["m", "cm", "mm", "ft", "in"] = "m"
    """Unit of the range."""
    stamp: str = ""
    """Path of the time: a ROS time, a float of seconds or an integer of nanoseconds; the header's where not given."""
    receive_power: str = ""
    """Path of the receive power [dBm]."""
    first_path_power: str = ""
    """Path of the first-path power [dBm]."""


@dataclass(frozen=True)
class UwbSettings:
    """Ranging."""

    topic: str = "/uwb/ranges"
    """Topic of the ranges; with * in it, several that are one radio's, such as ``/anchor*/range``."""
    unit: Literal["auto", "m", "cm", "mm", "ft", "in"] = "auto"
    """Unit of the recorded ranges; auto: what their message says, unless only cm or mm explain them."""
    sigma_n: float = 0.1
    """Standard deviation of a range [m]."""
    nlos_gap_db: float = 10.0
    """A range whose receive power exceeds its first-path power by more than this [dB] is taken as NLOS and ignored."""
    max_beacons: int = 8
    """Slots for beacons to begin with; where more are heard, room is made in the run, which compiles anew."""
    max_range: float = 200.0
    """Longer ranges are dropped and counted [m]."""
    latency: float = 0.0
    """How long after an exchange its stamp is taken [s], by a slow serial line, say: it is subtracted."""
    height: dict[str, float] = field(default_factory=dict)
    """Height of a node's antenna above the floor by id [m]; where not given, that of the robot's antenna."""
    bias: dict[str, float] = field(default_factory=dict)
    """Range bias (antenna delay) of a node by id [m]; a pair's bias is the sum of both."""
    bias_scale: float = 0.0
    """Part of a range's bias that grows with the distance [m/m]: range = (1 + bias_scale) * distance + both biases."""
    fit_offset: bool = False
    """Whether the relative geometry of nodes at rest has a bias common to all ranges as an unknown."""
    message: RangeLayout = field(default_factory=RangeLayout)
    """Where things stand in a message that is not known, section [uwb.message]."""


@dataclass(frozen=True)
class LidarSettings:
    """The laser scanner."""

    topic: str = "/scan"
    """Topic of the scans."""
    min_range: float = 0.1
    """Shorter readings are no return [m]; the sensor's own limit holds where it is narrower."""
    max_range: float = 30.0
    """Longer readings are no return [m]; the sensor's own limit holds where it is narrower."""
    max_beams: int = 1081
    """A scan of more beams is thinned evenly to at most this many."""
    frame: str = ""
    """frame_id of the scanner to use where the topic carries several; "" for the one with most scans."""


@dataclass(frozen=True)
class OdomSettings:
    """Optional odometry: predicts the motion where a log has it."""

    topic: str = "/odom"
    """Topic of the odometry."""
    use: bool = True
    """Whether to use it."""
    sigma_xy: float = 0.05
    """Error of an increment per metre driven [m/m]."""
    sigma_yaw: float = 0.05
    """Error of an increment per radian turned [rad/rad]."""
    sigma_floor: tuple[float, float] = (0.01, 0.01)
    """Error of any increment [m, rad]."""


@dataclass(frozen=True)
class MapSettings:
    """The occupancy map."""

    resolution: float = 0.05
    """Side of a cell of the finest level [m]."""
    levels: int = 3
    """Levels of the pyramid; each doubles the cell."""
    size_m: float = 51.2
    """Side of the window that is matched against [m]; the whole map is not bounded by it."""


@dataclass(frozen=True)
class FilterSettings:
    """The estimator."""

    preset: Literal["robust", "paper"] = "robust"
    """robust: everything. paper: the paper as printed with its errata corrected."""
    engine: Literal["jax", "native", "auto"] = "jax"
    """What steps: jax; native, its twin without XLA, several times as fast, preset robust only; auto: native where it
    is compiled, else jax, and native is compiled beside the run for the next. A run and its re-run are the same to the
    bit with the same engine."""
    scan_matching: bool = True
    """Paper's case: without it the map is drawn at the UWB pose."""
    correction: bool = True
    """Paper's case: without it a match is not fed back into the state."""
    lidar_only: bool = False
    """Ignore all ranges: HectorSLAM's objective."""
    gamma: float = 0.65
    """Weight of a range's square against a beam's in the joint objective [1/m^2]; preset paper only."""
    sigma_w: float = 1.0
    """Acceleration noise of the robot [m/s^1.5]."""
    sigma_w_paper: float = 0.1
    """The paper's sigma_w, the same for every node [m/s]; preset paper only."""
    sigma_w_yaw: float = 2.0
    """Angular acceleration noise of the robot [rad/s^1.5]."""
    sigma_w_beacon: float = 1e-4
    """Random walk of a beacon at rest [m/s^0.5]."""
    sigma_w_carried: float = 1.0
    """Acceleration noise of a beacon that is being carried [m/s^1.5]."""
    sigma_l: float = 0.25
    """Standard deviation of one beam's residual 1 - Gamma."""
    independent_beams: float = 50.0
    """So many beams of a scan count as independent in a match's information, however many there are."""
    sigma_map: float = 0.004
    """Random walk of the map's own position error with the way on which it was drawn [m/m^0.5]."""
    sigma_map_yaw: float = 0.0006
    """The same for its heading [rad/m^0.5]."""


@dataclass(frozen=True)
class Settings:
    """All settings; every key is optional."""

    robot: RobotSettings = field(default_factory=RobotSettings)
    uwb: UwbSettings = field(default_factory=UwbSettings)
    lidar: LidarSettings = field(default_factory=LidarSettings)
    odom: OdomSettings = field(default_factory=OdomSettings)
    map: MapSettings = field(default_factory=MapSettings)
    filter: FilterSettings = field(default_factory=FilterSettings)


MOST_BEACONS = 200
"""Of more beacons a step's covariance alone takes megabytes and seconds [beacons]."""


def with_room(settings: Settings, beacons: int) -> Settings:
    """Settings with slots for so many beacons: uwb.max_beacons is doubled as often as it takes, to MOST_BEACONS."""
    room = settings.uwb.max_beacons
    while room < min(beacons, MOST_BEACONS):
        room = min(2 * room, MOST_BEACONS)
    return replace(settings, uwb=replace(settings.uwb, max_beacons=room))


def make_config(settings: Settings) -> Config:
    """The static part of the settings."""
    nodes = 1 + settings.uwb.max_beacons
    block = 128  # half a window is a whole number of the tiles that are kept outside it
    cells = block * round(settings.map.size_m / settings.map.resolution / block)
    return Config(
        nodes=nodes,
        max_ranges=max(32, nodes * (nodes - 1)),
        max_beams=settings.lidar.max_beams,
        resolution=settings.map.resolution,
        levels=settings.map.levels,
        cells=max(cells, block),
        nlos_gap_db=settings.uwb.nlos_gap_db,
        preset=settings.filter.preset,
        scan_matching=settings.filter.scan_matching,
        correction=settings.filter.correction,
        lidar_only=settings.filter.lidar_only,
    )


def make_params(settings: Settings, slots: dict[int, int] | None = None, found: Found | None = None) -> Params:
    """The tunable part of the settings.

    Args:
      slots: node id -> slot, for the biases and heights that are given by id; ids without a slot are left out.
      found: beyond what is configured.
    """
    f, odom = settings.filter, settings.odom
    k = 1 + settings.uwb.max_beacons
    bias = np.zeros(k, np.float32)
    height = np.full(k, settings.robot.antenna[2], np.float32)
    for node, slot in {settings.robot.id: 0, **(slots or {})}.items():
        bias[slot] = settings.uwb.bias.get(str(node), 0.0)
        if slot > 0:
            height[slot] = settings.uwb.height.get(str(node), settings.robot.antenna[2])
    found = found or Found()
    scale = settings.uwb.bias_scale
    for slot, more in found.bias.items():
        bias[slot] += (1.0 + scale) * more
    for slot, more in found.height.items():
        height[slot] += more
    of_filter = ("gamma", "sigma_w", "sigma_w_paper", "sigma_w_yaw", "sigma_w_beacon", "sigma_w_carried")
    leaves: dict[str, Any] = {name: getattr(f, name) for name in of_filter}
    leaves |= {name: getattr(f, name) for name in ("sigma_l", "independent_beams", "sigma_map", "sigma_map_yaw")}
    leaves |= {f"odom_{name}": getattr(odom, name) for name in ("sigma_xy", "sigma_yaw", "sigma_floor")}
    leaves |= {"sigma_n": settings.uwb.sigma_n, "antenna": settings.robot.antenna[:2], "lidar": settings.robot.lidar}
    leaves |= {"bias": bias, "bias_scale": (1.0 + scale) * (1.0 + found.scale) - 1.0, "height": height}
    return Params(**{name: jnp.asarray(value, jnp.float32) for name, value in leaves.items()})


def make_host_params(settings: Settings, params: Params, slots: dict[int, int] | None = None) -> HostParams:
    """What the host needs of the settings and of the parameters made from them. slots: node id -> slot."""
    leaves = {name: np.asarray(getattr(params, name), float) for name in ("antenna", "bias", "height", "lidar")}
    uwb = settings.uwb
    surveyed = np.zeros(len(leaves["height"]), bool)
    surveyed[[0, *(slot for node, slot in (slots or {}).items() if str(node) in uwb.height)]] = True
    scale, sigma_n, gap = float(params.bias_scale), uwb.sigma_n, uwb.nlos_gap_db
    return HostParams(**leaves, bias_scale=scale, sigma_n=sigma_n, nlos_gap_db=gap, surveyed=surveyed)
