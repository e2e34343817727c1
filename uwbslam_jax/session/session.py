"""One run of the estimator over frames: the compiled step, and the host's slow loop around it.

Every CONTROL_EVERY frames the host looks at what the steps reported: it decides the start-up, places beacons that
joined, drops those that fell silent, and moves the map's window. The steps in between run without it, one by one
(online) or ten at a time (batch); it is the same compiled program, and gives the same bits.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from uwbslam_jax.backend import (
    Graph,
    Hindsight,
    Node,
    Question,
    Reviser,
    Revision,
    Solution,
    is_news,
    look_back,
    take_over,
)
from uwbslam_jax.beacons import MEMORY_S, BeaconKeeper
from uwbslam_jax.estimator import Estimate, State, compiled, init, state_vector
from uwbslam_jax.mapping import Tiles, redraw
from uwbslam_jax.measurements import StampedFrame
from uwbslam_jax.session.history import History
from uwbslam_jax.settings import HostParams, Params, Settings, make_config, make_host_params, make_params
from uwbslam_jax.startup import Buffer, adopt, decide

CONTROL_EVERY = compiled.GROUP
"""Frames between two looks of the host."""
_NOTABLE_BIAS = 0.3
"""A bias larger than this share of sigma_n is told; smaller ones only take up what little was learnt of them."""
_SOLVE_EVERY_S = 1.0
"""The start-up problem is solved at most this often, in the log's time."""


class Session:
    """A run in progress.

    Attributes:
      settings, config, params: what it runs with; params grow biases and heights as ids get slots.
      state: the estimator's.
      decided_at: stamp of the frame at which the published frame was decided, None before [ns].
      status: of the start-up, in words.
      found_bias: slot -> range bias that was found beyond the configured one [m]; empty where there is none.
      history: what was reported so far.
      graph: what the run as a whole is solved from. hindsight: its solution once the run is over, else None.
      taken_over: how often the state was corrected by the run so far, solved as a whole.
      listener: called with each frame and its estimate when stepped frame by frame, before the host has its look.
      fixed: whether map and beacons are taken as they are: the run only localises.
    """

    def __init__(self, settings: Settings):
        self.settings = settings
        # until the beacons are placed there is nothing for the paper's steps to stand on
        self.config = dataclasses.replace(make_config(settings), preset="robust")
        self.params = make_params(settings)
        self.state = init(self.config)
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
        self._copied: tuple[Params | None, HostParams] = (None, make_host_params(settings, self.params))
        self._buffer = Buffer(self.host)
        self._keeper = BeaconKeeper()
        self.graph = Graph()
        self.hindsight: Hindsight | None = None
        self._looks_back = settings.filter.preset == "robust" and not settings.filter.lidar_only
        self._reviser = Reviser()
        self.taken_over = 0
        self._places: dict[Node, np.ndarray] = {}
        self._frame_nodes: tuple[Node, Node] = ((0, 0), (0, 0))

    @property
    def host(self) -> HostParams:
        """What the host takes ranges for: of the parameters that are in use now."""
        if self._copied[0] is not self.params:
            self._copied = (self.params, make_host_params(self.settings, self.params))
        return self._copied[1]

    @property
    def slots(self) -> dict[int, int]:
        """Node id -> slot, as far as heard."""
        return self._slots

    @property
    def revisions(self) -> int:
        """How often the run so far was solved as a whole."""
        return self._reviser.solved

    @property
    def biased(self) -> bool:
        """Whether a bias was found that is worth a user's while."""
        worth = _NOTABLE_BIAS * self.settings.uwb.sigma_n
        return any(abs(found) > worth for found in self.found_bias.values())

    def room(self) -> int:
        """How many more frames may be stepped before the host has to look."""
        return CONTROL_EVERY - len(self._pending)

    def step(self, frame: StampedFrame) -> Estimate:
        """One frame in, its estimate out (numpy)."""
        self._learn_slots(frame)
        self.state, (estimate,) = compiled.step(self.config, self.params, self.state, [frame.frame])
        if self.listener is not None:
            self.listener(frame, estimate)
        self._take(frame, estimate)
        return estimate

    def steps(self, frames: Sequence[StampedFrame]) -> list[Estimate]:
        """The same for as many frames as there is room for, all at once."""
        if len(frames) != CONTROL_EVERY or self._pending:
            return [self.step(frame) for frame in frames]
        self._learn_slots(frames[-1])
        self.state, estimates = compiled.step(self.config, self.params, self.state, [f.frame for f in frames])
        for frame, estimate in zip(frames, estimates, strict=True):
            self._take(frame, estimate)
        return estimates

    def go_on(
        self, state: State, tiles: Tiles, slots: dict[int, int], found_bias: dict[int, float], stamp: int
    ) -> None:
        """Start from what an earlier run has found, at a stamp [ns], in place of start-up."""
        self.state, self.tiles, self._slots, self.found_bias = state, tiles, dict(slots), dict(found_bias)
        self.config = make_config(self.settings)
        self.params = make_params(self.settings, self._slots, self.found_bias)
        self.decided_at = stamp
        self._looks_back = False  # the scans that the saved map was drawn from are gone
        self.status, self.hypotheses = "decided", 1
        for slot in np.flatnonzero(np.asarray(state.active))[1:]:
            self._keeper.placed(int(slot), stamp)

    def finish(self) -> None:
        """The last look, over the frames since the one before."""
        if self._pending:
            self._look()
        self._reviser.close()
        question = self._question()
        self.hindsight = None if question is None else look_back(question, *self.history.passage())
        if self.hindsight is None:
            return
        self._learn_biases(self.hindsight.solution, int(self.history.stamps[-1]))
        solution = self.hindsight.solution
        seen = self.graph.seen(solution.poses)
        grid = redraw(self.config, self.params, self.tiles, seen, self.hindsight.track[-1, :2])
        self._take_over(Revision(solution, grid, self.tiles))

    def _question(self) -> Question | None:
        """What to solve of the run so far. Its graph is the one that grows."""
        if self.decided_at is None or not self._looks_back:
            return None
        positions = np.asarray(state_vector.unpack(self.state.belief.mean).positions, float)
        resting = np.asarray(self.state.active) & ~np.asarray(self.state.moving)
        places = self._places | {
            self.graph.ranges.node(slot): positions[slot] for slot in map(int, np.flatnonzero(resting)) if slot > 0
        }
        poses = self.history.poses[self.graph.keyframes["frame"]].astype(float)
        configured = make_host_params(self.settings, make_params(self.settings, self._slots))
        return Question(self.graph, poses, places, configured, self._frame_nodes, bool(self.found_bias))

    def _learn_slots(self, frame: StampedFrame) -> None:
        if len(frame.slots) > len(self._slots):
            self._slots = dict(frame.slots)
            self.params = make_params(self.settings, self._slots, self.found_bias)
            self._buffer.host = self.host

    def _take(self, frame: StampedFrame, estimate: Estimate) -> None:
        if self._looks_back:
            # not with the look: what that takes comes on top for one frame in ten
            self.graph.add(self.host, len(self.history.stamps) + len(self._pending), frame, estimate)
        self._pending.append((frame, estimate))
        if len(self._pending) == CONTROL_EVERY:
            self._look()

    def _look(self) -> None:
        pending, self._pending = self._pending, []
        self.history.add(pending, self.hypotheses)
        if not self.settings.filter.lidar_only:
            if self.decided_at is None:
                self._start_up(pending)
            else:
                self._keep_beacons(pending)
        robot = np.asarray(self.state.belief.mean)[:2].astype(float)
        origin = np.asarray(self.state.grid.origin, float)
        if self.tiles.needs_move(origin, self.config.cells, robot):
            self.state = self.state._replace(grid=self.tiles.recentre(self.state.grid, robot))

    def _start_up(self, pending: list[tuple[StampedFrame, Estimate]]) -> None:
        for frame, estimate in pending:
            self._buffer.add(frame, estimate)
        now = pending[-1][0].stamp
        if now - self._solved_at < _SOLVE_EVERY_S * 1e9 or self._buffer.newest == self._solved_with:
            return  # nothing can have been learnt but better averages
        self._solved_at, self._solved_with = now, self._buffer.newest
        ids = {slot: node for node, slot in self._slots.items()}
        outcome = decide.solve(self._buffer, ids)
        if outcome.status != self.status:
            self.history.event(now, outcome.status)
        self.status, self.hypotheses = outcome.status, outcome.hypotheses
        if outcome.placement is None:
            return
        origin, along = decide.choose_frame(outcome.placement, ids)
        if outcome.biased:
            nodes = [0, *outcome.placement.slots]
            self.found_bias = dict(zip(nodes, map(float, outcome.placement.bias), strict=True))
            self.params = make_params(self.settings, self._slots, self.found_bias)
        adopted = adopt(
            self.config, self.params, self.state, self.tiles, self._buffer, outcome.placement, (origin, along)
        )
        self.state, self.decided_at = adopted.state, now
        self.config = make_config(self.settings)
        self._frame_nodes = self.graph.ranges.node(origin), self.graph.ranges.node(along)
        self.history.republish(adopted)
        self.graph.put(adopted.republish(self.graph.stamps(), self.graph.poses()), adopted.turn)
        self.history.event(now, f"frame decided by beacons {ids[origin]} and {ids[along]}")
        for slot in outcome.placement.slots:
            self._keeper.placed(slot, now)
            self.history.event(now, f"beacon {ids[slot]} placed")
        self._buffer = Buffer(self.host)

    def _keep_beacons(self, pending: list[tuple[StampedFrame, Estimate]]) -> None:
        ids = {slot: node for node, slot in self._slots.items()}
        self.state, events = self._keeper.look(self.state, self.host, pending)
        for slot, text in events:
            who = "robot" if slot == 0 else f"beacon {ids[slot]}"
            self.history.event(pending[-1][0].stamp, f"{who} {text}")
            self._remember(slot, text, pending[-1][0].stamp)
        if any(slot == 0 for slot, _ in events):
            self._reviser.drop()
        self._revise(pending[-1][0].stamp)

    def _remember(self, slot: int, text: str, now: int) -> None:
        """What an event means for the run as a whole."""
        if text == "placed":
            self.graph.placed(slot, now - round(MEMORY_S * 1e9))
        elif slot == 0 or any(word in text for word in ("carried", "put down", "was moved", "dropped")):
            if slot in self.history.beacons:
                self._places[self.graph.ranges.node(slot)] = np.asarray(self.history.beacons[slot][0], float)
            self.graph.moved(slot)

    def _revise(self, now: int) -> None:
        """Take over what the run so far tells, where the state contradicts it; begin to ask again."""
        revision = self._reviser.look(
            partial(is_news, state=self.state, graph=self.graph, learnt=bool(self.found_bias))
        )
        if revision is not None:
            self._learn_biases(revision.solution, now)
            self._take_over(revision)
            self.taken_over += 1
            self.history.event(now, "beacons and map corrected by the run so far")
        if self._looks_back and self._reviser.wants(len(self.graph.keyframes)):
            question = self._question()
            if question is not None:
                question = question._replace(graph=self.graph.copy())
                epoch = float(self.state.map_spread.way)
                self._reviser.begin(self.config, self.params, question, self.settings.map.resolution, epoch)

    def _take_over(self, revision: Revision) -> None:
        anchors, before = self.graph.stamps(), self.graph.poses()
        self.state = take_over(self.config, self.params, revision, self.state, self.graph)
        self.tiles = revision.tiles
        self.history.carry_along(anchors, before, self.graph.poses())

    def _learn_biases(self, solution: Solution, now: int) -> None:
        if not solution.biased:
            return
        told = self.biased
        self.found_bias = solution.bias
        if self.biased and not told:
            self.history.event(now, "ranges are biased: biases and beacons solved from the run so far")
        self.params = make_params(self.settings, self._slots, self.found_bias)

    def beacon_status(self, slot: int) -> str:
        """static, moving, silent, dropped or waiting."""
        return self._keeper.status(slot)
