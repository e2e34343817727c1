"""Where the LiDAR sits and what each node's ranges are too long by, from a whole run: a batch problem over its graph.

The rollout cannot tell: its map is drawn with the very mounting that is asked for. Scans laid over each other tell the
LiDAR's own motion, whatever its place on the robot; ranges tell where the antenna was, wheels how the robot moved in
its own frame. LiDAR and antenna alone leave the mounting open by a turn about the antenna: the yaw takes wheels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from uwbslam_jax.backend import Graph, Solution
from uwbslam_jax.errors import RolloutError
from uwbslam_jax.measurements import Message
from uwbslam_jax.session import FrameAssembler, Session, fit_beams
from uwbslam_jax.settings import HostParams, Settings
from uwbslam_jax.tuning import parameters
from uwbslam_jax.tuning.mounting import FIXED, Mounting

_OBSERVED = 1 / 3
"""What is known no better than this share of its prior spread is not observed."""

Array = np.ndarray


@dataclass(frozen=True)
class Calibration:
    """What was found, p parameters.

    Attributes:
      names: of the parameters. start, values: (p,) before and after; sigma: (p,) standard deviation [m, rad].
      told: "" for one that is observed, else "not observed": it has the value it started from.
    """

    names: tuple[str, ...]
    start: Array
    values: Array
    sigma: Array
    told: tuple[str, ...]


def whole_run(messages: Sequence[Message], settings: Settings) -> Session:
    """A recording run to its end."""
    settings = fit_beams(settings, messages)
    session = Session(settings)
    for frame in FrameAssembler(settings, session.config.max_ranges).frames(messages):
        session.step(frame)
    session.finish()
    return session


def calibrate(messages: Sequence[Message], settings: Settings, names: Sequence[str], passes: int = 2) -> Calibration:
    """Finds some of the mounting and the biases. passes: runs of the recording, each made
    with what was found before: scans are put straight, and laid over each other, with a mounting.

    Raises:
      RolloutError: start-up decides nothing, or the recording does not name a node that a bias is asked of.
    """
    start = np.array([parameters.value(settings, name) for name in names])
    found = start
    for _ in range(passes):
        now = parameters.configured(settings, dict(zip(names, found, strict=True)))
        session = whole_run(messages, now)
        if session.hindsight is None:
            raise RolloutError(f"start-up has decided nothing ({session.status}), or nothing ranged")
        solution = session.hindsight.solution
        found, sigma, told = solve(session.graph, session.host, solution, session.slots, names, start)
    return Calibration(tuple(names), start, found, sigma, told)


def solve(
    graph: Graph, host: HostParams, solution: Solution, slots: dict[int, int], names: Sequence[str], start: Array
) -> tuple[Array, Array, tuple[str, ...]]:
    """Values, standard deviations and what is told of each parameter.

    Args:
      host: what the graph was made with. solution: of the graph, to start from. slots: node id -> slot.
      start: (p,) what the priors are about.

    Raises:
      RolloutError: a bias is asked of a node that is not heard, or there are too few ranges.
    """
    mounting = Mounting.build(graph, host, solution)
    if mounting is None:
        raise RolloutError("too few ranges to beacons at rest")
    columns = []
    for name in names:
        node = name.removeprefix(parameters.BIAS)
        if name in parameters.MOUNTING:
            columns.append(mounting.lidar + parameters.MOUNTING[name][0])
        elif slots.get(int(node)) not in mounting.problem.slots:
            raise RolloutError(f"node {node} is not heard, or not placed: {name} cannot be told")
        else:
            columns.append(mounting.problem.slots.index(slots[int(node)]) + mounting.bias)
    at = np.array(columns)
    offset = start - mounting.configured(at)
    spread = np.array([parameters.MOUNTING[n][2] if n in parameters.MOUNTING else parameters.BIAS_M for n in names])
    movable = np.array([name in parameters.MOUNTING for name in names])
    free = np.ones(len(names), bool)
    while True:
        x, sigma = mounting.minimise(at, np.where(free, spread, FIXED), offset)
        share = np.where(free, sigma[at] / spread, 0.0)
        worst = int(np.argmax(np.where(movable, share, 0.0)))
        if not movable.any() or share[worst] < _OBSERVED:
            break
        # of the mounting the worst is taken as configured: the others may be told beside it
        free[worst] = False
    # a bias that is not told stays free, as little known as it is: none of the others may make up for it
    observed = free & (share < _OBSERVED)
    values = np.where(observed, mounting.configured(at) + x[at], start)
    told = tuple("" if seen else "not observed" for seen in observed)
    return values, np.where(observed, sigma[at], np.inf), told


def together(found: Sequence[Calibration]) -> Calibration:
    """What several recordings tell of the same parameters: means by what each is sure of."""
    first = found[0]
    weights = np.array(
        [[0.0 if told else sigma**-2 for told, sigma in zip(c.told, c.sigma, strict=True)] for c in found]
    )
    total = weights.sum(axis=0)
    known = total > 0
    mean = np.sum(weights * np.array([c.values for c in found]), axis=0) / np.where(known, total, 1.0)
    sigma = np.where(known, 1.0 / np.sqrt(np.where(known, total, 1.0)), np.inf)
    told = tuple("" if any_told else "not observed" for any_told in known)
    return Calibration(first.names, first.start, np.where(known, mean, first.start), sigma, told)
