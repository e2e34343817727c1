"""Odometry as one track without jumps: where its origin changes, increments go on from where it was."""

from __future__ import annotations

import math
from collections import deque

from uwbslam_jax.measurements import OdometryMessage

Pair = tuple[float, float]
"""Of a way [m] and of a turn [rad]."""

_SPEED, _ACCELERATION, _MARGIN = (1.0, 1.0), (5.0, 15.0), (0.1, 0.1)
"""An increment may exceed what the last ones say by such a speed [m/s, rad/s], by what such an acceleration makes of it
[m/s^2, rad/s^2], and by so much [m, rad]: stamps that come late and slow odometry are no jumps."""
_USUAL, _MOST = (3.0, 6.0), (15.0, 30.0)
"""Speed that any robot may reach between two messages, and that none has; in between twice the fastest so far holds
[m/s, rad/s]."""
_TURN = 2 * math.pi
"""A whole turn [rad]."""
_NEAR_ORIGIN = 0.02
"""A pose so close to zero is where a track begins [m, rad]."""
_LEAP, _LEAP_LEAST = 3.0, 0.05
"""A track begins again where it comes to zero by a step so many times longer than the last ones, and at least so long
[ratio; m, rad]."""
_KNOWN = 5
"""Fewer increments do not tell how fast the robot is [increments]."""
_SILENT = 10.0
"""A pause of so many intervals in which the pose came to zero is a restart [intervals]."""
_RECENT = 20
"""Increments that tell how fast the robot is [increments]."""
_HOLD_S = 0.3
"""Over a jump the motion is taken to go on as before, for so long [s]; over a longer one there is no increment."""
_OFTEN = 5
"""After more jumps among the recent increments, none is worth anything [increments]: positions in other units."""
_NEARLY_ALL = 0.2
"""Share of increments that are jumps from which on they are no restarts."""


class OdometryTrack:
    """Poses with the jumps of their origin taken out; without one they are passed on as they are.

    Attributes:
      messages, jumps: poses so far, and how many began at a new origin.
    """

    def __init__(self) -> None:
        self.messages = self.jumps = 0
        self._start = self._first_jump = 0
        self._raw: OdometryMessage | None = None
        self._out: OdometryMessage | None = None
        self._intervals: deque[float] = deque(maxlen=_RECENT)
        self._speeds: deque[Pair] = deque(maxlen=_RECENT)
        self._jumped: deque[bool] = deque(maxlen=_RECENT)
        self._velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)
        self._suspect: Pair = (0.0, 0.0)
        self._fastest: Pair = (0.0, 0.0)

    def join(self, message: OdometryMessage) -> tuple[OdometryMessage, bool]:
        """The pose on the track, and whether an increment leads to it; False where a track begins.

        Args:
          message: later than the one before.
        """
        self.messages += 1
        last, out, self._raw = self._raw, self._out, message
        if last is None or out is None:
            self._start, self._out = message.stamp, message
            return message, False
        dt = (message.stamp - last.stamp) / 1e9
        usual = sorted(self._intervals)[len(self._intervals) // 2] if self._intervals else dt
        dx, dy, dyaw = message.x - last.x, message.y - last.y, math.remainder(message.yaw - last.yaw, _TURN)
        span = max(dt, usual)
        size = math.hypot(dx, dy), abs(dyaw)
        joined = True
        jump = self._is_jump(message, size, span, paused=dt > _SILENT * usual)
        self._jumped.append(jump)
        if jump:
            self.jumps += 1
            self._first_jump = self._first_jump or message.stamp
            self._suspect = size[0] / span, size[1] / span
            forward, left, turn = (v * dt for v in self._velocity)
            joined = dt <= max(_HOLD_S, 2 * usual)
        else:
            c, s = math.cos(last.yaw), math.sin(last.yaw)
            forward, left, turn = c * dx + s * dy, c * dy - s * dx, dyaw
            self._suspect = (0.0, 0.0)
            self._intervals.append(dt)
            speed = size[0] / span, size[1] / span
            self._speeds.append(speed)
            self._fastest = max(self._fastest[0], speed[0]), max(self._fastest[1], speed[1])
            self._velocity = forward / span, left / span, turn / span
        self._out = _onward(out, (forward, left, turn), message.stamp) if self.jumps else message
        return self._out, joined and sum(self._jumped) <= _OFTEN

    def _is_jump(self, message: OdometryMessage, size: Pair, span: float, *, paused: bool) -> bool:
        """Whether a step of a size [m, rad] in a time [s] is none that a robot makes."""
        recent = max((v[0] for v in self._speeds), default=0.0), max((v[1] for v in self._speeds), default=0.0)
        known = len(self._speeds) >= _KNOWN
        for k in range(2):
            most = min(max(_USUAL[k], 2 * self._fastest[k], 1.5 * self._suspect[k]), _MOST[k])
            speed = max(recent[k], self._suspect[k]) + _SPEED[k] + _ACCELERATION[k] * span
            speed = min(speed, most) if known else most
            if size[k] > speed * span + _MARGIN[k]:
                return True
        if math.hypot(message.x, message.y) > _NEAR_ORIGIN or abs(math.remainder(message.yaw, _TURN)) > _NEAR_ORIGIN:
            return False
        return known and any(size[k] > (0.0 if paused else _LEAP * recent[k] * span) + _LEAP_LEAST for k in range(2))

    def told(self) -> list[str]:
        """What a user should know, empty where nothing jumped."""
        leave = "--no-odom leaves it out"
        if self.jumps > _NEARLY_ALL * self.messages:
            return [
                f"odometry: {self.jumps} of {self.messages} steps are none that a robot makes and are left out: are "
                f"its positions in m, its orientations right? ({leave})"
            ]
        at = (self._first_jump - self._start) / 1e9
        jumps = (
            f"odometry jumps ({self.jumps} times, first after {at:.1f} s): the base was restarted or something "
            f"corrects its pose; it goes on from a new origin ({leave})"
        )
        return [jumps] if self.jumps else []


def _onward(pose: OdometryMessage, step: tuple[float, float, float], stamp: int) -> OdometryMessage:
    """The pose a step [m, m, rad] on from another."""
    c, s = math.cos(pose.yaw), math.sin(pose.yaw)
    x, y = pose.x + c * step[0] - s * step[1], pose.y + s * step[0] + c * step[1]
    return OdometryMessage(stamp, x, y, math.remainder(pose.yaw + step[2], _TURN))
