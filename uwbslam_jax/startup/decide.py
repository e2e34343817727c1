"""Start-up without prior knowledge: where the beacons stand in the frame the robot started in.

While the step runs on LiDAR (and odometry) alone, a `Buffer` keeps keyframes and what was ranged around them.
`solve` places the beacons in every way that may explain the ranges and says how much better the best one does.
`adopt` puts a decided placement into the state: the paper's frame, the joint covariance, the map drawn again.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from uwbslam_jax.estimator import published
from uwbslam_jax.numerics import DECIDED, SIGMA_ENOUGH_M, fewest_open, largest_sigma, numeric_jacobian
from uwbslam_jax.reasons import Lack, StartUpLacks
from uwbslam_jax.result import RunStatus
from uwbslam_jax.settings import Found
from uwbslam_jax.startup.hypotheses import explanations
from uwbslam_jax.startup.keyframe_buffer import Buffer
from uwbslam_jax.startup.placement import Placement, Problem
from uwbslam_jax.startup.track_scale import wrong_scale

_MOVED_ENOUGH_M = 1.0
"""A robot that has not moved so far is waited for: over less, the noise of the ranges hides the directions [m]."""
_EACH = 0.0
"""That ranges are not as configured is decided; what it is, heights or biases, need only be likely: the back end will
tell, and to go on with neither would bend the track [log-likelihood]."""
_HEADING_ENOUGH = 0.026
"""Start-up ends when the robot's heading among the beacons is known this well [rad]."""
_UNDRAWN_HEADING, _UNDRAWN_SIGMA = 0.15, 0.05
"""The same without a map [rad], and for positions as a share of the distance between beacons."""
_MISFIT = 3.0
"""Ranges of which half are off by more standard deviations than this do not fit the track."""
_UNDRAWN_WAIT_S = 60.0
"""Without a map so long is waited for beacons that are not yet certain: placed together they are placed best."""


@dataclass(frozen=True)
class Outcome:
    """What start-up knows now.

    Attributes:
      status: never LIDAR_ONLY.
      hypotheses: how many explanations are alive (0 before there is one).
      margin: difference of log-likelihood between the two reflections.
      placement: the decided one, else None.
      lack: what is waited for, None where there is a placement.
      open: what ranges are explained far better with: "bias", "height", "scale"; a placement then has them.
    """

    status: RunStatus
    hypotheses: int
    margin: float
    placement: Placement | None
    lack: Lack | None = None
    open: tuple[str, ...] = ()

    def found(self) -> Found | None:
        """What a placement's ranges are off by, None where they are as configured."""
        if self.placement is None or not self.open:
            return None
        off, slots = self.placement.off, [0, *self.placement.slots]
        bias = dict(zip(slots, map(float, off.bias), strict=True)) if "bias" in self.open else {}
        height = {slot: float(h) for slot, h in zip(slots, off.height, strict=True) if h}
        return Found(bias, height, float(off.scale))


def solve(buffer: Buffer, ids: dict[int, int]) -> Outcome:
    """Place the beacons if what is buffered determines them. ids: slot -> node id."""
    if buffer.extent < _MOVED_ENOUGH_M and not any(key.blind for key in buffer.keyframes[1:]):
        return Outcome(RunStatus.WAITING, 0, 0.0, None, StartUpLacks.MOTION)
    problem = Problem.build(buffer)
    if problem is None:
        return Outcome(RunStatus.PLACING, 0, 0.0, None, StartUpLacks.RANGES)
    if (apart := wrong_scale(buffer)) is not None:
        return Outcome(RunStatus.PLACING, 0, 0.0, None, apart)
    problem, found, opened = _explain(problem)
    best = found[0]
    margin = found[1].cost - best.cost if len(found) > 1 else float("inf")
    misfit = StartUpLacks.FIT if problem.misfit(best) > _MISFIT else None
    if margin < DECIDED:
        alive = sum(other.cost - best.cost < DECIDED for other in found)
        return Outcome(RunStatus.UNDECIDED, alive, margin, None, misfit or StartUpLacks.SIDE, opened)
    drawn = any(key.information.any() for key in buffer.keyframes)
    sure = _keep_certain(problem.keep_unique(best), ids, drawn=drawn)
    waits = not drawn and buffer.newest - buffer.keyframes[0].frame.stamp < _UNDRAWN_WAIT_S * 1e9
    if isinstance(sure, Placement) and waits and len(sure.slots) < len(problem.slots):
        sure = StartUpLacks.MORE
    if isinstance(sure, Lack):
        return Outcome(RunStatus.PLACING, 1, margin, None, misfit or sure, opened)
    return Outcome(RunStatus.DECIDED, 1, margin, sure, None, opened)


def _explain(problem: Problem) -> tuple[Problem, list[Placement], tuple[str, ...]]:
    """Explanations, the best first, with ranges taken as they are configured, or with what explains them far better
    left open; and that."""

    def again(groups: tuple[str, ...], before: Placement) -> Placement:
        return problem.freed(groups).minimise(before.beacons, before.poses, before.off)

    found = explanations(problem)
    groups, _ = fewest_open((), found[0], problem.groups, again, _EACH)
    freed = problem.freed(groups)
    return freed, explanations(freed) if groups else found, groups


def _keep_certain(placement: Placement, ids: dict[int, int], *, drawn: bool) -> Placement | Lack:
    """The beacons whose place in the published frame is certain, or what is not known yet.

    The start frame is no measure: all beacons turn together with the heading that the track started with. What the
    robot drove by wheels since its last scan is no matter: the map hangs on that scan, and the next one tells. Where
    no map is drawn, nothing is lost by a frame that is known less well: the filter only has to be near enough to be
    linear.
    """
    if len(placement.slots) < 2:
        return StartUpLacks.BEACONS
    frame_slots = choose_frame(placement, ids)
    sigma_enough, heading_enough = SIGMA_ENOUGH_M, _HEADING_ENOUGH
    if not drawn:
        span = float(np.max(np.linalg.norm(placement.beacons - placement.beacons[0], axis=1)))
        sigma_enough, heading_enough = max(sigma_enough, _UNDRAWN_SIGMA * span), _UNDRAWN_HEADING
    onward = np.zeros(3)
    x = np.concatenate([placement.poses[placement.drawn], placement.beacons.ravel()])
    columns = placement.columns(placement.drawn)
    cov = placement.cov[np.ix_(columns, columns)]
    J = numeric_jacobian(partial(published, slots=placement.slots, frame_slots=frame_slots, onward=onward), x)
    cov = J @ cov @ J.T
    if np.sqrt(cov[2, 2]) > heading_enough or largest_sigma(cov[:2, :2])[0] > sigma_enough:
        return StartUpLacks.HEADING
    certain = largest_sigma(cov[3:, 3:]) < sigma_enough
    return placement.only([b for b, ok in enumerate(certain) if ok]) if sum(certain) >= 2 else StartUpLacks.BEACONS


def choose_frame(placement: Placement, ids: dict[int, int]) -> tuple[int, int]:
    """Slots of the beacons at the origin and on +x: the lowest id, and the one farthest from it, which fixes the
    direction best. ids: slot -> node id."""
    origin = min(placement.slots, key=lambda slot: ids[slot])
    away = np.linalg.norm(placement.beacons - placement.beacons[placement.slots.index(origin)], axis=1)
    return origin, placement.slots[int(np.argmax(away))]
