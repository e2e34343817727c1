"""The back end as a part of the host: collects every frame, solves the run so far beside it, gives what is news."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np

from uwbslam_jax.backend.final_solution import Hindsight, Question, look_back
from uwbslam_jax.backend.graph import Graph
from uwbslam_jax.backend.range_latency import Latency, find_latency, retimed
from uwbslam_jax.backend.range_means import Node
from uwbslam_jax.backend.revision import UNSOLVED, Reviser, Revision, is_news, take_over, up_to_date
from uwbslam_jax.backend.smoothing import Solution
from uwbslam_jax.estimator import Changes, Estimate, HostView, Moved, SlotEvent, state_vector
from uwbslam_jax.mapping import Tiles, redraw
from uwbslam_jax.measurements import StampedFrame
from uwbslam_jax.numerics import DECIDED
from uwbslam_jax.result import EventKind
from uwbslam_jax.settings import Found, HostParams, Params, Settings, make_host_params, make_params

_ELSEWHERE = (
    EventKind.ROBOT_CARRIED,
    EventKind.PLACED_MOVING,
    EventKind.CARRIED,
    EventKind.PUT_DOWN,
    EventKind.MOVED,
    EventKind.LOST_MOVING,
    EventKind.SILENT_MOVING,
    EventKind.DROPPED,
)
"""After these a node is not where it was. One that is only doubted may be: walls or a clock explain its ranges too."""


_ROUNDS = 3
"""So often at most a run is solved again with its ranges at another time [solutions]."""
_NOTABLE_BIAS = 0.3
"""A bias larger than this share of sigma_n is reported; smaller ones only take up what little was learnt of them."""


def notable(bias: Mapping[int, float], sigma_n: float) -> bool:
    """Whether one of the biases [m] is worth reporting."""
    return any(abs(found) > _NOTABLE_BIAS * sigma_n for found in bias.values())


class BackEnd:
    """The run so far as a whole.

    Attributes:
      settings: what the run goes by. graph: what it is solved from. taken_over: how often the state was corrected.
      hindsight: the solution once the run is over, else None. failure: why there is none though there should be.
      latency: of the ranges' stamps, where it was found to matter; the solution takes it into account.
    """

    def __init__(self, settings: Settings):
        self.settings = settings
        self.graph = Graph()
        self.hindsight: Hindsight | None = None
        self.failure = ""
        self.latency: Latency | None = None
        self.taken_over = 0
        self.enabled = settings.filter.preset == "robust" and not settings.filter.lidar_only
        self._reviser = Reviser()
        self._places: dict[Node, np.ndarray] = {}
        self._frame_nodes: tuple[Node, Node] | None = None

    @property
    def revisions(self) -> int:
        """How often the run so far was solved."""
        return self._reviser.solved

    def add(self, host: HostParams, number: int, frame: StampedFrame, estimate: Estimate) -> None:
        """Takes in one frame, not with the look, which would take longer for one in ten. number: in the history."""
        if self.enabled:
            self.graph.add(host, number, frame, estimate)

    def publish(self, frame_slots: tuple[int, int], moved: Moved) -> None:
        """The published frame was decided."""
        origin, along = frame_slots
        self._frame_nodes = self.graph.ranges.node(origin), self.graph.ranges.node(along)
        self.graph.put(moved.carry(self.graph.stamps(), self.graph.poses()), moved.turn)

    def look(self, view: HostView, events: Sequence[SlotEvent], since: int) -> Changes:
        """What the run so far shows to be wrong with the state; begins to solve it again.

        Args:
          events: what has just happened to the beacons.
          since: a beacon that was just placed is known to have rested from this stamp on [ns].
        """
        for event in events:
            self._note(view, event, since)
        if any(event.kind is EventKind.ROBOT_CARRIED for event in events):
            self._reviser.drop()
        revision = self._reviser.look(partial(is_news, state=view.state, graph=self.graph, known=view.found))
        changes = Changes()
        question = None if revision is None else self._question(view)
        latest = None if revision is None or question is None else up_to_date(revision, question, view.state)
        if latest is not None:
            self.taken_over += 1
            changes = self._take_over(view, latest)
            changes = changes._replace(events=[*changes.events, SlotEvent(0, EventKind.CORRECTED)])
        if self.enabled and self._reviser.wants(len(self.graph.keyframes)):
            self._begin(view._replace(state=changes.state or view.state, found=changes.found or view.found))
        return changes

    def _note(self, view: HostView, event: SlotEvent, since: int) -> None:
        """What an event means for the run as a whole."""
        if event.kind is EventKind.PLACED:
            self.graph.placed(event.slot, since)
        elif event.kind in _ELSEWHERE:
            if event.slot in view.beacons:
                self._places[self.graph.ranges.node(event.slot)] = np.asarray(view.beacons[event.slot][0], float)
            self.graph.moved(event.slot)

    def _begin(self, view: HostView) -> None:
        question = self._question(view)
        if question is not None:
            question = question._replace(graph=self.graph.copy())
            epoch = float(view.state.map_spread.way)
            self._reviser.begin(view.config, self._params(view), question, self.settings.map.resolution, epoch)

    def _question(self, view: HostView) -> Question | None:
        """What to solve of the run so far. Its graph is the one that grows."""
        if self._frame_nodes is None or not self.enabled:
            return None
        positions = np.asarray(state_vector.unpack(view.state.belief.mean).positions, float)
        resting = np.asarray(view.state.active) & ~np.asarray(view.state.moving)
        places = self._places | {
            self.graph.ranges.node(slot): positions[slot] for slot in map(int, np.flatnonzero(resting)) if slot > 0
        }
        poses = view.poses[self.graph.keyframes["frame"]].astype(float)
        slots = dict(view.slots)
        configured = make_host_params(self.settings, make_params(self.settings, slots), slots)
        return Question(self.graph, poses, places, configured, self._frame_nodes, view.found)

    def _params(self, view: HostView, found: Found | None = None) -> Params:
        return make_params(self.settings, dict(view.slots), found or view.found)

    def _take_over(self, view: HostView, revision: Revision) -> Changes:
        """The state as a revision has it."""
        found, events = self._found(view, revision.solution)
        params = self._params(view, found)
        anchors, before = self.graph.stamps(), self.graph.poses()
        state = take_over(view.config, params, revision, view.state, self.graph)
        moved = Moved(anchors, before, self.graph.poses())
        return Changes(state, revision.tiles, found, moved=moved, events=events)

    def _found(self, view: HostView, solution: Solution) -> tuple[Found | None, list[SlotEvent]]:
        """What ranges were found to be off by, None for nothing, and whether that is news."""
        found, sigma_n = solution.found, self.settings.uwb.sigma_n
        if found == Found():
            return None, []
        news = notable(found.bias, sigma_n) and not notable(view.found.bias, sigma_n)
        return found, [SlotEvent(0, EventKind.BIASED)] if news else []

    def finish(self, view: HostView, stamps: np.ndarray, poses: np.ndarray, sight: np.ndarray) -> Changes:
        """The run solved for the last time. stamps, poses, sight: of every frame, see look_back."""
        self._reviser.close()
        try:
            return self._solve_last(view, stamps, poses, sight)
        except UNSOLVED as error:  # what was published along the way is worth keeping
            self.hindsight, self.failure = None, " ".join(str(error).split())
            return Changes()

    def _on_time(
        self, hindsight: Hindsight, question: Question, stamps: np.ndarray, frames: tuple[np.ndarray, np.ndarray]
    ) -> Hindsight:
        """The run solved with its ranges at the time when they were measured, where these are stamped late. frames:
        poses and sight of every frame."""
        late = find_latency(hindsight, self.graph, stamps, question.host)
        for _ in range(_ROUNDS):  # the track was bent by the ranges, and tells better how late they are each time
            if late is None or not late.notable:
                break
            on_time = retimed(self.graph, hindsight, stamps, question.host, late.late)
            again = look_back(question._replace(graph=on_time), stamps, *frames)
            if again is None or again.solution.cost > hindsight.solution.cost - (0.0 if self.latency else DECIDED):
                break
            hindsight, self.latency, before = again, late, late.late
            late = find_latency(hindsight, self.graph, stamps, question.host)
            if late is not None and abs(late.late - before) < late.sigma / 2:
                break
        return hindsight

    def _solve_last(self, view: HostView, stamps: np.ndarray, poses: np.ndarray, sight: np.ndarray) -> Changes:
        question = self._question(view)
        self.hindsight = None if question is None else look_back(question, stamps, poses, sight)
        if self.hindsight is None or question is None:
            return Changes()
        self.hindsight = self._on_time(self.hindsight, question, stamps, (poses, sight))
        solution = self.hindsight.solution
        found, _ = self._found(view, solution)
        params = self._params(view, found)
        tiles = Tiles(self.settings.map.resolution)
        grid = redraw(view.config, params, tiles, self.graph.seen(solution.poses), self.hindsight.track[-1, :2])
        return self._take_over(view, Revision(solution, grid, tiles, len(solution.poses)))
