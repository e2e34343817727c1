"""Public recordings without LiDAR as messages of ours: read where they lie, nothing of them is part of the project.

Each comes with the settings that its owner would write; what is to be found out (beacons, track) is truth only.
"""

from __future__ import annotations

import gzip
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from uwbslam_jax import (
    MapSettings,
    OdometryMessage,
    RangeMessage,
    RobotSettings,
    Settings,
    TruthMessage,
    UwbSettings,
)
from uwbslam_jax.measurements import Message

LIGHT = 299.792458
"""Speed of light [m/us]."""
_FOOT = 0.3048
_SMALL_MAP = MapSettings(size_m=12.8)
"""There is nothing to draw."""


@dataclass(frozen=True)
class PublicLog:
    """One recording.

    Attributes:
      name: of the folder. messages: by stamp. settings: the defaults and what is named in `configured`.
      beacons: id -> true position [m].
      configured: settings other than the defaults, in words.
    """

    name: str
    messages: list[Message]
    settings: Settings
    beacons: dict[int, tuple[float, float]]
    configured: str


def plaza2(folder: Path) -> PublicLog:
    """CMU Plaza 2 (Djugash et al. 2009): a mower with wheel odometry, a fibre gyro and ranges to four beacons.

    Raises:
      OSError: a file is missing.
    """
    wheels = np.loadtxt(folder / "Plaza2_DR.txt")
    ranges = np.loadtxt(folder / "Plaza2_TD.txt")
    truth = np.loadtxt(folder / "Plaza2_GT.csv", delimiter=",")
    beacons = {
        int(row[0]): (float(row[1]), float(row[2])) for row in np.loadtxt(folder / "Plaza2_TL.csv", delimiter=",")
    }
    yaw = np.cumsum(wheels[:, 2])
    middle = yaw - wheels[:, 2] / 2
    track = np.cumsum(wheels[:, 1:2] * np.stack([np.cos(middle), np.sin(middle)], axis=-1), axis=0)
    messages: list[Message] = list(_odometry(wheels[:, 0], np.column_stack([track, yaw])))
    messages += [RangeMessage(_ns(t), int(a), int(b), float(d)) for t, a, b, d in ranges]
    # its heading is that of the rear: the course differs from it by half a turn throughout
    messages += [TruthMessage(_ns(t), None, x, y, heading + np.pi) for t, x, y, heading in truth]
    settings = Settings(robot=RobotSettings(id=2), map=_SMALL_MAP)
    return PublicLog("plaza2", _in_order(messages, beacons), settings, beacons, "robot.id")


def labyrinth(folder: Path) -> PublicLog:
    """Labyrinth of libRSF (Pfeifer 2023): a small robot with wheels that ranges to four anchors one at a time.

    Against the reference the column named right wheel is the left one, and the distance between wheels is half of
    what makes the turns right; with both mended dead reckoning alone is 0.06 m RMS off.

    Raises:
      OSError: a file is missing.
    """
    rows = [line.split() for line in (folder / "Indoor_UWB_Input.txt").read_text().splitlines()]
    ranges = np.array([row[1:] for row in rows if row[0] == "range2"], float)
    wheels = np.array([row[1:] for row in rows if row[0] == "odom2diff"], float)
    truth = np.array([line.split()[1:4] for line in (folder / "Indoor_UWB_GT.txt").read_text().splitlines()], float)
    beacons = {int(row[5]): (float(row[3]), float(row[4])) for row in ranges}
    left, right, base = wheels[:-1, 1], wheels[:-1, 2], 2 * wheels[:-1, 4]
    dt = np.diff(wheels[:, 0])
    turn, driven = (right - left) / base * dt, (right + left) / 2 * dt
    yaw = np.concatenate([[0.0], np.cumsum(turn)])
    middle = yaw[:-1] + turn / 2
    steps = driven[:, None] * np.stack([np.cos(middle), np.sin(middle)], axis=-1)
    track = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    messages: list[Message] = list(_odometry(wheels[:, 0], np.column_stack([track, yaw])))
    messages += [RangeMessage(_ns(row[0]), 0, int(row[5]), float(row[1])) for row in ranges]
    messages += [TruthMessage(_ns(t), None, x, y) for t, x, y in truth]
    return PublicLog("labyrinth", _in_order(messages, beacons), Settings(map=_SMALL_MAP), beacons, "-")


P2P_OFFSET = 154.9
"""Common offset of all ranges of p2p, antenna delays included [m]."""
P2P_BAR_M = 0.22
"""What the relative geometry of p2p has to stay below with that offset [m RMS]."""
_P2P_FEET = {8: (0, 0), 12: (15, 1), 14: (2, 9), 54: (20, 3), 61: (10, 0), 81: (17, 7), 87: (8, 8)}
_P2P_EXCHANGE = 3_000_000


def p2p(folder: Path, *, offset_given: bool = True) -> PublicLog:
    """Eight static nodes, all pairs (acshi/non-parametric-uwb): the rows have no time, so pairs take turns here.

    A row tells the powers of three receptions; the range is as good as the worst of them.

    Raises:
      OSError: a file is missing.
    """
    with gzip.open(folder / "dataset4.txt.gz", "rt") as file:
        rows = np.loadtxt(file)
    gaps = rows[:, 8::6] - rows[:, 7::6]
    worst = np.argmax(gaps, axis=1)
    taken: dict[tuple[int, int], int] = {}
    messages: list[Message] = []
    pairs = {pair: k for k, pair in enumerate(sorted({(int(row[1]), int(row[2])) for row in rows}))}
    for row, reception in zip(rows, worst, strict=True):
        pair = int(row[1]), int(row[2])
        turn = taken[pair] = taken.get(pair, -1) + 1
        stamp = _ns(1.0) + (turn * len(pairs) + pairs[pair]) * _P2P_EXCHANGE
        received, first_path = float(row[8 + 6 * reception]), float(row[7 + 6 * reception])
        messages.append(RangeMessage(stamp, pair[0], pair[1], float(row[0]) * LIGHT, received, first_path))
    beacons = {node: (x * _FOOT, y * _FOOT) for node, (x, y) in _P2P_FEET.items()}
    nodes = {node for pair in pairs for node in pair}
    bias = {str(node): P2P_OFFSET / 2 for node in sorted(nodes)} if offset_given else {}
    settings = replace(Settings(map=_SMALL_MAP), uwb=UwbSettings(bias=bias, fit_offset=not offset_given))
    configured = f"uwb.bias = {P2P_OFFSET / 2:g} m each" if offset_given else "uwb.fit_offset"
    return PublicLog("p2p", _in_order(messages, {}), settings, beacons, configured)


DRIVEN: dict[str, Callable[[Path], PublicLog]] = {"plaza2": plaza2, "labyrinth": labyrinth}
"""The ones with a robot that moves, by the name of their folder."""


def _odometry(t: np.ndarray, poses: np.ndarray) -> Iterable[OdometryMessage]:
    for seconds, (x, y, yaw) in zip(t.tolist(), poses.tolist(), strict=True):
        yield OdometryMessage(_ns(seconds), x, y, yaw)


def _ns(seconds: float) -> int:
    return round(seconds * 1e9)


def _in_order(messages: Iterable[Message], beacons: dict[int, tuple[float, float]]) -> list[Message]:
    """By stamp, the true beacons at the first one."""
    found = sorted(messages, key=lambda message: message.stamp)
    return [*(TruthMessage(found[0].stamp, node, x, y) for node, (x, y) in beacons.items()), *found]
