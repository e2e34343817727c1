"""The information of a match, whether a jump of the robot explains it, and its fusion. Twin: estimator.match_fusion."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from uwbslam_jax.estimator import match_fusion as twin
from uwbslam_jax.estimator.native.loops import loops
from uwbslam_jax.estimator.native.matching import Match
from uwbslam_jax.estimator.native.ranging import exchange_of, geometry
from uwbslam_jax.estimator.native.records import Belief, Measured, Model, Record
from uwbslam_jax.estimator.native.small import inverse3, product, times, wrap_angle


class Innovation(NamedTuple):
    """How far a match is from what was expected, as far as the scan can tell, and the covariance of what was."""

    nu: Float[ndarray, "3"]
    S: Float[ndarray, "3 3"]


class Excess(NamedTuple):
    """Squared innovation, and what was expected of it, of position (mean of x and y) and heading [m^2, rad^2]."""

    square: Float[ndarray, "2"]
    expected: Float[ndarray, "2"]


@loops
def pose_row(n: int, i: int) -> int:
    """Where the robot's x, y or heading stands in a state vector of n."""
    return i if i < 2 else n - 5


@loops
def expected_match(vector: Float[ndarray, "n"]) -> Float[ndarray, "3"]:
    n, pose = vector.size, np.empty(3)
    for i in range(3):
        pose[i] = vector[pose_row(n, i)] + vector[n - 3 + i]
    return pose


@loops
def expected_cov(P: Float[ndarray, "n n"]) -> Float[ndarray, "3 3"]:
    """C P C^T of the pose that a match is expected to report."""
    n, S = P.shape[0], np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            a, b, c, d = pose_row(n, i), pose_row(n, j), n - 3 + i, n - 3 + j
            S[i, j] = P[a, b] + P[a, d] + P[c, b] + P[c, d]
    return S


@loops
def innovation_of(match: Match, belief: Belief) -> Innovation:
    away = expected_match(belief.mean)
    for i in range(3):
        away[i] = match.pose[i] - away[i]
    away[2] = wrap_angle(away[2])
    nu = times(match.informed, away)
    return Innovation(nu, expected_cov(belief.cov))


@loops
def excess_of(innovation: Innovation) -> Excess:
    nu, S, floor = innovation.nu, innovation.S, twin._MATCH_FLOOR
    square, expected = np.empty(2), np.empty(2)
    square[0], square[1] = 0.5 * (nu[0] ** 2 + nu[1] ** 2), nu[2] ** 2
    expected[0] = 0.5 * (S[0, 0] + floor[0] ** 2 + S[1, 1] + floor[1] ** 2)
    expected[1] = S[2, 2] + floor[2] ** 2
    return Excess(square, expected)


@loops
def restless(unrest: Float[ndarray, "2"]) -> bool:
    return unrest[0] > twin._RESTLESS[0] ** 2 or unrest[1] > twin._RESTLESS[1] ** 2


@loops
def is_sure(match: Match) -> bool:
    return match.score > twin._SURE[0] and match.known > twin._SURE[1]


@loops
def needs_jump(match: Match, expected_fit: float) -> bool:
    return expected_fit < match.score * match.known - twin._NEEDED


@loops
def information_of(match: Match, params: Record, beams: float) -> Float[ndarray, "3 3"]:
    most, floor = params.independent_beams, twin._MATCH_FLOOR
    share = most / max(beams, most) / params.sigma_l**2
    Y, W = np.empty((3, 3)), np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            Y[i, j] = match.information[i, j] * share
            W[i, j] = Y[i, j] * (floor[0] if j == 0 else floor[1] if j == 1 else floor[2]) ** 2
    return product(inverse3(W, 1.0), Y)


@loops
def surprise_of(Y: Float[ndarray, "3 3"], innovation: Innovation) -> float:
    """nu^T (S + Y^-1)^-1 nu without the inverse of a Y that may be singular."""
    nu = innovation.nu
    weighed = times(inverse3(product(Y, innovation.S), 1.0), times(Y, nu))
    return nu[0] * weighed[0] + nu[1] * weighed[1] + nu[2] * weighed[2]


@loops
def fuse(belief: Belief, Y: Float[ndarray, "3 3"], innovation: Innovation) -> None:
    """The match's information Y into the belief, in place, in Joseph form. Twin: numerics.update_projected."""
    x, P, n = belief.mean, belief.cov, belief.mean.size
    inverse = inverse3(product(Y, innovation.S), 1.0)
    rows, gain, K = np.empty((3, n)), np.empty((3, n)), np.empty((3, n))
    for i in range(3):
        for j in range(n):
            rows[i, j] = P[pose_row(n, i), j] + P[n - 3 + i, j]
    for i in range(3):
        for j in range(n):
            gain[i, j] = rows[0, j] * inverse[0, i] + rows[1, j] * inverse[1, i] + rows[2, j] * inverse[2, i]
    for i in range(3):
        for j in range(n):
            K[i, j] = gain[0, j] * Y[0, i] + gain[1, j] * Y[1, i] + gain[2, j] * Y[2, i]
    for i in range(n):
        a, b, c, row = K[0, i], K[1, i], K[2, i], P[i]
        for j in range(n):
            row[j] -= a * rows[0, j] + b * rows[1, j] + c * rows[2, j]
    for i in range(n):
        row, left = P[i], np.empty(3)
        for m in range(3):
            left[m] = row[pose_row(n, m)] + row[n - 3 + m]
        for m in range(3):
            a, b, more, less = left[m], K[m, i], gain[m], K[m]
            for j in range(n):
                row[j] += b * more[j] - a * less[j]
    for i in range(n):
        for j in range(i):
            P[i, j] = P[j, i] = (P[i, j] + P[j, i]) / 2
        x[i] += K[0, i] * innovation.nu[0] + K[1, i] * innovation.nu[1] + K[2, i] * innovation.nu[2]


@loops
def anchor(belief: Belief, at: Float[ndarray, "3"], share: Float[ndarray, "3 3"]) -> None:
    """The belief after a scan was drawn at a pose with a share of new ground, in place."""
    x, P, n = belief.mean, belief.cov, belief.mean.size
    apart = np.empty(3)
    for i in range(3):
        apart[i] = at[i] - x[pose_row(n, i)]
    apart[2] = wrap_angle(apart[2])
    for i in range(3):
        apart[i] -= x[n - 3 + i]
    moved = times(share, apart)
    for i in range(3):
        x[n - 3 + i] += moved[i]
    q = np.empty(3)
    for j in range(n):
        for i in range(3):
            q[i] = P[n - 3 + i, j] + P[pose_row(n, i), j]
        for i in range(3):
            P[n - 3 + i, j] -= share[i, 0] * q[0] + share[i, 1] * q[1] + share[i, 2] * q[2]
    for j in range(n):
        for i in range(3):
            q[i] = P[j, n - 3 + i] + P[j, pose_row(n, i)]
        for i in range(3):
            P[j, n - 3 + i] -= share[i, 0] * q[0] + share[i, 1] * q[1] + share[i, 2] * q[2]


@loops
def learn_spread(state: Record, P: Float[ndarray, "n n"], share: Float[ndarray, "3 3"], way: float) -> None:
    """Args: P: before the scan was drawn. share: of new ground. way: since the last one that was [m]."""
    new = (share[0, 0] + share[1, 1] + share[2, 2]) / 3
    state.map_spread_views += new
    S, rate, apart = expected_cov(P), new / max(state.map_spread_views, 1e-6), state.map_spread_apart
    for i in range(3):
        for j in range(3):
            apart[i, j] += rate * (S[i, j] - apart[i, j])
    state.map_spread_way += way


@loops
def revisit(belief: Belief, state: Record, seen: float, params: Record) -> None:
    """The belief over ground of another epoch, in place. seen: mean epoch in view [m], 0 where there is none."""
    apart, P, n = abs(seen - state.map_spread_epoch), belief.cov, belief.mean.size
    if not (seen > 0 and apart > twin._OTHER_EPOCH):
        return
    for i in range(3):
        for j in range(3):
            P[n - 3 + i, n - 3 + j] += apart * state.map_spread_apart[i, j] / twin._PATCH_M
        P[n - 3 + i, n - 3 + i] += apart * (params.sigma_map if i < 2 else params.sigma_map_yaw) ** 2
    state.map_spread_epoch = seen


@loops
def learn_unrest(unrest: Float[ndarray, "2"], excess: Excess, needed: bool) -> None:
    for i in range(2):
        scale, calm = twin._UNREST_SCALE[i] ** 2, twin.CALM[i] ** 2
        square, expected = excess.square[i], excess.expected[i]
        if not needed:
            square = min(square, expected)
        move = twin._UNREST_RATE * scale / (scale + expected) * (min(square, 4 * scale) - expected)
        unrest[i] = min(max(unrest[i] + move, calm), scale)


@loops
def misfit(vector: Float[ndarray, "n"], measured: Measured, usable: Int[ndarray, "u"], model: Model) -> float:
    """Of the robot's own ranges, as robust squares."""
    total = 0.0
    for u in range(usable.size):
        exchange = exchange_of(measured, usable[u])
        if exchange.i == 0 or exchange.j == 0:
            z = measured.ranges[0, usable[u]] - geometry(vector, exchange, model).predicted
            z /= 2 * model.params.sigma_n
            total += z**2 / (1 + z**2 / twin._MISFIT_SOFT**2)
    return total


@loops
def contradicted(
    belief: Belief, nu: Float[ndarray, "3"], measured: Measured, usable: Int[ndarray, "u"], model: Model
) -> bool:
    """Whether the frame's ranges speak for the expected pose and against the matched one, which is nu away."""
    n, vector = belief.mean.size, belief.mean.copy()
    speed = (n - 5) // 2
    for i in range(3):
        vector[pose_row(n, i)] += nu[i]
    for i in range(2):
        vector[speed + i] += nu[i] / max(measured.frame.dt, twin._SHORTEST_S)
    expected = misfit(belief.mean, measured, usable, model)
    return misfit(vector, measured, usable, model) > expected + twin._CONTRADICTION


@loops
def allow_jump(belief: Belief, excess: Excess) -> None:
    """The belief, where a credible match is unexpected made uncertain enough to follow it, in place."""
    square, expected, P, n = excess.square, excess.expected, belief.cov, belief.mean.size
    if square[0] > twin._UNEXPECTED * expected[0] or square[1] > twin._UNEXPECTED * expected[1]:
        wider = min(max(square[0] - expected[0], 0.0), twin._JUMP[0] ** 2)
        P[0, 0] += wider
        P[1, 1] += wider
        P[n - 5, n - 5] += min(max(square[1] - expected[1], 0.0), twin._JUMP[1] ** 2)
