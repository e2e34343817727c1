"""Settings in and out: reading TOML, checking ranges, writing TOML. What the settings are is in `settings`."""

from __future__ import annotations

import dataclasses
import difflib
import json
import math
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

from uwbslam_jax.errors import ConfigError
from uwbslam_jax.settings import MOST_BEACONS, RangeLayout, Settings

_MAX_CELLS = 4096
"""Side of the matching window at its finest level [cells]; beyond this the maps alone take gigabytes."""
_POSITIVE = [
    *("uwb.sigma_n", "uwb.max_range", "lidar.max_range", "odom.sigma_floor", "map.resolution", "map.size_m"),
    *(
        "filter.sigma_w",
        "filter.sigma_w_paper",
        "filter.sigma_w_yaw",
        "filter.sigma_w_beacon",
        "filter.sigma_w_carried",
    ),
    *("filter.sigma_l", "filter.independent_beams", "filter.sigma_map", "filter.sigma_map_yaw"),
]
"""Settings that mean nothing at 0 [keys]: noises are divided by, and limits would leave no measurement."""
_NOT_NEGATIVE = ["uwb.nlos_gap_db", "lidar.min_range", "odom.sigma_xy", "odom.sigma_yaw", "filter.gamma"]
"""Settings that may be 0, which leaves out what they weigh [keys]."""
_MAY_BE_INFINITE = ["uwb.nlos_gap_db"]
"""Settings whose infinity switches their rule off [keys]."""
_LIMITS = {
    "robot.id": (0, 2**32 - 1),
    "uwb.max_beacons": (1, MOST_BEACONS),
    "lidar.max_beams": (1, 100_000),
    "map.levels": (1, 5),
    "uwb.bias_scale": (-0.5, 1.0),
    "uwb.latency": (-5.0, 5.0),
}
"""Least and greatest value of a setting [its unit]: ids have 32 bits; beyond the others lie mistakes."""


def load_settings(path: Path | str) -> Settings:
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
    """TOML text of all settings; `load_settings` reads it back to equal settings."""
    blocks = []
    for section in dataclasses.fields(settings):
        values = getattr(settings, section.name)
        hints = get_type_hints(type(values))
        lines = [f"{key} = {_toml(getattr(values, key), hint)}" for key, hint in hints.items()]
        blocks.append("\n".join([f"[{section.name}]", *lines]))
    return "\n\n".join(blocks) + "\n"


def differences(settings: Settings) -> str:
    """TOML text of what differs from the defaults, "" where nothing does."""
    usual = dict(_blocks(dump(Settings())))
    blocks = []
    for head, lines in _blocks(dump(settings)):
        if changed := [line for line in lines if line not in usual[head]]:
            blocks.append("\n".join([head, *changed]) + "\n")
    return "\n".join(blocks)


def save_settings(settings: Settings, path: Path | str) -> None:
    """Writes what differs from the defaults as TOML, which `load_settings` reads back. Raises OSError."""
    Path(path).write_text(differences(settings), encoding="utf-8")


def _blocks(text: str) -> Iterator[tuple[str, list[str]]]:
    for block in text.strip().split("\n\n"):
        head, *lines = block.split("\n")
        yield head, lines


def check(settings: Settings) -> Settings:
    """The same settings, known to be in range.

    Raises:
      ConfigError: one line that names the first key out of range, its value and what is allowed.
    """
    for name, value in _flat(settings).items():
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
    if settings.filter.engine not in ("auto", "jax", "native"):
        raise ConfigError(f"filter.engine = {settings.filter.engine!r}: must be 'auto', 'jax' or 'native'")
    _check_together(settings)
    return settings


def _flat(settings: Settings) -> dict[str, Any]:
    """section.key -> value."""
    sections = {section.name: getattr(settings, section.name) for section in dataclasses.fields(settings)}
    return {f"{name}.{key}": value for name, section in sections.items() for key, value in vars(section).items()}


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
    message = settings.uwb.message
    if message != RangeLayout() and not (message.type and message.range):
        raise ConfigError("uwb.message: needs type, the name of the message's type, and range, the path of the range")
    cells = window.size_m / window.resolution
    coarsest = 2 ** (window.levels - 1)
    if not 8 * coarsest <= cells <= _MAX_CELLS:
        raise ConfigError(
            f"map.size_m = {window.size_m}: makes {cells:.0f} cells a side, must be from {8 * coarsest} to {_MAX_CELLS}"
        )
    if switches.engine == "native" and switches.preset != "robust":
        raise ConfigError(f"filter.engine = 'native': serves filter.preset = 'robust' only, not {switches.preset!r}")
    if switches.lidar_only and not switches.scan_matching:
        raise ConfigError("filter.lidar_only = true: needs filter.scan_matching = true, nothing else would be left")


def _numbers(value: Any) -> list[float]:
    """The numbers that a setting holds; flags, text and sections below a section hold none."""
    if isinstance(value, bool | str | RangeLayout):
        return []
    if isinstance(value, dict):
        return list(value.values())
    return list(value) if isinstance(value, tuple) else [value]


def _unknown(name: str) -> str:
    """Message for an unknown key or section that names the nearest known one."""
    known, sections = list(_flat(Settings())), [section.name for section in dataclasses.fields(Settings)]
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
    if dataclasses.is_dataclass(hint) and isinstance(hint, type) and isinstance(value, Mapping):
        hints = get_type_hints(hint)
        for key in value:
            if key not in hints:
                near = difflib.get_close_matches(str(key), hints, 1, cutoff=0.0)
                raise ConfigError(f"unknown key {name}.{key}, did you mean {name}.{near[0]}?")
        return hint(**{key: _typed(f"{name}.{key}", item, hints[key]) for key, item in value.items()})
    if isinstance(hint, type) and type(value) is hint:
        return value
    raise ConfigError(f"{name} = {value!r}: must be {_described(hint)}")


def _described(hint: Any) -> str:
    """A declared type in the words of a TOML file."""
    if get_origin(hint) is tuple:
        return f"a list of {len(get_args(hint))} numbers"
    if get_origin(hint) is dict:
        return 'a table of numbers by node id, as {"1" = 0.5}'
    if dataclasses.is_dataclass(hint):
        return "a section with keys below it"
    return {float: "a number", int: "an integer", bool: "true or false", str: "text"}.get(hint, str(hint))


def _toml(value: Any, hint: Any) -> str:
    """A setting as a TOML value; of a section below a section, what differs from its defaults."""
    if isinstance(value, RangeLayout):
        pairs = [
            (f.name, getattr(value, f.name)) for f in dataclasses.fields(value) if getattr(value, f.name) != f.default
        ]
        return "{" + ", ".join(f"{key} = {_toml(item, str)}" for key, item in pairs) + "}"
    if isinstance(value, dict):
        return "{" + ", ".join(f'"{key}" = {float(number)!r}' for key, number in value.items()) + "}"
    if isinstance(value, tuple):
        return "[" + ", ".join(repr(float(number)) for number in value) + "]"
    if isinstance(value, bool | str):
        return json.dumps(value, ensure_ascii=False)
    return repr(float(value)) if hint is float else repr(int(value))
