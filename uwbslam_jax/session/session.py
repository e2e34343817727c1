"""One run of the estimator over frames: the compiled step, and the host's look at what the steps reported.

Every CONTROL_EVERY frames the host's parts look: start-up until the published frame is decided, then the keeper of the
beacons and the back end. What they return is applied here, and nowhere else. The steps in between run without them, one
by one (online) or ten at a time (batch); it is the same compiled program, and gives the same bits.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import jax
import numpy as np

from uwbslam_jax.backend import BackEnd, Graph, Hindsight, notable
from uwbslam_jax.beacons import MEMORY_S, BeaconKeeper
from uwbslam_jax.estimator import Changes, Estimate, HostView, State, begun, compiled, init, widened
from uwbslam_jax.mapping import Tiles
from uwbslam_jax.measurements import Odometry, StampedFrame
from uwbslam_jax.reasons import Lack
from uwbslam_jax.result import BeaconStatus, EventKind, MapImage, RunStatus
from uwbslam_jax.session import saved_state
from uwbslam_jax.session.history import History
from uwbslam_jax.session.odometry_monitor import OdometryMonitor
from uwbslam_jax.session.saved_state import Saved
from uwbslam_jax.session.update import Update
from uwbslam_jax.settings import (
    Found,
    HostParams,
    Params,
    Settings,
    make_config,
    make_host_params,
    make_params,
    with_room,
)
from uwbslam_jax.startup import StartUp

CONTROL_EVERY = compiled.GROUP
"""Frames between two looks of the host: as many as the compiled step takes at once."""
Seen = Sequence[tuple[StampedFrame, Estimate]]
"""Frames and what the steps made of them."""


class Session:
    """A run in progress.

    Attributes:
      settings, config, params: what it runs with; params grow biases and heights as ids get slots, and all of them
        slots where there are more beacons than uwb.max_beacons.
      tiles: what of the estimator's map lies outside its window.
      decided_at: stamp of the frame at which the published frame was decided, None before [ns].
      status: of the start-up. hypotheses: explanations of the start that are alive.
      found: what ranges were found to be off by.
      history: what was reported so far. back_end: what the run as a whole is solved by.
      listener: called with each update when stepped frame by frame, before the host has its look.
      odometry: whether it tells of the motion that the scans show.
      fixed: whether map and beacons are taken as they are: the run only localises.
    """

    def __init__(self, settings: Settings):
        self.settings = settings
        # until the beacons are placed there is nothing for the paper's steps to stand on
        self.config = dataclasses.replace(make_config(settings), preset="robust")
        self.params = make_params(settings)
        self._engine = begun(settings, init(self.config))
        self.tiles = Tiles(settings.map.resolution)
        self.history = History()
        self.decided_at: int | None = None
        self.status = RunStatus.LIDAR_ONLY if settings.filter.lidar_only else RunStatus.WAITING
        self.hypotheses = 0
        self.found = Found()
        self.listener: Callable[[Update], object] | None = None
        self.fixed = False
        self._slots: dict[int, int] = {settings.robot.id: 0}
        self.odometry = OdometryMonitor()
        self._pending: list[tuple[StampedFrame, Estimate]] = []
        self._measured: list[Odometry] = []
        self._on_host: tuple[Params | None, HostParams] = (None, make_host_params(settings, self.params, self._slots))
        self._start_up = StartUp(self.host)
        self._keeper = BeaconKeeper()
        self.back_end = BackEnd(settings)

    @property
    def state(self) -> State:
        """The estimator's now. What was read of it is void after the next step."""
        return self._engine.state

    @state.setter
    def state(self, state: State) -> None:
        self._engine.state = state

    @property
    def engine(self) -> str:
        """Name of what steps."""
        return self._engine.name

    @property
    def host(self) -> HostParams:
        """The parameters that are in use now, on the host."""
        if self._on_host[0] is not self.params:
            self._on_host = (self.params, make_host_params(self.settings, self.params, self._slots))
        return self._on_host[1]

    @property
    def slots(self) -> dict[int, int]:
        """Node id -> slot, as far as heard."""
        return self._slots

    @property
    def ids(self) -> dict[int, int]:
        """Slot -> node id, as far as heard."""
        return {slot: node for node, slot in self._slots.items()}

    @property
    def graph(self) -> Graph:
        """What the run as a whole is solved from."""
        return self.back_end.graph

    @property
    def hindsight(self) -> Hindsight | None:
        """The run solved as a whole once it is over, None before and where there is too little of it."""
        return self.back_end.hindsight

    @property
    def biased(self) -> bool:
        """Whether a bias was found that is worth reporting."""
        return notable(self.found.bias, self.settings.uwb.sigma_n)

    @property
    def lack(self) -> Lack:
        """What start-up waits for, or waited for last."""
        return self._start_up.lack

    @property
    def overdue(self) -> bool:
        """Whether start-up has been waiting for long, and still is."""
        return self._start_up.overdue and self.decided_at is None

    def beacon_status(self, slot: int) -> BeaconStatus:
        """Of a beacon now; never RELATIVE."""
        return self._keeper.status(slot)

    def room(self) -> int:
        """How many more frames may be stepped before the host has to look."""
        return CONTROL_EVERY - len(self._pending)

    def step(self, frame: StampedFrame) -> Estimate:
        """One frame in, its estimate out (numpy)."""
        frame = self._admitted(frame)
        (estimate,) = self._engine.step(self.config, self.params, [frame.frame])
        if self.listener is not None:
            self.listener(self.update(frame, estimate))
        self._take(frame, estimate)
        return estimate

    def steps(self, frames: Sequence[StampedFrame]) -> list[Estimate]:
        """The same for as many frames as there is room for, all at once."""
        if len(frames) != CONTROL_EVERY or self._pending or len(frames[-1].slots) > self.config.nodes:
            return [self.step(frame) for frame in frames]
        frames = [self._admitted(frame) for frame in frames]
        estimates = self._engine.step(self.config, self.params, [f.frame for f in frames])
        for frame, estimate in zip(frames, estimates, strict=True):
            self._take(frame, estimate)
        return estimates

    def update(self, frame: StampedFrame, estimate: Estimate) -> Update:
        """A step as it is published."""
        ids = self.ids
        states = {slot: self._keeper.status(slot) for slot in ids}
        return Update(frame, estimate, ids, states, self.status, self.decided_at is not None)

    def map(self) -> MapImage:
        """The map so far."""
        return self.tiles.image(self.state.grid)

    def saved(self) -> Saved | None:
        """A copy of what was found, to go on from; None before the frame is decided, or where a run only localises."""
        known = self.decided_at is not None or self.settings.filter.lidar_only
        if self.fixed or not known:
            return None
        state = jax.tree.map(lambda leaf: np.array(leaf, copy=True), self.state)
        return Saved(state, self.tiles.copy(), dict(self._slots), self.found)

    def go_on(self, saved: Saved, place: np.ndarray, stamp: int, *, fixed: bool) -> None:
        """Start from what an earlier run has found, in place of start-up.

        Args:
          place: (2,) where the robot is now [m]. stamp: of the moment [ns].
          fixed: map and beacons stay as they are.
        """
        self.state = saved_state.resumed(saved, place, fixed=fixed)
        self.tiles, self._slots = saved.tiles.copy(), dict(saved.slots)
        self.found, self.fixed = saved.found, fixed
        self.history.event(stamp, EventKind.LOCALISING if fixed else EventKind.RESUMED)
        self.config = dataclasses.replace(make_config(self.settings), draws=not fixed)
        self.params = make_params(self.settings, self._slots, self.found)
        self.decided_at, self.status, self.hypotheses = stamp, RunStatus.DECIDED, 1
        self.back_end.enabled = False  # the scans that the saved map was drawn from are gone
        for slot in np.flatnonzero(np.asarray(self.state.active))[1:]:
            self._keeper.placed(int(slot), stamp)

    def finish(self) -> None:
        """The last look, over the frames since the one before, and the run solved as a whole."""
        if self._pending:
            self._look()
        changes = self.back_end.finish(self._view([]), *self.history.passage())
        self._apply(changes, int(self.history.stamps[-1]) if len(self.history.stamps) else 0)

    def _admitted(self, frame: StampedFrame) -> StampedFrame:
        """A frame about to be stepped: its ids are learnt, odometry that is not trusted is set aside."""
        if len(frame.slots) > self.config.nodes:
            self._make_room(len(frame.slots))
        if len(frame.slots) > len(self._slots):
            self._slots = dict(frame.slots)
            self.params = make_params(self.settings, self._slots, self.found)
        self._measured.append(frame.frame.odometry)
        if self.odometry.trusted:
            return frame
        without = frame.frame._replace(odometry=Odometry(np.zeros(3, np.float32), np.bool_(False)))
        return dataclasses.replace(frame, frame=without)

    def _make_room(self, nodes: int) -> None:
        """Slots for so many nodes, robot included; what was stepped with fewer is looked at before."""
        if self._pending:
            self._look()
        self.settings = with_room(self.settings, nodes - 1)
        sizes = make_config(self.settings)
        self.config = dataclasses.replace(self.config, nodes=sizes.nodes, max_ranges=sizes.max_ranges)
        self.state = widened(self.state, self.config)
        self.history.make_room()
        self.back_end.settings = self.settings

    def _take(self, frame: StampedFrame, estimate: Estimate) -> None:
        self.back_end.add(self.host, len(self.history.stamps) + len(self._pending), frame, estimate)
        self._pending.append((frame, estimate))
        if len(self._pending) == CONTROL_EVERY:
            self._look()

    def _view(self, seen: Seen) -> HostView:
        """The run as its parts see it."""
        history = self.history
        shown = self.config, self.params, self.host, self.state, self.tiles, self._slots, seen
        return HostView(*shown, history.poses.values, history.beacons, self.found)

    def _look(self) -> None:
        seen, self._pending = self._pending, []
        measured, self._measured = self._measured, []
        self.odometry.look(seen, measured)
        now = seen[-1][0].stamp
        self.history.add(seen, self.hypotheses)
        if self.settings.filter.lidar_only:
            pass
        elif self.decided_at is None:
            self._apply(self._start_up.look(self._view(seen)), now)
        else:
            changes = self._keeper.look(self._view(seen))
            self._apply(changes, now)
            since = now - round(MEMORY_S * 1e9)
            self._apply(self.back_end.look(self._view(seen), changes.events, since), now)
        robot = np.asarray(self.state.belief.mean)[:2].astype(float)
        origin = np.asarray(self.state.grid.origin, float)
        if self.tiles.needs_move(origin, self.config.cells, robot):
            self.state = self.state._replace(grid=self.tiles.recentre(self.state.grid, robot))

    def _apply(self, changes: Changes, now: int) -> None:
        """What a part has found becomes the run's."""
        if changes.state is not None:
            self.state = changes.state
        if changes.tiles is not None:
            self.tiles = changes.tiles
        if changes.found is not None:
            self.found = changes.found
            self.params = make_params(self.settings, self._slots, self.found)
        if changes.status is not None and changes.hypotheses is not None:
            self.status, self.hypotheses = changes.status, changes.hypotheses
        if changes.moved is not None:
            self.history.carry_along(changes.moved, republish=changes.frame_slots is not None)
            self._keeper.carry(changes.moved)
        ids = self.ids
        for slot, kind, detail in changes.events:
            self.history.event(now, kind, ids[slot] if slot else None, detail)
        if changes.frame_slots is not None and changes.moved is not None:
            self.decided_at, self.config = now, make_config(self.settings)
            self.back_end.publish(changes.frame_slots, changes.moved)
            for slot in np.flatnonzero(np.asarray(self.state.active))[1:]:
                self._keeper.placed(int(slot), now)
            for slot, told in changes.heard.items():
                self._keeper.heard_before(slot, *told)
