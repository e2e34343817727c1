"""The state corrected by the run so far, while the run goes on: solved and drawn beside it, taken over when it is news.

A revision is solved, drawn where it is news, and taken over at fixed numbers of looks of the host, whether it was ready
long before or has to be waited for: so a run and its re-run stay the same to the bit.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from uwbslam_jax import process
from uwbslam_jax.backend.final_solution import Question, extended_solution, framed_solution
from uwbslam_jax.backend.graph import Graph
from uwbslam_jax.backend.smoothing import Solution
from uwbslam_jax.estimator import State, anchored, state_vector
from uwbslam_jax.mapping import Grid, Tiles, draw_onto, redraw
from uwbslam_jax.numerics import SIGMA_ENOUGH_M, SingularError, between, compose, largest_sigma, rigid_fit, wrapped
from uwbslam_jax.settings import Config, Found, Params

UNSOLVED = (SingularError, np.linalg.LinAlgError)
"""What a solution of the run raises where its equations have none [exceptions]: the run goes on without."""
_LOOKS = 2
"""Looks of the host that the solution may take at least, and as many that the drawing may."""
_KEYFRAMES_A_LOOK = 100
"""For so many keyframes it may take one more: the host waits for what is due, and a robot drives on meanwhile. A
solution takes some 0.7 ms a keyframe here, and a look comes every 250 ms at 40 Hz: room for a machine a third as fast.
With more, what is published would be mended later."""
_GROWTH = 1.25
"""A revision is begun when the graph has grown by so much since the last one."""
_FEWEST = 12
"""Keyframes of the first one."""
_NEWS = 9.0
"""Squared Mahalanobis distance of a beacon from where the state has it, beyond which that is wrong."""
_NEWS_M = 0.03
"""Whatever the state believes: a beacon or a keyframe that is off by less is no news [m]."""
_NEWS_HEIGHT_M, _NEWS_SCALE = 0.1, 0.003
"""The same of a height [m] and of the ranges' scale [m/m]: some metres away they come to as much."""
_WALK = (0.004, 0.004, 0.0006)
"""Standard deviation of what the pose drifts on the way since the last keyframe that was solved [m, m, rad / m^0.5]."""
_FLOOR_M = 0.01
"""No beacon is known better by a map that has cells [m]."""


class Revision(NamedTuple):
    """The run solved and drawn.

    Attributes:
      drawn: so many keyframes are in grid and tiles.
    """

    solution: Solution
    grid: Grid
    tiles: Tiles
    drawn: int


@dataclass(frozen=True)
class _Job:
    """What a revision is made from. epoch: of the ground that is drawn, see grid [m]."""

    config: Config
    params: Params
    question: Question
    resolution: float
    epoch: float

    def solve(self) -> Solution | None:
        """The run so far solved, None where it cannot be; what that took is handed back at once, and not whenever the
        allocator likes."""
        try:
            return framed_solution(self.question)
        except UNSOLVED:
            return None
        finally:
            process.give_back()

    def draw(self, solution: Solution) -> Revision:
        """The map, with the scans where the solution has them."""
        tiles, graph = Tiles(self.resolution), self.question.graph
        seen = graph.seen(solution.poses)
        grid = redraw(self.config, self.params, tiles, seen, solution.poses[-1, :2], self.epoch)
        return Revision(solution, grid, tiles, len(solution.poses))


@dataclass
class Reviser:
    """Begins revisions and hands them over when they are due. solved: how many were."""

    solved: int = 0
    _pool: ThreadPoolExecutor | None = None
    _job: _Job | None = None
    _running: Future[Solution | None] | Future[Revision] | None = None
    _due: int = 0
    _begun_with: int = 0

    def wants(self, keyframes: int) -> bool:
        """Whether another one should be begun."""
        return self._running is None and keyframes >= max(_FEWEST, _GROWTH * self._begun_with)

    def begin(self, config: Config, params: Params, question: Question, resolution: float, epoch: float) -> None:
        """Begins one from what was collected so far. epoch: of the ground that is drawn, see grid [m]."""
        self._pool = self._pool or ThreadPoolExecutor(1, thread_name_prefix="revision")
        self._job = _Job(config, params, question, resolution, epoch)
        self._begun_with = len(question.graph.keyframes)
        self._wait_for(self._pool.submit(self._job.solve))

    def _wait_for(self, running: Future[Solution | None] | Future[Revision]) -> None:
        self._running, self._due = running, _LOOKS + self._begun_with // _KEYFRAMES_A_LOOK

    def look(self, news: Callable[[Solution], bool]) -> Revision | None:
        """The revision that is due at this look of the host; waited for if need be.

        news: whether a solution contradicts the state. Only such a one is drawn.
        """
        if self._running is None or self._job is None or self._pool is None:
            return None
        self._due -= 1
        if self._due > 0:
            return None
        found, self._running = self._running.result(), None
        job, self._job = self._job, None
        if isinstance(found, Revision):
            return found if news(found.solution) else None
        self.solved += found is not None
        if found is not None and news(found):
            self._job = job
            self._wait_for(self._pool.submit(job.draw, found))
        return None

    def drop(self) -> None:
        """What is being solved is no longer what happened; its end is waited for."""
        if self._running is not None:
            self._running.result()
            self._running = None

    def close(self) -> None:
        """No more revisions."""
        self.drop()
        if self._pool is not None:
            self._pool.shutdown()
            self._pool = None


def is_news(solution: Solution, state: State, graph: Graph, known: Found) -> bool:
    """Whether a solution contradicts the state: a beacon stands elsewhere, or the map was drawn elsewhere.

    One that ends before the robot was carried off cannot be carried on to now, and is none.

    Args:
      known: what ranges were found to be off by before.
    """
    count = len(solution.poses)
    if graph.keyframes["broken"][count:].any():
        return False
    slots, places, at = _current(solution, graph)
    if len(slots) < 2:
        return False
    if _differs(solution, known):
        return True
    mean, P = np.asarray(state.belief.mean, float), np.asarray(state.belief.cov, float)
    for slot, place, b in zip(slots, places, at, strict=True):
        two, own = slice(2 * slot, 2 * slot + 2), slice(3 + 2 * b, 5 + 2 * b)
        off = place - mean[two]
        if np.linalg.norm(off) > _NEWS_M and off @ np.linalg.solve(P[two, two] + solution.cov[own, own], off) > _NEWS:
            return True
    off = np.linalg.norm(solution.poses[:, :2] - graph.poses()[:count, :2], axis=1)
    return bool(np.sqrt(np.mean(off**2)) > _NEWS_M)


def _differs(solution: Solution, known: Found) -> bool:
    """Whether what ranges are off by is not what was known of it, by more than it is uncertain."""
    found, sigma = solution.found, solution.sigma
    if any(bool(getattr(found, group)) != bool(getattr(known, group)) for group in ("bias", "height", "scale")):
        return True
    pairs = [(found.scale - known.scale, sigma.scale, _NEWS_SCALE)]
    for group, least in (("bias", _NEWS_M), ("height", _NEWS_HEIGHT_M)):
        now, before, spread = (getattr(each, group) for each in (found, known, sigma))
        pairs += [(value - before.get(slot, 0.0), spread[slot], least) for slot, value in now.items()]
    return any(abs(off) > max(least, _NEWS**0.5 * spread) for off, spread, least in pairs)


def up_to_date(revision: Revision, question: Question, state: State) -> Revision | None:
    """A revision with the keyframes that came while it was solved and drawn; None where that cannot be solved.

    They are not hung on the last one that was: what its heading was off by would put them beside their ranges, the
    farther, the more there are.

    Args:
      question: what would be solved now.
    """
    solution, graph = revision.solution, question.graph
    slots, places, _ = _current(solution, graph)
    mean = np.asarray(state_vector.unpack(state.belief.mean).positions, float)
    among = compose(rigid_fit(mean[slots], places), graph.poses()[len(solution.poses) :])
    known = question.places | dict(zip(solution.nodes, solution.beacons, strict=True))
    start = question._replace(poses=np.concatenate([solution.poses, among]), places=known)
    try:
        extended = extended_solution(start, solution)
    except UNSOLVED:
        return None
    return None if extended is None else revision._replace(solution=extended)


def take_over(config: Config, params: Params, revision: Revision, state: State, graph: Graph) -> State:
    """The state with pose, beacons and map as a revision has them that is up to date; the graph's keyframes are moved
    with the map."""
    solution = revision.solution
    slots, places, at = _current(solution, graph)
    s = state_vector.unpack(state.belief.mean)
    old = np.asarray(state_vector.robot_pose(state.belief.mean), float)
    lost = not graph.hangs_on()[-1]
    if lost:  # a robot that has lost the map is where it is among the beacons, and not where the way since would lead
        pose = compose(rigid_fit(np.asarray(s.positions, float)[slots], places), old)
    else:
        on_map = old + np.asarray(s.map_error, float)
        pose = compose(solution.poses[-1], between(graph.poses()[-1], on_map))
    seen, way = graph.seen(solution.poses, revision.drawn), float(state.map_spread.way)
    grid = draw_onto(config, params, revision.tiles, revision.grid, seen, way)
    pose[2] = old[2] + wrapped(pose[2] - old[2])
    cov = _cov(solution, at, pose, float(np.hypot(*(pose - solution.poses[-1])[:2])))
    if lost:
        own = np.array(state_vector.pose_indices(len(s.positions)))
        cov[:3], cov[:, :3] = 0.0, 0.0
        cov[:3, :3] = np.asarray(state.belief.cov, float)[np.ix_(own, own)]
    others = [slot for slot in map(int, np.flatnonzero(np.asarray(state.active))) if slot > 0 and slot not in slots]
    values = np.concatenate([pose, places.ravel()])
    belief = anchored(state.belief, values, cov, slots, others)
    # a buffer of its own: the step donates its state
    spread = state.map_spread._replace(epoch=state.map_spread.way + 0.0)
    graph.put(solution.poses, 0.0)
    return state._replace(
        belief=belief,
        grid=grid,
        map_spread=spread,
        drawn_pose=jnp.asarray(pose, jnp.float32),
    )


def _current(solution: Solution, graph: Graph) -> tuple[list[int], np.ndarray, list[int]]:
    """Slots of the beacons that still rest where the solution has them, their places (B, 2), their numbers in it."""
    # what the scale leaves open all beacons share with the track
    enough = SIGMA_ENOUGH_M + solution.sigma.scale * np.linalg.norm(solution.beacons, axis=1)
    sure = largest_sigma(solution.cov[3:, 3:]) < enough
    at = [b for b, node in enumerate(solution.nodes) if graph.ranges.node(node[0]) == node and sure[b]]
    return [solution.nodes[b][0] for b in at], solution.beacons[at], at


def _cov(solution: Solution, at: list[int], pose: np.ndarray, way: float) -> np.ndarray:
    """(3 + 2 B,) square covariance of the robot's pose now and some of the beacons."""
    rows = np.concatenate([np.arange(3), *[3 + 2 * b + np.arange(2) for b in at]]).astype(int)
    cov = solution.cov[np.ix_(rows, rows)]
    # how the last solved pose turns, the robot turns around it
    lever = pose[:2] - solution.poses[-1, :2]
    J = np.eye(len(rows))
    J[0, 2], J[1, 2] = -lever[1], lever[0]
    floor = np.concatenate([np.array(_WALK) ** 2 * way + np.array(_WALK) ** 2, np.full(2 * len(at), _FLOOR_M**2)])
    return J @ cov @ J.T + np.diag(floor)
