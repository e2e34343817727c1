"""How a simulated robot drives: a track through waypoints, and a path in time made of pieces.

A path is a continuous function of time; speed starts and ends at zero within each piece and never jumps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np


def smooth(u: np.ndarray) -> np.ndarray:
    """From 0 at 0 to 1 at 1 with no slope at either end, constant beyond."""
    u = np.clip(u, 0.0, 1.0)
    return u**2 * (3.0 - 2.0 * u)


class Track:
    """A line through waypoints with rounded corners, by arc length.

    A corner's curvature rises linearly from zero to 1 / radius and falls again, so the yaw rate has no jumps.

    Attributes:
      length: from the start to the end, or once round if closed [m].
      first_turn: where the first corner begins [m]; the length where there is none.
    """

    def __init__(self, waypoints: np.ndarray, radius: float, closed: bool = False, lead: float | None = None):
        """Args:
        waypoints: (W, 2) [m].
        radius: the tightest radius of a corner [m].
        closed: go back to the first waypoint; the track then starts on the edge before waypoint 0.
        lead: where on that edge: this far before waypoint 0 [m], by default halfway.
        """
        points = np.asarray(waypoints, float)
        if closed:
            edge = points[0] - points[-1]
            lead = 0.5 * float(np.hypot(*edge)) if lead is None else lead
            start = points[0] - lead * edge / np.hypot(*edge)
            points = np.vstack([start, points, start])
        heading = np.unwrap(np.arctan2(*np.diff(points, axis=0).T[::-1]))
        corners = [_corner(turn, radius) for turn in np.diff(heading)]
        cut = np.array([0.0, *(c[0] for c in corners), 0.0])
        edges = np.hypot(*np.diff(points, axis=0).T)
        if np.any(cut[:-1] + cut[1:] > edges + 1e-9):
            raise ValueError("waypoints are too close for corners of this radius")
        s, pose = [np.zeros(1)], [np.array([[*points[0], heading[0]]])]
        for k, (tangent, arc, shape) in enumerate(corners):
            c, sn = np.cos(heading[k]), np.sin(heading[k])
            begin = points[k + 1] - tangent * np.array([c, sn])
            xy = begin + shape[:, :2] @ np.array([[c, sn], [-sn, c]])
            s.append(s[-1][-1] + edges[k] - cut[k] - cut[k + 1] + arc)
            pose.append(np.column_stack([xy, heading[k] + shape[:, 2]]))
        s.append(s[-1][-1:] + edges[-1] - cut[-2])
        pose.append(np.array([[*points[-1], heading[-1]]]))
        self._set(np.concatenate(s), np.concatenate(pose), closed)
        self.first_turn = float(s[1][0])

    def _set(self, s: np.ndarray, pose: np.ndarray, closed: bool) -> None:
        self._s, self._pose, self._closed = s, pose, closed
        self.length = float(s[-1])

    def swayed(self, amplitude: float, rng: np.random.Generator) -> Track:
        """The track of a driver who wanders up to `amplitude` [m] to either side, in waves of 6 m and longer.

        The same on each round of a closed track; an open one begins and ends as before.
        """
        s = np.linspace(0.0, self.length, int(self.length / 0.02) + 2)
        cycles = rng.integers(1, max(int(self.length / 6.0), 1) + 1, 3)
        aside = np.sum(np.sin(2.0 * np.pi * (np.outer(s / self.length, cycles) + rng.uniform(size=3))), axis=1)
        if not self._closed:
            aside *= smooth(s / 2.0) * smooth((self.length - s) / 2.0)
        aside *= amplitude / np.max(np.abs(aside))
        pose = np.stack([np.interp(s, self._s, column) for column in self._pose.T], -1)
        pose[:, :2] += aside[:, None] * np.stack([-np.sin(pose[:, 2]), np.cos(pose[:, 2])], -1)
        pose[:, 2] += np.arctan2(np.gradient(aside, s), 1.0 - aside * np.gradient(pose[:, 2], s))
        # differences are one-sided at the ends, where both rounds of a closed track have to meet
        pose[0, 2] = 0.5 * (pose[1, 2] + pose[-2, 2] - self._pose[-1, 2] + self._pose[0, 2])
        pose[-1, 2] = pose[0, 2] + self._pose[-1, 2] - self._pose[0, 2]
        if not self._closed:
            pose[[0, -1], 2] = self._pose[[0, -1], 2]
        track = Track.__new__(Track)
        track._set(np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(pose[:, :2], axis=0).T))]), pose, self._closed)
        track.first_turn = 0.0
        return track

    def pose(self, s: np.ndarray) -> np.ndarray:
        """Pose (n, 3) [m, m, rad] at arc length s (n,) [m]; yaw does not wrap. A closed track goes on round."""
        s = np.asarray(s, float)
        laps = np.floor(s / self.length) if self._closed else np.zeros_like(s)
        within = s - laps * self.length
        pose = np.stack([np.interp(within, self._s, column) for column in self._pose.T], -1)
        pose[:, 2] += laps * (self._pose[-1, 2] - self._pose[0, 2])
        return pose

    def sample(self, step: float) -> np.ndarray:
        """Poses (n, 3) along the track, one each step [m]."""
        return self.pose(np.linspace(0.0, self.length, int(self.length / step) + 2)[:-1])


def _corner(turn: float, radius: float) -> tuple[float, np.ndarray, np.ndarray]:
    """A corner that turns by `turn` [rad] from the x axis.

    Returns:
      its start's distance from the vertex [m], arc length (n,) [m], and pose (n, 3) from its start [m, m, rad].
    """
    if abs(turn) < 1e-9:
        return 0.0, np.zeros(1), np.zeros((1, 3))
    ramp = radius * min(0.35, abs(turn))
    length = radius * abs(turn) + ramp
    s = np.linspace(0.0, length, max(int(length / 0.005), 8) + 1)
    middle = 0.5 * (s[1:] + s[:-1])

    def yaw(at: np.ndarray) -> np.ndarray:  # the integral of the trapezoid of curvature
        up, down = np.minimum(at, ramp), np.maximum(at - (length - ramp), 0.0)
        flat = np.clip(at - ramp, 0.0, length - 2.0 * ramp)
        return np.sign(turn) * (up**2 / (2 * ramp) + flat + down - down**2 / (2 * ramp)) / radius

    steps = np.diff(s)[:, None] * np.stack([np.cos(yaw(middle)), np.sin(yaw(middle))], -1)
    xy = np.vstack([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    return float(xy[-1, 0] / (1.0 + np.cos(turn))), s, np.column_stack([xy, yaw(s)])


@runtime_checkable
class Piece(Protocol):
    """Part of a path: lasts `duration` [s]; pose (n, 3) at times (n,) [s] since it began at the pose start (3,)."""

    @property
    def duration(self) -> float: ...

    def pose(self, time: np.ndarray, start: np.ndarray) -> np.ndarray: ...


@dataclass(frozen=True)
class Rest:
    """Stands still for a duration [s]."""

    duration: float

    def pose(self, time: np.ndarray, start: np.ndarray) -> np.ndarray:
        return np.tile(start, (time.size, 1))


@dataclass(frozen=True)
class Turn:
    """Turns on the spot by an angle [rad], left if positive, at a rate [rad/s] and angular acceleration [rad/s^2]."""

    angle: float
    rate: float = np.pi / 2
    acceleration: float = 4.0

    @property
    def duration(self) -> float:
        return _travel_time(self.angle, self.rate, self.acceleration)

    def pose(self, time: np.ndarray, start: np.ndarray) -> np.ndarray:
        yaw = _travel(time, self.angle, self.rate, self.acceleration)
        return np.column_stack([np.tile(start[:2], (time.size, 1)), start[2] + yaw])


@dataclass(frozen=True)
class Along:
    """Drives on a track from one arc length [m] to another, backwards if that is smaller, at a speed [m/s]."""

    track: Track
    begin: float
    end: float
    speed: float = 0.8
    acceleration: float = 1.0

    @property
    def duration(self) -> float:
        return _travel_time(self.end - self.begin, self.speed, self.acceleration)

    def pose(self, time: np.ndarray, start: np.ndarray) -> np.ndarray:
        s = self.begin + _travel(time, self.end - self.begin, self.speed, self.acceleration)
        pose = self.track.pose(s)
        entry = self.track.pose(np.array([self.begin]))[0, 2]
        pose[:, 2] += 2.0 * np.pi * np.round((start[2] - entry) / (2.0 * np.pi))
        return pose


@dataclass(frozen=True)
class Carried:
    """Is picked up and put down at a pose [m, m, rad] within a duration [s]."""

    to: tuple[float, float, float]
    duration: float = 1.0

    def pose(self, time: np.ndarray, start: np.ndarray) -> np.ndarray:
        return start + (np.asarray(self.to) - start) * smooth(time / self.duration)[:, None]


class Path:
    """Pieces one after the other, as one continuous function of time. At rest before and after.

    Attributes:
      duration: of all pieces [s].
      pieces: what it is made of.
    """

    def __init__(self, pieces: Sequence[Piece], start: Sequence[float] | np.ndarray | None = None):
        """start: pose (3,) [m, m, rad] of the first piece; by default that of the first piece that drives."""
        self.pieces = tuple(pieces)
        if start is None:
            first = next(p for p in self.pieces if isinstance(p, Along))
            start = first.track.pose(np.array([first.begin]))[0]
        starts = [np.asarray(start, float)]
        for number, piece in enumerate(self.pieces):
            ends = piece.pose(np.array([0.0, piece.duration]), starts[-1])
            jump = np.abs(ends[0] - starts[-1])
            if jump.max() > 1e-6:
                raise ValueError(f"piece {number} ({type(piece).__name__}) does not begin where the one before ended")
            starts.append(ends[1])
        self._starts = starts
        self._times = np.concatenate([[0.0], np.cumsum([p.duration for p in self.pieces])])
        self._origin = np.zeros(3)
        self.duration = float(self._times[-1])

    def placed(self, pose: Sequence[float]) -> Path:
        """This path turned by pose[2] [rad], then shifted by pose[:2] [m]."""
        path = Path(self.pieces, self._starts[0])
        path._origin = np.asarray(pose, float)
        return path

    def pose(self, t: np.ndarray) -> np.ndarray:
        """Pose (n, 3) x, y [m], yaw [rad, unwrapped] at times t (n,) [s]."""
        t = np.clip(np.asarray(t, float), 0.0, self.duration)
        which = np.clip(np.searchsorted(self._times, t, "right") - 1, 0, len(self.pieces) - 1)
        local = np.empty((t.size, 3))
        for k in set(which.tolist()):
            chosen = which == k
            local[chosen] = self.pieces[k].pose(t[chosen] - self._times[k], self._starts[k])
        c, s = np.cos(self._origin[2]), np.sin(self._origin[2])
        xy = local[:, :2] @ np.array([[c, s], [-s, c]]) + self._origin[:2]
        return np.column_stack([xy, local[:, 2] + self._origin[2]])

    def spans(self, kind: type) -> list[tuple[float, float]]:
        """From, to [s] of each piece of a kind."""
        times = self._times.tolist()
        return [(times[k], times[k + 1]) for k, piece in enumerate(self.pieces) if isinstance(piece, kind)]

    @property
    def speed(self) -> float:
        """The highest set speed of its pieces [m/s]."""
        return max((p.speed for p in self.pieces if isinstance(p, Along)), default=0.0)


def _cruise(distance: float, speed: float, acceleration: float) -> tuple[float, float, float]:
    """Speed reached, time to reach it and time at it, for a distance >= 0 driven from rest to rest."""
    speed = min(speed, float(np.sqrt(distance * acceleration / 1.5)))
    ramp = 1.5 * speed / acceleration  # the speed rises as 3u^2 - 2u^3, whose slope peaks at 1.5
    return speed, ramp, distance / speed - ramp if speed > 0.0 else 0.0


def _travel_time(distance: float, speed: float, acceleration: float) -> float:
    """Time for a distance of either sign from rest to rest [s]."""
    _, ramp, flat = _cruise(abs(distance), speed, acceleration)
    return 2.0 * ramp + flat


def _travel(time: np.ndarray, distance: float, speed: float, acceleration: float) -> np.ndarray:
    """Distance covered (n,) at times (n,) [s]; acceleration never exceeds the given one, speed is smooth."""
    speed, ramp, flat = _cruise(abs(distance), speed, acceleration)
    if speed == 0.0:
        return np.zeros_like(time)

    def ramp_distance(since: np.ndarray) -> np.ndarray:
        u = np.clip(since / ramp, 0.0, 1.0)
        return speed * ramp * (u**3 - 0.5 * u**4)

    total = 2.0 * ramp + flat
    middle = speed * np.clip(time - ramp, 0.0, flat)
    braking = ramp_distance(np.full_like(time, ramp)) - ramp_distance(total - time)
    return np.sign(distance) * (ramp_distance(time) + middle + np.where(time > total - ramp, braking, 0.0))
