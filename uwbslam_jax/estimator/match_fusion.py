"""The information of a match: how surprising it is, whether a jump of the robot explains it, and its fusion.

A match is weighed against what was expected of it. Where a scan that is sure of itself contradicts the expectation,
the robot's motion was not what its velocity said: stamps that come late, a bump, a turn between two scans. Then the
pose gets uncertain enough to follow, unless the ranges speak against it. How often that happens is learnt.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Bool, Float, Int

from uwbslam_jax.estimator import ranging, state_vector
from uwbslam_jax.estimator.matching import Match
from uwbslam_jax.measurements import Frame
from uwbslam_jax.numerics import Gaussian, inverse3, update_projected, wrap_angle
from uwbslam_jax.settings import Params

SURPRISE = 30.0
"""Squared Mahalanobis distance of a match beyond which it is not believed (chi-square, 3: 1e-6)."""
CALM = (0.002, 0.001)
"""Motion that no velocity explains, of a robot whose stamps are right: one standard deviation [m, rad]."""
_RESTLESS = (0.05, 0.03)
"""A robot moves by jumps when this much of its motion is unexplained [m, rad]."""
_UNREST_SCALE = (0.3, 0.5)
"""Most that is learnt, and the expected spread from which on a match says little about jumps [m, rad]."""
_UNREST_RATE = 0.05
"""Share of one match in what is learnt."""
_MATCH_FLOOR = (0.004, 0.004, 0.0006)
"""Error of any match beyond what its Hessian tells: cells, drawn walls [m, m, rad]."""
_SURE = (0.65, 0.5)
"""A match is sure of itself with such a score and share of returns on observed cells."""
_NEEDED = 0.15
"""A jump is needed where the scan fits the expected pose so much worse than the match [score x share known]."""
_UNEXPECTED = 9.0
"""Squared innovation over its expectation from which on it is taken for a jump."""
_JUMP = (0.5, 1.0)
"""Largest standard deviation that a jump is given [m, rad]."""
_CONTRADICTION = 6.0
"""How much worse the ranges may fit a jump than what was expected (difference of robust squares)."""
_MISFIT_SOFT = 3.0
"""Of those a range counts at most the square of so many doubled standard deviations."""
_OTHER_EPOCH = 3.0
"""Ground drawn within so much way of each other errs alike [m]."""
_PATCH_M = 8.0
"""Ground so far apart on the way errs each by itself where scans say little of how it hangs together [m]."""
_ASTRAY = 0.02
"""For the likelihood: so many matches are anywhere in the cube of _ANYWHERE around what was expected."""
_ANYWHERE = 1.0
"""A match is taken to err by this at most where its scan tells nothing [m, rad]."""
_SHORTEST_S = 0.05
"""A jump is taken to have lasted at least so long [s]."""


class MapSpread(NamedTuple):
    """What is known of how the map errs from place to place, learnt while it was drawn.

    Attributes:
      apart: (3, 3) mean covariance of a match where new ground was drawn: how much neighbouring ground may differ.
      views: how much new ground that is, in views.
      way: how far was driven [m]; the epoch of what is drawn next.
      epoch: of the ground that the map error in the state belongs to [m].
    """

    apart: Float[Array, "3 3"]
    views: Float[Array, ""]
    way: Float[Array, ""]
    epoch: Float[Array, ""]


def even_map() -> MapSpread:
    """Of a map that nothing was drawn into yet."""
    return MapSpread(jnp.zeros((3, 3)), jnp.zeros(()), jnp.ones(()), jnp.ones(()))


def expected_match(belief: Gaussian) -> Float[Array, "3"]:
    """The pose that a match is expected to report: robot pose + map error [m, m, rad]."""
    return state_vector.matched_pose_jacobian(state_vector.node_count(belief.mean.shape[0])) @ belief.mean


def restless(unrest: Float[Array, "2"]) -> Bool[Array, ""]:
    """Whether the robot moves by jumps. unrest: variances [m^2, rad^2]."""
    return jnp.any(unrest > jnp.array(_RESTLESS) ** 2)


def is_sure(match: Match) -> Bool[Array, ""]:
    """Whether a match is sure of itself by its score and by what it sees of the map."""
    return (match.score > _SURE[0]) & (match.known > _SURE[1])


def needs_jump(match: Match, expected_fit: Float[Array, ""]) -> Bool[Array, ""]:
    """Whether the scan fits the expected pose clearly worse. expected_fit: score x known there."""
    return expected_fit < match.score * match.known - _NEEDED


def weigh(
    match: Match, belief: Gaussian, params: Params, beams: Int[Array, ""]
) -> tuple[Float[Array, ""], Float[Array, "3 3"]]:
    """How surprising a match is, and its information about pose + map error.

    The information is its Hessian, for as many of its beams as count as independent, and never better than the floor
    (Y^-1 + floor)^-1. The surprise is the squared Mahalanobis distance to what was expected; information falls with
    it as with a range's (Geman-McClure), so that a plausible match of the wrong place cannot drag the state.
    """
    Y = _information(match, params, beams)
    innovation, S = _innovation(match, belief)
    # nu^T (S + Y^-1)^-1 nu without the inverse of a Y that may be singular
    surprise = innovation @ (inverse3(jnp.eye(3) + Y @ S) @ (Y @ innovation))
    return surprise, Y / (1.0 + surprise / SURPRISE) ** 2


def log_likelihood(match: Match, belief: Gaussian, params: Params, beams: Int[Array, ""]) -> Float[Array, ""]:
    """Log density of a match given what was expected of it [1/m^2/rad].

    A normal one of covariance S + Y^-1 for most matches and an even one for those that found the wrong place, so that
    it integrates to one whatever the parameters are.
    """
    blind = jnp.eye(3) / _ANYWHERE**2
    innovation, S = _innovation(match, belief)
    L = jnp.linalg.cholesky(S + inverse3(_information(match, params, beams) + blind))
    half = solve_triangular(L, innovation, lower=True)
    normal = -0.5 * (half @ half) - jnp.sum(jnp.log(jnp.diagonal(L))) - 1.5 * math.log(2 * math.pi)
    return jnp.logaddexp(normal + math.log1p(-_ASTRAY), math.log(_ASTRAY / _ANYWHERE**3))


def _information(match: Match, params: Params, beams: Int[Array, ""]) -> Float[Array, "3 3"]:
    """Y of a match: its Hessian for as many beams as count as independent, and never better than the floor."""
    share = params.independent_beams / jnp.maximum(beams, params.independent_beams)
    Y = match.information * (share / params.sigma_l**2)
    floor = jnp.diag(jnp.array(_MATCH_FLOOR) ** 2)
    return inverse3(jnp.eye(3) + Y @ floor) @ Y


def fuse(belief: Gaussian, match: Match, information: Float[Array, "3 3"]) -> Gaussian:
    """EKF update by a matched pose, of which the map's own error is a part (match hard, fuse soft)."""
    C = state_vector.matched_pose_jacobian(state_vector.node_count(belief.mean.shape[0]))
    innovation, _ = _innovation(match, belief)
    return update_projected(belief, C, information, innovation)


def anchor(belief: Gaussian, at: Float[Array, "3"], share: Float[Array, "3 3"]) -> Gaussian:
    """The belief after a scan was drawn: e <- (1 - N) e + N (at - pose).

    Where new ground is drawn the map errs by what the pose errs by, whatever it was before: the map error is carried
    over with its covariance, so that ranges that later mend the pose mend what the map is taken for as well.

    Args:
      at: pose the scan was drawn at [m, m, rad]. share: N, of what it saw that is new ground.
    """
    k = state_vector.node_count(belief.mean.shape[0])
    pose, error = jnp.array(state_vector.pose_indices(k)), jnp.array(state_vector.map_error_indices(k))
    apart = at - belief.mean[pose]
    apart = apart.at[2].set(wrap_angle(apart[2]))
    mean = belief.mean.at[error].add(share @ (apart - belief.mean[error]))
    # only the map error's rows and columns change: cheaper than the dense F P F^T
    rows = belief.cov.at[error].add(-share @ (belief.cov[error] + belief.cov[pose]))
    return Gaussian(mean, rows.at[:, error].add(-(rows[:, error] + rows[:, pose]) @ share.T))


def learn_spread(spread: MapSpread, belief: Gaussian, share: Float[Array, "3 3"], way: Float[Array, ""]) -> MapSpread:
    """Spread of the map's errors after a scan was drawn with a share of new ground.

    Args:
      belief: before the scan was drawn. way: driven since the last one that was [m].
    """
    C = state_vector.matched_pose_jacobian(state_vector.node_count(belief.mean.shape[0]))
    new = jnp.mean(jnp.diagonal(share))
    views = spread.views + new
    apart = spread.apart + new / jnp.maximum(views, 1e-6) * (C @ belief.cov @ C.T - spread.apart)
    return MapSpread(apart, views, spread.way + way, spread.epoch)


def revisit(belief: Gaussian, spread: MapSpread, seen: Float[Array, ""], params: Params) -> tuple[Gaussian, MapSpread]:
    """The belief over ground of another epoch: the map errs there by something else, the more so the farther was driven
    in between. So a loop is closed by what is seen, and not by what was true at its other end.

    Args:
      seen: mean epoch of the ground in view [m], 0 where none was drawn before.
    """
    apart = jnp.abs(seen - spread.epoch)
    other = (seen > 0) & (apart > _OTHER_EPOCH)
    added = jnp.diag(jnp.stack([params.sigma_map, params.sigma_map, params.sigma_map_yaw]) ** 2)
    added = added + spread.apart / _PATCH_M
    error = jnp.array(state_vector.map_error_indices(state_vector.node_count(belief.mean.shape[0])))
    cov = belief.cov.at[error[:, None], error].add(jnp.where(other, apart, 0.0) * added)
    return belief._replace(cov=cov), spread._replace(epoch=jnp.where(other, seen, spread.epoch))


def learn_unrest(
    unrest: Float[Array, "2"], match: Match, belief: Gaussian, needed: Bool[Array, ""]
) -> Float[Array, "2"]:
    """Variance of the motion between two scans that no velocity explains, after one more match [m^2, rad^2].

    A running mean of what the innovation has beyond its expectation. Where much was expected anyway, a match says
    little; where the scan fits the expected pose too, a difference is the match's own and not the robot's.
    """
    square, expected = _excess(match, belief)
    square = jnp.where(needed, square, jnp.minimum(square, expected))
    scale = jnp.array(_UNREST_SCALE) ** 2
    move = _UNREST_RATE * scale / (scale + expected) * (jnp.minimum(square, 4 * scale) - expected)
    return jnp.clip(unrest + move, jnp.array(CALM) ** 2, scale)


def contradicted(
    match: Match, belief: Gaussian, frame: Frame, usable: Bool[Array, "M"], params: Params
) -> Bool[Array, ""]:
    """Whether the frame's ranges speak for the expected pose and against the matched one.

    Most were taken on the way there, so the jump is taken to have been driven since the last frame.
    """
    ranges = frame.ranges
    innovation, _ = _innovation(match, belief)
    k = state_vector.node_count(belief.mean.shape[0])
    pose, velocity = jnp.array(state_vector.pose_indices(k)), jnp.array([2 * k, 2 * k + 1])
    robots = usable & ((ranges.i == 0) | (ranges.j == 0))

    def misfit(vector: Float[Array, "n"]) -> Float[Array, ""]:
        z = (ranges.range - ranging.predicted_ranges(vector, ranges, params)) / (2 * params.sigma_n)
        return jnp.sum(jnp.where(robots, z**2 / (1 + z**2 / _MISFIT_SOFT**2), 0.0))

    driven = innovation[:2] / jnp.maximum(frame.dt, _SHORTEST_S)
    return misfit(belief.mean.at[pose].add(innovation).at[velocity].add(driven)) > misfit(belief.mean) + _CONTRADICTION


def allow_jump(belief: Gaussian, match: Match, credible: Bool[Array, ""]) -> Gaussian:
    """The belief, where a match is unexpected and credible made uncertain enough to follow it. Only the pose: a jump
    tells nothing about the velocity."""
    square, expected = _excess(match, belief)
    jumped = credible & jnp.any(square > _UNEXPECTED * expected)
    wider = jnp.minimum(jnp.maximum(square - expected, 0.0), jnp.array(_JUMP) ** 2)
    at = jnp.array(state_vector.pose_indices(state_vector.node_count(belief.mean.shape[0])))
    wider = jnp.where(jumped, wider, 0.0)[jnp.array([0, 0, 1])]
    return belief._replace(cov=belief.cov.at[at, at].add(wider))


def _innovation(match: Match, belief: Gaussian) -> tuple[Float[Array, "3"], Float[Array, "3 3"]]:
    """How far a match is from what was expected, as far as the scan can tell, and the covariance of what was."""
    C = state_vector.matched_pose_jacobian(state_vector.node_count(belief.mean.shape[0]))
    innovation = match.pose - C @ belief.mean
    seen = match.informed @ innovation[:2]
    return jnp.append(seen, wrap_angle(innovation[2])), C @ belief.cov @ C.T


def _excess(match: Match, belief: Gaussian) -> tuple[Float[Array, "2"], Float[Array, "2"]]:
    """Squared innovation, position (mean of x and y) and heading, and what was expected of it [m^2, rad^2]."""
    innovation, S = _innovation(match, belief)
    square, expected = innovation**2, jnp.diagonal(S) + jnp.array(_MATCH_FLOOR) ** 2
    mean = jnp.array([[0.5, 0.5, 0.0], [0.0, 0.0, 1.0]])
    return mean @ square, mean @ expected
