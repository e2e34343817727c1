"""One run of the estimator over frames: the compiled step, and the host's slow loop around it.

Every CONTROL_EVERY frames the host looks at what the steps reported: it decides the start-up, places beacons that
joined, drops those that fell silent, and moves the map's window. The steps in between run without it, one by one
(online) or as one compiled scan (batch); both give the same bits.
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from uwbslam_jax import beacon_state, layout, ranging, slam, startup
from uwbslam_jax.beacons import BeaconKeeper
from uwbslam_jax.calibration import Calibration
from uwbslam_jax.config import Params, Settings, make_config, make_params
from uwbslam_jax.history import History
from uwbslam_jax.keyframes import Buffer
from uwbslam_jax.measurements import Frame, StampedFrame
from uwbslam_jax.multilateration import DECIDED
from uwbslam_jax.slam import Estimate, State
from uwbslam_jax.tiles import Tiles

CONTROL_EVERY = 10
"""Frames between two looks of the host."""
_SOLVE_EVERY_S = 1.0
"""The start-up problem is solved at most this often, in the log's time."""

_CALIBRATE_EVERY_S = 5.0
"""Biases are looked for this often, in the log's time."""
_NEWS = 3.0
"""What the whole run tells is taken over when it explains the ranges better by so many times what decides: its poses
are not independent of each other, though they are taken to be."""

TRACES: Counter[str] = Counter()
"""How often each compiled function was traced, by name; a test counts them."""


@partial(jax.jit, static_argnums=0, donate_argnums=2)
def step_once(config, params, state: State, frame: Frame) -> tuple[State, Estimate]:
    """One compiled step; the state's buffers are reused."""
    TRACES["step_once"] += 1
    return _guarded(config, params, state, frame)


@partial(jax.jit, static_argnums=0, donate_argnums=2)
def step_many(config, params, state: State, frames: Frame) -> tuple[State, Estimate]:
    """Steps over frames stacked along their first axis, as one compiled scan."""
    TRACES["step_many"] += 1
    return lax.scan(lambda s, f: _guarded(config, params, s, f), state, frames)


def _guarded(config, params, state, frame):
    # without the barriers the compiler fuses the step with the loop around it and rounds differently there
    state, frame = lax.optimization_barrier((state, frame))
    return lax.optimization_barrier(slam.step(config, params, state, frame))


class Session:
    """A run in progress.

    Attributes:
      settings, config, params: what it runs with; params grow biases and heights as ids get slots.
      state: the estimator's.
      decided_at: stamp of the frame at which the published frame was decided, None before [ns].
      status: of the start-up, in words.
      found_bias: slot -> range bias that was found beyond the configured one [m]; empty where there is none.
      history: what was reported so far.
      listener: called with each frame and its estimate when stepped frame by frame, before the host has its look.
      fixed: whether map and beacons are taken as they are: the run only localises.
    """

    def __init__(self, settings: Settings):
        self.settings = settings
        # until the beacons are placed there is nothing for the paper's steps to stand on
        self.config = dataclasses.replace(make_config(settings), preset="robust")
        self.params = make_params(settings)
        self.state = slam.init(self.config)
        self.tiles = Tiles(settings.map.resolution)
        self.history = History()
        self.decided_at: int | None = None
        self.status = "LiDAR only" if settings.filter.lidar_only else "waiting for motion"
        self.hypotheses = 0
        self.found_bias: dict[int, float] = {}
        self.listener: Callable[[StampedFrame, Estimate], object] | None = None
        self.fixed = False
        self._slots: dict[int, int] = {settings.robot.id: 0}
        self._pending: list[tuple[StampedFrame, Estimate]] = []
        self._solved_at = self._solved_with = 0
        self._buffer = self._new_buffer()
        self._keeper = BeaconKeeper(settings)
        self._calibration = Calibration(settings.uwb.sigma_n)
        self._calibrated_at = 0

    @property
    def slots(self) -> dict[int, int]:
        """Node id -> slot, as far as heard."""
        return self._slots

    def room(self) -> int:
        """How many more frames may be stepped before the host has to look."""
        return CONTROL_EVERY - len(self._pending)

    def step(self, frame: StampedFrame) -> Estimate:
        """One frame in, its estimate out (numpy)."""
        self._learn_slots(frame)
        self.state, estimate = step_once(self.config, self.params, self.state, frame.frame)
        estimate = jax.device_get(estimate)
        if self.listener is not None:
            self.listener(frame, estimate)
        self._take(frame, estimate)
        return estimate

    def steps(self, frames: Sequence[StampedFrame]) -> list[Estimate]:
        """The same for as many frames as there is room for, as one compiled scan."""
        if len(frames) != CONTROL_EVERY or self._pending:
            return [self.step(frame) for frame in frames]
        self._learn_slots(frames[-1])
        stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *[f.frame for f in frames])
        self.state, many = step_many(self.config, self.params, self.state, stacked)
        many = jax.device_get(many)
        estimates = [jax.tree.map(lambda leaf, k=k: leaf[k], many) for k in range(len(frames))]
        for frame, estimate in zip(frames, estimates, strict=True):
            self._take(frame, estimate)
        return estimates

    def go_on(
        self, state: State, tiles: Tiles, slots: dict[int, int], found_bias: dict[int, float], stamp: int
    ) -> None:
        """Start from what an earlier run has found, at a stamp [ns], in place of start-up."""
        self.state, self.tiles, self._slots, self.found_bias = state, tiles, dict(slots), dict(found_bias)
        self.config = make_config(self.settings)
        self.params = self._biased(make_params(self.settings, self._slots))
        self.decided_at, self._calibrated_at = stamp, stamp
        self.status, self.hypotheses = "decided", 1
        for slot in np.flatnonzero(np.asarray(state.active))[1:]:
            self._keeper.placed(int(slot), stamp)

    def finish(self) -> None:
        """The last look, over the frames since the one before."""
        if self._pending:
            self._look()

    def _learn_slots(self, frame: StampedFrame) -> None:
        if len(frame.slots) > len(self._slots):
            self._slots = dict(frame.slots)
            self.params = self._biased(make_params(self.settings, self._slots))
            self._buffer.height, self._buffer.bias = np.asarray(self.params.height), np.asarray(self.params.bias)

    def _biased(self, params: Params) -> Params:
        """Parameters with the biases that were found added to the configured ones."""
        bias = np.array(params.bias)
        for slot, found in self.found_bias.items():
            bias[slot] += found
        return params._replace(bias=jnp.asarray(bias, jnp.float32))

    def _new_buffer(self) -> Buffer:
        p = self.params
        antenna, height, bias = np.asarray(p.antenna, float), np.asarray(p.height), np.asarray(p.bias)
        return Buffer(antenna, height, bias, float(p.sigma_n), float(p.bias_scale))

    def _take(self, frame: StampedFrame, estimate: Estimate) -> None:
        self.history.add(frame, estimate, self.hypotheses)
        self._pending.append((frame, estimate))
        if len(self._pending) == CONTROL_EVERY:
            self._look()

    def _look(self) -> None:
        pending, self._pending = self._pending, []
        if not self.settings.filter.lidar_only:
            if self.decided_at is None:
                self._start_up(pending)
            else:
                self._keep_beacons(pending)
        robot = np.asarray(self.state.belief.mean[:2], float)
        origin = np.asarray(self.state.grid.origin, float)
        if self.tiles.needs_move(origin, self.config.cells, robot):
            self.state = self.state._replace(grid=self.tiles.recentre(self.state.grid, robot))

    def _start_up(self, pending: list[tuple[StampedFrame, Estimate]]) -> None:
        for frame, estimate in pending:
            self._buffer.add(frame, estimate, startup.usable(frame.frame.ranges, self.config.nlos_gap_db))
        now = pending[-1][0].stamp
        if now - self._solved_at < _SOLVE_EVERY_S * 1e9 or self._buffer.newest == self._solved_with:
            return  # nothing can have been learnt but better averages
        self._solved_at, self._solved_with = now, self._buffer.newest
        ids = {slot: node for node, slot in self._slots.items()}
        outcome = startup.solve(self._buffer, ids)
        if outcome.status != self.status:
            self.history.event(now, outcome.status)
        self.status, self.hypotheses = outcome.status, outcome.hypotheses
        if outcome.placement is None:
            return
        origin, along = startup.choose_frame(outcome.placement, ids)
        if outcome.biased:
            nodes = [0, *outcome.placement.slots]
            self.found_bias = dict(zip(nodes, map(float, outcome.placement.bias), strict=True))
            self.params = self._biased(make_params(self.settings, self._slots))
        adopted = startup.adopt(self.config, self.params, self.state, self._buffer, outcome.placement, (origin, along))
        self.state, self.decided_at, self._calibrated_at = adopted.state, now, now
        self.config = make_config(self.settings)
        self.tiles.clear()
        self.history.republish(adopted)
        self.history.event(now, f"frame decided by beacons {ids[origin]} and {ids[along]}")
        for slot in outcome.placement.slots:
            self._keeper.placed(slot, now)
            self.history.event(now, f"beacon {ids[slot]} placed")
        self._buffer = self._new_buffer()

    def _keep_beacons(self, pending: list[tuple[StampedFrame, Estimate]]) -> None:
        ids = {slot: node for node, slot in self._slots.items()}
        self.state, events = self._keeper.look(self.state, self.params, pending)
        for slot, text in events:
            who = "robot" if slot == 0 else f"beacon {ids[slot]}"
            self.history.event(pending[-1][0].stamp, f"{who} {text}")
            if slot > 0:
                self._calibration.forget(slot)
        loudness = np.asarray(ranging.loudness(self.state.scatter.log))
        for frame, estimate in pending:
            self._calibration.hear(frame, estimate, self.params, loudness)
        now = pending[-1][0].stamp
        if not self.fixed and now - self._calibrated_at > _CALIBRATE_EVERY_S * 1e9:
            self._calibrated_at = now
            self._calibrate(now)

    def _calibrate(self, now: int) -> None:
        """Take over what the whole run tells of the beacons and their biases, where the state's contradict it."""
        configured = make_params(self.settings, self._slots)
        places = np.asarray(layout.unpack(self.state.belief.mean).positions, float)
        solution = self._calibration.solve(places, self.found_bias, configured)
        if solution is None or not solution.known or solution.gain < _NEWS * DECIDED:
            return
        if solution.biased:
            if not self.found_bias:
                self.history.event(now, "ranges are biased: biases and beacons solved from the run so far")
            self.found_bias |= dict(zip([0, *solution.slots], map(float, solution.bias), strict=True))
            self.params = self._biased(configured)
        else:
            self.history.event(now, "beacons solved from the run so far")
        self.state = beacon_state.put_beacons(self.state, solution.slots, solution.beacons, solution.cov)

    def beacon_status(self, slot: int) -> str:
        """static, moving, silent, dropped or waiting."""
        return self._keeper.status(slot)
