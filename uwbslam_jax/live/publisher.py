"""A live run as ROS 2 messages over a Foxglove WebSocket, for Foxglove and Lichtblick, without ROS.

The messages are those of result.mcap. Needs foxglove-sdk, the extra `live`.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from uwbslam_jax.errors import UsageError
from uwbslam_jax.files import result_log, ros_types
from uwbslam_jax.session import Session, Update

BEACONS_S, MAP_S = 1.0, 5.0
"""Time between two messages of the beacons, which hardly move, and of the map, which is large [s]."""


class Publisher:
    """Publishes poses and transforms of each step, beacons and map now and then.

    Attributes:
      url: where.
    """

    def __init__(self, host: str, port: int):
        """Opens the port; 0 for any that is free. Raises UsageError where it cannot, or the package is not there."""
        try:
            import foxglove
        except ImportError:
            raise UsageError("--publish needs foxglove-sdk: pip install 'uwbslam_jax[live]'") from None
        self._foxglove: Any = foxglove
        self._context = foxglove.Context()
        try:
            self._server = foxglove.start_server(name="uwbslam", host=host, port=port, context=self._context)
        except (RuntimeError, OSError, ValueError) as error:
            raise UsageError(f"publishing at {host}:{port}: {error}") from None
        self.url = f"ws://{host}:{self._server.port}"
        self._channels: dict[str, Any] = {}
        self._beacons_at = self._map_at = 0.0

    def step(self, session: Session, update: Update) -> None:
        """Takes in one step; called by the loop."""
        stamp, now = update.stamp, time.monotonic()
        x, y, yaw = update.pose.tolist()
        self._log("/pose", result_log.pose_with_covariance(stamp, x, y, yaw, update.cov), stamp)
        self._log("/tf", result_log.robot_transform(stamp, x, y, yaw), stamp)
        if now - self._beacons_at > BEACONS_S:
            self._beacons_at = now
            placed = [b for b in update.beacons.values() if np.isfinite(b.position).all()]
            self._log("/beacons", result_log.beacon_markers(stamp, placed), stamp)
        if now - self._map_at > MAP_S and session.state.scans_drawn > 0:
            self._map_at = now
            self._log("/map", result_log.occupancy(session.map(), stamp), stamp)

    def close(self) -> None:
        """Ends all connections."""
        self._server.stop()

    def _log(self, topic: str, message: tuple[str, bytes], stamp: int) -> None:
        name, data = message
        if topic not in self._channels:
            schema = self._foxglove.Schema(name=name, encoding="ros2msg", data=ros_types.definition(name))
            channel = self._foxglove.Channel(topic, schema=schema, message_encoding="cdr", context=self._context)
            self._channels[topic] = channel
        self._channels[topic].log(data, log_time=stamp)
