"""What can be tuned: names of parameters, where they stand in Params and in the settings, and what is known of them.

Noises are tuned as logarithms, geometry (range biases, where the LiDAR sits) as it is.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
from collections.abc import Mapping, Sequence

import jax.numpy as jnp
from jaxtyping import Array, Float

from uwbslam_jax.errors import ConfigError
from uwbslam_jax.settings import Params, Settings

NOISES: dict[str, tuple[str, str, str]] = {
    "gamma": ("filter", "gamma", "1/m^2"),
    "sigma_n": ("uwb", "sigma_n", "m"),
    "sigma_w": ("filter", "sigma_w", "m/s^1.5"),
    "sigma_w_paper": ("filter", "sigma_w_paper", "m/s"),
    "sigma_w_yaw": ("filter", "sigma_w_yaw", "rad/s^1.5"),
    "sigma_w_beacon": ("filter", "sigma_w_beacon", "m/s^0.5"),
    "sigma_l": ("filter", "sigma_l", ""),
    "independent_beams": ("filter", "independent_beams", ""),
    "sigma_map": ("filter", "sigma_map", "m/m^0.5"),
    "sigma_map_yaw": ("filter", "sigma_map_yaw", "rad/m^0.5"),
    "odom_sigma_xy": ("odom", "sigma_xy", "m/m"),
    "odom_sigma_yaw": ("odom", "sigma_yaw", "rad/rad"),
}
"""Leaf of Params -> section and key of the settings, unit."""
MOUNTING = {"lidar.x": (0, "m", 0.3), "lidar.y": (1, "m", 0.3), "lidar.yaw": (2, "rad", 0.3)}
"""Name -> place in the settings' LiDAR pose, unit, how far it may be off the configured value."""
BIAS = "bias."
"""A node's range bias is called by this and the node's id [m]."""
BIAS_M = 0.3
"""How far a bias may be off the configured one [m]."""
DEFAULTS = {"robust": ("sigma_n", "sigma_l"), "paper": ("gamma", "sigma_n", "sigma_w_paper")}
"""What is tuned where nothing is named: the sensors. sigma_w tells how a recording was driven: another one, or a start
from rest, which no rollout sees, may be rougher."""
LOG_SPREAD = math.log(10.0)
"""Spread of the logarithm of a noise that nothing is known of but its default: a factor of ten."""


def is_noise(name: str) -> bool:
    """Whether a parameter is tuned as a logarithm along the rollout."""
    return name in NOISES


def unit(name: str) -> str:
    """Unit of a parameter."""
    if name in NOISES:
        return NOISES[name][2]
    return MOUNTING[name][1] if name in MOUNTING else "m"


def check(names: Sequence[str]) -> tuple[str, ...]:
    """The same names, each once.

    Raises:
      ConfigError: a name that is no parameter; it names the nearest one.
    """
    for name in names:
        node = name.removeprefix(BIAS)
        if name in NOISES or name in MOUNTING or (name.startswith(BIAS) and node.isascii() and node.isdigit()):
            continue
        known = [*NOISES, *MOUNTING, f"{BIAS}1"]
        near = difflib.get_close_matches(name, known, 1, cutoff=0.0)[0]
        raise ConfigError(f"no parameter {name} to tune, did you mean {near}?")
    return tuple(dict.fromkeys(names))


def put(params: Params, names: Sequence[str], logs: Float[Array, "p"]) -> Params:
    """Params with noises set from their logarithms."""
    return params._replace(**{name: jnp.exp(logs[k]) for k, name in enumerate(names)})


def value(settings: Settings, name: str) -> float:
    """What a parameter is configured as."""
    if name in NOISES:
        section, key, _ = NOISES[name]
        return float(getattr(getattr(settings, section), key))
    if name in MOUNTING:
        return float(settings.robot.lidar[MOUNTING[name][0]])
    return float(settings.uwb.bias.get(name.removeprefix(BIAS), 0.0))


def configured(settings: Settings, values: Mapping[str, float]) -> Settings:
    """Settings with parameters set by name, to the six digits that a file has of them."""
    for name, exact in values.items():
        number = float(f"{exact:.6g}")
        if name in NOISES:
            section, key, _ = NOISES[name]
            changed = dataclasses.replace(getattr(settings, section), **{key: number})
        elif name in MOUNTING:
            section, lidar = "robot", list(settings.robot.lidar)
            lidar[MOUNTING[name][0]] = number
            changed = dataclasses.replace(settings.robot, lidar=tuple(lidar))
        else:
            section = "uwb"
            bias = {**settings.uwb.bias, name.removeprefix(BIAS): number}
            changed = dataclasses.replace(settings.uwb, bias=bias)
        settings = dataclasses.replace(settings, **{section: changed})
    return settings
