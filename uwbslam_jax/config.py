"""Settings a user writes (TOML or flags) and the two things they become: static Config and tunable Params.

Settings are plain host data, one dataclass a TOML section. Config is hashable and fixes sizes and switches, so
it may be a static argument of a jitted function. Params are the differentiable leaves.
"""

from __future__ import annotations

import dataclasses
import difflib
import json
import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args, get_origin, get_type_hints

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


class ConfigError(ValueError):
    """A setting that is unknown, of the wrong type or out of range; the message is one line."""


class Params(NamedTuple):
    """The tunable leaves, all differentiable. K = 1 + max_beacons slots, slot 0 is the robot.

    Attributes:
      gamma, sigma_n, sigma_w, sigma_w_paper, sigma_w_yaw, sigma_w_beacon, sigma_l, beam_share, sigma_map,
        sigma_map_yaw: see FilterSettings and UwbSettings.
      odom_sigma_xy, odom_sigma_yaw, odom_sigma_floor: see OdomSettings.
      antenna: x, y of the UWB antenna on the robot [m].
      lidar: pose of the LiDAR on the robot [m, m, rad].
      bias: (K,) range bias of each node [m].
      height: (K,) height of each node's antenna [m].
    """

    gamma: Float[Array, ""]
    sigma_n: Float[Array, ""]
    sigma_w: Float[Array, ""]
    sigma_w_paper: Float[Array, ""]
    sigma_w_yaw: Float[Array, ""]
    sigma_w_beacon: Float[Array, ""]
    sigma_l: Float[Array, ""]
    beam_share: Float[Array, ""]
    sigma_map: Float[Array, ""]
    sigma_map_yaw: Float[Array, ""]
    odom_sigma_xy: Float[Array, ""]
    odom_sigma_yaw: Float[Array, ""]
    odom_sigma_floor: Float[Array, "2"]
    antenna: Float[Array, "2"]
    lidar: Float[Array, "3"]
    bias: Float[Array, "K"]
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


@dataclass(frozen=True)
class RobotSettings:
    """The robot: its UWB node id and where its sensors sit in the robot's frame."""

    id: int = 0
    """Node id of the robot's UWB radio."""
    antenna: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """UWB antenna x, y, z on the robot [m]."""
    lidar: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """LiDAR x, y [m] and yaw [rad] on the robot."""


@dataclass(frozen=True)
class UwbSettings:
    """Ranging."""

    topic: str = "/uwb/ranges"
    """Topic of the ranges."""
    sigma_n: float = 0.1
    """Standard deviation of a range [m]."""
    nlos_gap_db: float = 10.0
    """A range whose receive power exceeds its first-path power by more than this [dB] is taken as NLOS and ignored."""
    max_beacons: int = 8
    """Slots for beacons; ids beyond are counted and ignored."""
    max_range: float = 200.0
    """Longer ranges are dropped and counted [m]."""
    height: dict[str, float] = field(default_factory=dict)
    """Height of a node's antenna above the floor by id [m]; where not given, that of the robot's antenna."""
    bias: dict[str, float] = field(default_factory=dict)
    """Range bias (antenna delay) of a node by id [m]; a pair's bias is the sum of both."""


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
    """robust: everything. paper: the paper as printed with its errata mended."""
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
    sigma_l: float = 0.25
    """Standard deviation of one beam's residual 1 - Gamma."""
    beam_share: float = 0.05
    """Share of the beams that counts as independent in a match's information."""
    sigma_map: float = 0.08
    """Standard deviation of the map's own position error where it was drawn while exploring [m]."""
    sigma_map_yaw: float = 0.01
    """The same for its heading [rad]."""


@dataclass(frozen=True)
class Settings:
    """All settings; every key is optional."""

    robot: RobotSettings = field(default_factory=RobotSettings)
    uwb: UwbSettings = field(default_factory=UwbSettings)
    lidar: LidarSettings = field(default_factory=LidarSettings)
    odom: OdomSettings = field(default_factory=OdomSettings)
    map: MapSettings = field(default_factory=MapSettings)
    filter: FilterSettings = field(default_factory=FilterSettings)


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


def make_params(settings: Settings, slots: dict[int, int] | None = None) -> Params:
    """The tunable part of the settings.

    Args:
      slots: node id -> slot, for the biases and heights that are given by id; ids without a slot are left out.
    """
    f, odom = settings.filter, settings.odom
    k = 1 + settings.uwb.max_beacons
    bias = np.zeros(k, np.float32)
    height = np.full(k, settings.robot.antenna[2], np.float32)
    for node, slot in {settings.robot.id: 0, **(slots or {})}.items():
        bias[slot] = settings.uwb.bias.get(str(node), 0.0)
        if slot > 0:
            height[slot] = settings.uwb.height.get(str(node), settings.robot.antenna[2])
    of_filter = ("gamma", "sigma_w", "sigma_w_paper", "sigma_w_yaw", "sigma_w_beacon", "sigma_l")
    leaves: dict[str, Any] = {name: getattr(f, name) for name in of_filter}
    leaves |= {name: getattr(f, name) for name in ("beam_share", "sigma_map", "sigma_map_yaw")}
    leaves |= {f"odom_{name}": getattr(odom, name) for name in ("sigma_xy", "sigma_yaw", "sigma_floor")}
    leaves |= {"sigma_n": settings.uwb.sigma_n, "antenna": settings.robot.antenna[:2], "lidar": settings.robot.lidar}
    leaves |= {"bias": bias, "height": height}
    return Params(**{name: jnp.asarray(value, jnp.float32) for name, value in leaves.items()})


# Reading, checking and writing settings.

_MAX_CELLS = 4096  # side of the finest level of the matching window; beyond this the maps alone take gigabytes

_POSITIVE = [
    *("uwb.sigma_n", "uwb.max_range", "lidar.max_range", "odom.sigma_floor", "map.resolution", "map.size_m"),
    *("filter.sigma_w", "filter.sigma_w_yaw", "filter.sigma_w_beacon", "filter.sigma_l", "filter.beam_share"),
    *("filter.sigma_map", "filter.sigma_map_yaw"),
]
_NOT_NEGATIVE = ["uwb.nlos_gap_db", "lidar.min_range", "odom.sigma_xy", "odom.sigma_yaw", "filter.gamma"]
_MAY_BE_INFINITE = ["uwb.nlos_gap_db"]  # switches the rule off
_LIMITS = {
    "robot.id": (0, 2**32 - 1),
    "uwb.max_beacons": (1, 200),
    "lidar.max_beams": (1, 100_000),
    "map.levels": (1, 5),
    "filter.beam_share": (0, 1),
}


def load(path: Path | str) -> Settings:
    """Settings from a TOML file; what the file leaves out keeps its default.

    Raises:
      ConfigError: the file cannot be read or parsed, or see `from_dict`. The message starts with the path.
    """
    try:
        table = tomllib.loads(Path(path).read_text(encoding="utf-8"))
        return from_dict(table)
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror or error}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, ConfigError) as error:
        raise ConfigError(f"{path}: {error}") from error


def from_dict(table: Mapping[str, Any]) -> Settings:
    """Settings from nested tables as a TOML file holds them: section -> key -> value.

    Raises:
      ConfigError: an unknown section or key (names the nearest known one), a value of the wrong type or out of range.
    """
    defaults = Settings()
    sections: dict[str, Any] = {}
    for name, values in table.items():
        default = getattr(defaults, name, None)
        if not dataclasses.is_dataclass(default) or isinstance(default, type):
            raise ConfigError(_unknown(name))
        if not isinstance(values, Mapping):
            raise ConfigError(f"{name} is a section: write [{name}] with keys below it")
        hints = get_type_hints(type(default))
        for key in values:
            if key not in hints:
                raise ConfigError(_unknown(f"{name}.{key}"))
        typed = {key: _typed(f"{name}.{key}", value, hints[key]) for key, value in values.items()}
        sections[name] = dataclasses.replace(default, **typed)
    return check(dataclasses.replace(defaults, **sections))


def dump(settings: Settings) -> str:
    """TOML text of all settings; `load` reads it back to equal settings."""
    blocks = []
    for section in dataclasses.fields(settings):
        values = getattr(settings, section.name)
        hints = get_type_hints(type(values))
        lines = [f"{key} = {_toml(getattr(values, key), hint)}" for key, hint in hints.items()]
        blocks.append("\n".join([f"[{section.name}]", *lines]))
    return "\n\n".join(blocks) + "\n"


def check(settings: Settings) -> Settings:
    """The same settings, known to be in range.

    Raises:
      ConfigError: one line that names the first key out of range, its value and what is allowed.
    """
    flat: dict[str, Any] = {
        f"{section.name}.{key.name}": getattr(getattr(settings, section.name), key.name)
        for section in dataclasses.fields(settings)
        for key in dataclasses.fields(getattr(settings, section.name))
    }
    for name, value in flat.items():
        for number in _numbers(value):
            _check_number(name, number)
        if isinstance(value, dict):
            for node in value:
                if not (node.isascii() and node.isdigit() and int(node) < 2**32):
                    raise ConfigError(f'{name} has the key "{node}": must be a node id, an unsigned 32-bit integer')
        elif name.endswith(".topic") and not (value and value.isprintable() and " " not in value):
            raise ConfigError(f"{name} = {value!r}: must be a topic name without blanks")
    if settings.filter.preset not in ("robust", "paper"):
        raise ConfigError(f"filter.preset = {settings.filter.preset!r}: must be 'robust' or 'paper'")
    _check_together(settings)
    return settings


def _check_number(name: str, number: float) -> None:
    """Range of one number of the key `section.key`."""
    if not math.isfinite(number) and not (name in _MAY_BE_INFINITE and number > 0):
        raise ConfigError(f"{name} = {number}: must be a finite number")
    if name in _POSITIVE and not number > 0:
        raise ConfigError(f"{name} = {number}: must be greater than 0")
    if name in _NOT_NEGATIVE and not number >= 0:
        raise ConfigError(f"{name} = {number}: must not be negative")
    low, high = _LIMITS.get(name, (-math.inf, math.inf))
    if not low <= number <= high:
        raise ConfigError(f"{name} = {number}: must be from {low} to {high}")


def _check_together(settings: Settings) -> None:
    """Conditions on more than one key."""
    lidar, window, switches = settings.lidar, settings.map, settings.filter
    if lidar.min_range >= lidar.max_range:
        raise ConfigError(f"lidar.min_range = {lidar.min_range}: must be below lidar.max_range = {lidar.max_range}")
    cells = window.size_m / window.resolution
    coarsest = 2 ** (window.levels - 1)
    if not 8 * coarsest <= cells <= _MAX_CELLS:
        raise ConfigError(
            f"map.size_m = {window.size_m}: makes {cells:.0f} cells a side, must be from {8 * coarsest} to {_MAX_CELLS}"
        )
    if switches.lidar_only and not switches.scan_matching:
        raise ConfigError("filter.lidar_only = true: needs filter.scan_matching = true, nothing else would be left")


def _numbers(value: Any) -> list[float]:
    """The numbers that a setting holds; flags and text hold none."""
    if isinstance(value, bool | str):
        return []
    if isinstance(value, dict):
        return list(value.values())
    return list(value) if isinstance(value, tuple) else [value]


def _unknown(name: str) -> str:
    """Message for an unknown key or section that names the nearest known one."""
    known = [
        f"{section.name}.{key.name}"
        for section in dataclasses.fields(Settings)
        for key in dataclasses.fields(getattr(Settings(), section.name))
    ]
    sections = [section.name for section in dataclasses.fields(Settings)]
    section, _, key = name.rpartition(".")
    elsewhere = [other for other in known if other.split(".")[1] == key]
    within = [other for other in known if other.split(".")[0] == section]
    nearest = (
        elsewhere
        or difflib.get_close_matches(name, within, 1)
        or difflib.get_close_matches(name, known if section else sections, 1, cutoff=0.0)
    )
    return f"unknown key {name}, did you mean {nearest[0]}?"


def _typed(name: str, value: Any, hint: Any) -> Any:
    """A TOML value as the type that its key is declared with; an integer may stand for a float, a flag never does."""
    if get_origin(hint) is Literal:
        if value in get_args(hint):
            return value
        raise ConfigError(f"{name} = {value!r}: must be {' or '.join(map(repr, get_args(hint)))}")
    if get_origin(hint) is tuple and isinstance(value, list | tuple) and len(value) == len(get_args(hint)):
        return tuple(_typed(name, item, kind) for item, kind in zip(value, get_args(hint), strict=True))
    if get_origin(hint) is dict and isinstance(value, Mapping):
        return {str(key): _typed(f"{name}.{key}", item, get_args(hint)[1]) for key, item in value.items()}
    if hint is float and isinstance(value, int | float) and not isinstance(value, bool):
        return float(value)
    if isinstance(hint, type) and type(value) is hint:
        return value
    raise ConfigError(f"{name} = {value!r}: must be {_described(hint)}")


def _described(hint: Any) -> str:
    """A declared type in the words of a TOML file."""
    if get_origin(hint) is tuple:
        return f"a list of {len(get_args(hint))} numbers"
    if get_origin(hint) is dict:
        return 'a table of numbers by node id, as {"1" = 0.5}'
    return {float: "a number", int: "an integer", bool: "true or false", str: "text"}.get(hint, str(hint))


def _toml(value: Any, hint: Any) -> str:
    """A setting as a TOML value."""
    if isinstance(value, dict):
        return "{" + ", ".join(f'"{key}" = {float(number)!r}' for key, number in value.items()) + "}"
    if isinstance(value, tuple):
        return "[" + ", ".join(repr(float(number)) for number in value) + "]"
    if isinstance(value, bool | str):
        return json.dumps(value, ensure_ascii=False)
    return repr(float(value)) if hint is float else repr(int(value))
