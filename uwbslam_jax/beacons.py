"""A beacon's life after start-up (DESIGN 1.7): joining, falling silent, being carried away, coming back.

Host code that looks at a few frames at a time. A beacon that is not in the state is placed from a short buffer of
ranges to nodes of known position, when its place is unique and certain; one whose ranges stop fitting, or that is
not heard for long, leaves the state and may come back the same way.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import jax.numpy as jnp
import numpy as np

from uwbslam_jax import layout
from uwbslam_jax.config import Params, Settings
from uwbslam_jax.ekf import Gaussian
from uwbslam_jax.measurements import Ranges, StampedFrame
from uwbslam_jax.multilateration import locate
from uwbslam_jax.placement import rotation
from uwbslam_jax.slam import Estimate, State

_BUFFER_S = 12.0
_FEWEST_RANGES = 12
_SILENT_S = 3.0
_DROP_S = 60.0
_MISFIT = 4.0
"""Median absolute normalised innovation of a node's ranges beyond which it is not where the state has it."""
_MISFIT_S = 1.0
_CARRIED_SHARE = 0.4
_FOUND_SHARE = 0.7
"""When the robot's ranges to so many of the beacons stop fitting at once, and one other place explains so many of
them, it is the robot that was carried. The filter may have settled where two or three of them fit by chance."""
_CARRIED_S = 0.5
_NEWEST = 4
"""So many of a beacon's newest ranges place a robot that was carried."""


@dataclass
class _Life:
    """What the host knows of one slot. heard: stamp [ns]; anchors: (stamp, known place, distance) of a node yet to be
    placed; misfits: (stamp, absolute normalised innovation); from_robot: the same of the robot's ranges, with the
    distance [m]."""

    status: str = "waiting"
    heard: int = 0
    anchors: deque[tuple[int, np.ndarray, float]] = field(default_factory=deque)
    misfits: deque[tuple[int, float]] = field(default_factory=deque)
    from_robot: deque[tuple[int, float, float]] = field(default_factory=deque)


class BeaconKeeper:
    """Life of all beacons; see the module's first lines."""

    def __init__(self, settings: Settings):
        self._nlos_gap_db = settings.uwb.nlos_gap_db
        self._sigma_n = settings.uwb.sigma_n
        self._lives: dict[int, _Life] = {}

    def status(self, slot: int) -> str:
        """static, moving, silent, dropped or waiting."""
        return self._life(slot).status

    def placed(self, slot: int, stamp: int) -> None:
        """Start-up has put a beacon into the state."""
        life = self._life(slot)
        life.status, life.heard = "static", stamp
        life.anchors.clear()

    def _life(self, slot: int) -> _Life:
        return self._lives.setdefault(slot, _Life())

    def look(
        self, state: State, params: Params, pending: list[tuple[StampedFrame, Estimate]]
    ) -> tuple[State, list[tuple[int, str]]]:
        """The state after what a few frames told about the beacons, and what happened to which slot."""
        for frame, estimate in pending:
            self._listen(frame, estimate, params)
        now = pending[-1][0].stamp
        events: list[tuple[int, str]] = []
        for life in self._lives.values():
            for buffer in (life.anchors, life.misfits, life.from_robot):
                while buffer and now - buffer[0][0] > _BUFFER_S * 1e9:
                    buffer.popleft()
        share, found = self._find_carried_robot(state, now)
        if share > _FOUND_SHARE or found is not None:
            for life in self._lives.values():
                life.misfits.clear()  # so many at once are not the beacons' fault
        if found is not None:
            return _put_robot(state, found), [(0, "was carried: found again by its ranges")]
        for slot, life in sorted(self._lives.items()):
            if life.status in ("static", "silent"):
                state = self._watch(state, slot, life, now, events)
            else:
                state = self._try_to_place(state, params, slot, life, events)
        return state, events

    def _listen(self, frame: StampedFrame, estimate: Estimate, params: Params) -> None:
        """Remember each usable range to a beacon: how it fits, or what it says about a place yet unknown."""
        r = frame.frame.ranges
        pose = np.asarray(estimate.pose, float)
        for k in map(int, np.flatnonzero(r.valid & ~(r.power_gap > self._nlos_gap_db))):
            i, j = int(r.i[k]), int(r.j[k])
            for slot, other in ((i, j), (j, i)):
                if slot == 0:
                    continue
                life = self._life(slot)
                life.heard = frame.stamp
                if estimate.active[slot]:
                    if estimate.active[other]:
                        misfit = abs(float(estimate.normalised[k]))
                        life.misfits.append((frame.stamp, misfit))
                        if other == 0:
                            life.from_robot.append((frame.stamp, misfit, _flat(r, k, slot, other, params)))
                elif estimate.active[other]:
                    place = self._place_of(other, pose, estimate, float(r.age[k]), params)
                    life.anchors.append((frame.stamp, place, _flat(r, k, slot, other, params)))

    def _find_carried_robot(self, state: State, now: int) -> tuple[float, np.ndarray | None]:
        """Share of the beacons that the robot's ranges do not fit, and where the robot is by its ranges alone when
        they say that it is not where the state has it."""
        anchors, distance, misfit = [], [], []
        mean, active = np.asarray(state.belief.mean, float), np.asarray(state.active)
        for slot, life in self._lives.items():
            recent = [row for row in life.from_robot if now - row[0] < _CARRIED_S * 1e9]
            if len(recent) < 2 or not active[slot]:
                continue
            misfit.append(float(np.median([row[1] for row in recent])) > _MISFIT)
            newest = recent[-_NEWEST:]
            anchors += [mean[2 * slot : 2 * slot + 2]] * len(newest)
            distance += [row[2] for row in newest]
        share = float(np.mean(misfit)) if len(misfit) >= 3 else 0.0
        if share < _CARRIED_SHARE:
            return share, None
        # the newest ranges were taken on the move: a few decimetres are as good as they get
        found = locate(np.array(anchors), np.array(distance), np.full(len(distance), 2 * self._sigma_n))
        if found is None:
            return share, None
        left = np.abs(np.linalg.norm(np.array(anchors) - found[0], axis=1) - distance)
        return share, found[0] if np.mean(left < _MISFIT * self._sigma_n) > _FOUND_SHARE else None

    @staticmethod
    def _place_of(slot: int, pose: np.ndarray, estimate: Estimate, age: float, params: Params) -> np.ndarray:
        if slot > 0:
            return np.asarray(estimate.beacons[slot], float)
        heading = pose[2] + age * float(estimate.yaw_rate)
        return pose[:2] + age * np.asarray(estimate.velocity) + rotation(heading) @ np.asarray(params.antenna, float)

    def _watch(self, state: State, slot: int, life: _Life, now: int, events) -> State:
        quiet = (now - life.heard) / 1e9
        if quiet > _DROP_S:
            life.status = "dropped"
            events.append((slot, "dropped: not heard for a minute"))
            return _without(state, slot)
        if (quiet > _SILENT_S) != (life.status == "silent"):
            life.status = "silent" if quiet > _SILENT_S else "static"
            events.append((slot, "fell silent" if life.status == "silent" else "is heard again"))
        recent = [z for stamp, z in life.misfits if now - stamp < _MISFIT_S * 1e9]
        if len(recent) >= 5 and float(np.median(recent)) > _MISFIT:
            life.status = "moving"
            life.anchors.clear()
            events.append((slot, "is not where it was: placed anew"))
            return _without(state, slot)
        return state

    def _try_to_place(self, state: State, params: Params, slot: int, life: _Life, events) -> State:
        if len(life.anchors) < _FEWEST_RANGES:
            return state
        anchors = np.array([a[1] for a in life.anchors])
        distance = np.array([a[2] for a in life.anchors])
        place = locate(anchors, distance, np.full(len(distance), self._sigma_n))
        if place is None:
            return state
        life.status = "static"
        life.anchors.clear()
        life.misfits.clear()
        events.append((slot, "placed"))
        return _with(state, slot, *place)


def _flat(r: Ranges, k: int, i: int, j: int, params: Params) -> float:
    """Distance in the plane of one range between two slots, biases and heights taken off [m]."""
    rise = float(params.height[i] - params.height[j])
    slant = float(r.range[k] - params.bias[i] - params.bias[j])
    return float(np.sqrt(max(slant**2 - rise**2, 0.01)))


def _put_robot(state: State, position: np.ndarray) -> State:
    """The state with the robot somewhere else: at rest, heading unknown, the map where it was."""
    k = state.active.shape[0]
    rows = jnp.array([0, 1, 2 * k, 2 * k + 1, 4 * k, 4 * k + 1, *layout.map_error_indices(k)])
    variance = jnp.array([0.3**2, 0.3**2, 1.0, 1.0, 10.0, 1.0, 0.05**2, 0.05**2, 0.01**2])
    mean = state.belief.mean.at[rows].set(0.0).at[:2].set(jnp.asarray(position, jnp.float32))
    mean = mean.at[4 * k].set(state.belief.mean[4 * k])
    P = state.belief.cov.at[rows, :].set(0.0).at[:, rows].set(0.0).at[rows, rows].set(variance)
    return state._replace(belief=Gaussian(mean, P))


def _with(state: State, slot: int, position: np.ndarray, cov: np.ndarray) -> State:
    """The state with a beacon put in, independent of the rest."""
    k = state.active.shape[0]
    at, velocity = jnp.array([2 * slot, 2 * slot + 1]), jnp.array([2 * (k + slot), 2 * (k + slot) + 1])
    mean = state.belief.mean.at[at].set(jnp.asarray(position, jnp.float32)).at[velocity].set(0.0)
    P = state.belief.cov
    for rows in (at, velocity):
        P = P.at[rows, :].set(0.0).at[:, rows].set(0.0)
    P = P.at[at[:, None], at[None, :]].set(jnp.asarray(cov, jnp.float32)).at[velocity, velocity].set(1e-8)
    return state._replace(belief=Gaussian(mean, P), active=state.active.at[slot].set(True))


def _without(state: State, slot: int) -> State:
    """The state without a beacon; its row of the covariance becomes that of an empty slot."""
    state = _with(state, slot, np.zeros(2), np.eye(2))
    return state._replace(active=state.active.at[slot].set(False))
