"""What the host's parts of a run (start-up, life of the beacons, back end) see when they look, and what that changes.

A part changes nothing of a run by itself: it returns Changes, which the session applies.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from uwbslam_jax.estimator.state import Estimate, State
from uwbslam_jax.mapping import Tiles
from uwbslam_jax.measurements import StampedFrame
from uwbslam_jax.numerics import carried_along
from uwbslam_jax.result import EventKind, RunStatus
from uwbslam_jax.settings import Config, Found, HostParams, Params


class HostView(NamedTuple):
    """A run between two steps.

    Attributes:
      config, params: of the step; host: the same parameters on the host.
      state, tiles: of the estimator, and what of its map lies outside the window.
      slots: node id -> slot.
      seen: the newest frames with their estimates, at least one.
      poses: (T, 3) published so far [m, m, rad].
      beacons: slot -> place (2,) [m] and covariance (2, 2) [m^2] when it was last in the state.
      found: what ranges were found to be off by.
    """

    config: Config
    params: Params
    host: HostParams
    state: State
    tiles: Tiles
    slots: Mapping[int, int]
    seen: Sequence[tuple[StampedFrame, Estimate]]
    poses: np.ndarray
    beacons: Mapping[int, tuple[np.ndarray, np.ndarray]]
    found: Found

    @property
    def now(self) -> int:
        """Stamp of the newest frame [ns]."""
        return self.seen[-1][0].stamp

    @property
    def ids(self) -> dict[int, int]:
        """Slot -> node id."""
        return {slot: node for node, slot in self.slots.items()}


class SlotEvent(NamedTuple):
    """What happened to a slot, or with slot 0 to the robot or the run; detail: see result.Event."""

    slot: int
    kind: EventKind
    detail: str = ""


class Moved(NamedTuple):
    """The map was drawn anew, and a track moves along with its keyframes.

    Attributes:
      anchors: (N,) stamps of the keyframes [ns]; before, after: (N, 3) their poses [m, m, rad].
    """

    anchors: np.ndarray
    before: np.ndarray
    after: np.ndarray

    def carry(self, stamps: np.ndarray, poses: np.ndarray) -> np.ndarray:
        """Poses (T, 3), taken at stamps (T,) [ns], moved with the keyframes before and after each."""
        return carried_along(stamps, poses, self.anchors, self.before, self.after)

    @property
    def turn(self) -> float:
        """Of the last keyframe [rad]."""
        return float(self.after[-1, 2] - self.before[-1, 2])


class Changes(NamedTuple):
    """What a look changes; what is None stays.

    Attributes:
      state, tiles, found, status: in place of those of the view. hypotheses: explanations of the start that are alive.
      moved: how what the map was drawn from has moved.
      frame_slots: of the two beacons that make the published frame, once that is decided: the track so far is then
        published anew.
      heard: slot -> stamps (R,) [ns], places (R, 2) of the antenna and distances (R,) [m] of what was ranged to a
        beacon that start-up did not place.
      events: in order.
    """

    state: State | None = None
    tiles: Tiles | None = None
    found: Found | None = None
    status: RunStatus | None = None
    hypotheses: int | None = None
    moved: Moved | None = None
    frame_slots: tuple[int, int] | None = None
    heard: Mapping[int, tuple[np.ndarray, np.ndarray, np.ndarray]] = {}
    events: Sequence[SlotEvent] = ()
