"""The simulated robot behind the emulators: its measurements in the order of time, its clocks, and the truth.

Times here are nanoseconds since the robot set off; `Departure` says when that was. All emulators of one command share
one departure, so that LiDAR and UWB belong to one run.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from uwbslam_jax.measurements import RangeMessage, ScanMessage
from uwbslam_jax.sim import INF, START_NS, Lidar, Scenario, Uwb, beacon_positions, simulate

_NEVER = 1e-9
"""Rate of a device that is left out: less than one measurement in any simulation [Hz]."""
_TRUTH_RATE = 50.0
"""Rate of the ground truth [Hz]: between its poses, a robot at 2 m/s drives straight but for a millimetre."""


class Departure:
    """The moment at which the robot sets off: when the first program listens to any of its devices.

    Attributes:
      at: host time of the moment [ns], None until then.
    """

    def __init__(self) -> None:
        self.at: int | None = None
        self._lock = threading.Lock()

    def now(self, host: int) -> None:
        """The robot sets off at this host time [ns], unless it has already."""
        with self._lock:
            if self.at is None:
                self.at = host


@dataclass(frozen=True)
class DeviceTime:
    """A device's own clock: what it shows when it is switched on [ns], and how much too fast it runs [1e-6]."""

    boot: int
    shows: int = 0
    drift: float = 0.0

    def at(self, host: int) -> int:
        """What it shows at a host time [ns]."""
        since = host - self.boot
        return self.shows + since + round(since * self.drift * 1e-6)


def host_stamp(stamp: int, departure: int) -> int:
    """Host time [ns] of a simulated stamp [ns]."""
    return departure + stamp - START_NS


def scans(scenario: Scenario, lidar: Lidar) -> Iterator[tuple[int, ScanMessage]]:
    """Scans of a LiDAR on the robot, each with the time of its last beam."""
    sweep = round((lidar.beams - 1) * lidar.time_increment * 1e9)
    for message in simulate(replace(scenario, lidar=lidar, uwb=Uwb(rate=_NEVER), wheels=None)):
        if isinstance(message, ScanMessage):
            yield message.stamp - START_NS + sweep, message


def ranges(scenario: Scenario) -> Iterator[tuple[int, RangeMessage]]:
    """All exchanges, also between beacons, each with its time."""
    for message in simulate(replace(scenario, lidar=Lidar(rate=_NEVER), wheels=None)):
        if isinstance(message, RangeMessage):
            yield message.stamp - START_NS, message


def rounds(scenario: Scenario) -> Iterator[tuple[int, list[RangeMessage]]]:
    """The robot's own exchanges, one list for each round, with the time of the last."""
    open_round: list[RangeMessage] = []
    for _, message in ranges(scenario):
        if message.source != scenario.uwb.robot_id:
            continue
        if open_round and message.stamp - open_round[0].stamp > 0.5e9 / scenario.uwb.rate:
            yield open_round[-1].stamp - START_NS, open_round
            open_round = []
        open_round.append(message)


def truth(scenario: Scenario, departure: int, duration: float) -> dict[str, np.ndarray]:
    """Where robot and beacons are over a time from the departure [s]; in the frame of the scenario.

    Returns:
      t (T,) host time [s], robot (T, 3) [m, m, rad], ids (N,), beacons (T, N, 2) [m], alive (T, N).
    """
    t = np.arange(max(int(duration * _TRUTH_RATE), 1) + 1) / _TRUTH_RATE
    positions = [beacon_positions(scenario, beacon, t) for beacon in scenario.beacons]
    alive = [sum(((t >= a) & (t < b)) for a, b in beacon.alive) > 0 for beacon in scenario.beacons]
    return {
        "t": departure / 1e9 + t,
        "robot": scenario.path.pose(t),
        "ids": np.array([beacon.id for beacon in scenario.beacons]),
        "beacons": np.stack(positions, 1),
        "alive": np.stack(alive, 1),
    }


def write_truth(path: Path, scenario: Scenario, departure: int, duration: float) -> None:
    """Writes `truth` to an .npz file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **truth(scenario, departure, min(duration, INF)))
