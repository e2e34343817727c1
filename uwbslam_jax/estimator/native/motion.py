"""How the state moves between two frames, with or without odometry. Twin: estimator.motion."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from uwbslam_jax.estimator import motion as twin
from uwbslam_jax.estimator.native.loops import loops
from uwbslam_jax.estimator.native.records import Belief, Measured, Memory, Record


class Moves(NamedTuple):
    """What moves how: the robot's own rows of the state by F, the beacons that are carried by their velocity.

    Attributes:
      own: (9,) rows of the robot, see `take_robot`. F: (9, 9). moving: (K,). coast: see the twin's _coast [s].
    """

    own: Int[ndarray, "9"]
    F: Float[ndarray, "9 9"]
    moving: Float[ndarray, "K"]
    coast: float


@loops
def coast_of(dt: float) -> float:
    return twin._COAST_S * (1.0 - math.exp(-dt / twin._COAST_S))


@loops
def take_robot(nodes: int) -> Int[ndarray, "9"]:
    """The robot's own rows: place, velocity, heading, yaw rate and map error."""
    own = np.empty(9, np.int64)
    own[0], own[1], own[2], own[3] = 0, 1, 2 * nodes, 2 * nodes + 1
    for i in range(5):
        own[4 + i] = 4 * nodes + i
    return own


@loops
def coasting(robot: Float[ndarray, "9"], dt: float, F: Float[ndarray, "9 9"]) -> Float[ndarray, "9"]:
    """The robot dt [s] later without odometry, and its Jacobian but for the map error."""
    coast, slower = coast_of(dt), math.exp(-dt / (4 * twin._COAST_S))
    vx, vy, rate = robot[2], robot[3], robot[5]
    turn = rate * coast
    c, s = math.cos(turn / 2), math.sin(turn / 2)
    x, y = (c * vx - s * vy) * coast, (s * vx + c * vy) * coast
    F[0, 2], F[0, 3], F[1, 2], F[1, 3] = c * coast, -s * coast, s * coast, c * coast
    F[0, 5], F[1, 5] = -y * coast / 2, x * coast / 2
    c, s = math.cos(turn) * slower, math.sin(turn) * slower
    after = robot.copy()
    after[0] += x
    after[1] += y
    after[2], after[3] = c * vx - s * vy, s * vx + c * vy
    after[4] += turn
    after[5] = rate * slower
    F[2, 2], F[2, 3], F[3, 2], F[3, 3] = c, -s, s, c
    F[2, 5], F[3, 5], F[4, 5], F[5, 5] = -after[3] * coast, after[2] * coast, coast, slower
    return after


@loops
def driving(
    robot: Float[ndarray, "9"], dt: float, increment: Float[ndarray, "3"], F: Float[ndarray, "9 9"]
) -> Float[ndarray, "9"]:
    """The robot dt [s] later by its odometry, and its Jacobian but for the map error."""
    safe_dt = max(dt, twin._SHORTEST_S)
    c, s = math.cos(robot[4]), math.sin(robot[4])
    x, y = c * increment[0] - s * increment[1], s * increment[0] + c * increment[1]
    most, most_spun = twin._ACCELERATION[0] * dt, twin._ACCELERATION[1] * dt
    fx, fy = x / safe_dt - robot[2], y / safe_dt - robot[3]
    length = math.sqrt(fx * fx + fy * fy)
    share = min(1.0, most / max(length, 1e-9))
    F[0, 4], F[1, 4] = -y, x
    # of `faster * share` by the velocity: minus what `faster` grows with, less what `share` falls by
    a, b, d = share, 0.0, share
    if share < 1.0 and length > 1e-9:
        a -= share * fx * fx / length**2
        b -= share * fx * fy / length**2
        d -= share * fy * fy / length**2
    F[2, 2], F[2, 3], F[3, 2], F[3, 3] = 1.0 - a, -b, -b, 1.0 - d
    F[2, 4], F[3, 4] = (a * -y + b * x) / safe_dt, (b * -y + d * x) / safe_dt
    excess = increment[2] / safe_dt - robot[5]
    F[5, 5] = 1.0 if abs(excess) > most_spun else 0.0
    after = robot.copy()
    after[0] += x
    after[1] += y
    after[2] += fx * share
    after[3] += fy * share
    after[4] += increment[2]
    after[5] += min(max(excess, -most_spun), most_spun)
    return after


@loops
def move_error(robot: Float[ndarray, "9"], after: Float[ndarray, "9"], F: Float[ndarray, "9 9"]) -> None:
    """The map error is a rigid motion of the map: it turns with the lever arm that the robot drives."""
    x, y, turned = after[0] - robot[0], after[1] - robot[1], robot[8]
    after[6] -= turned * y
    after[7] += turned * x
    for j in range(2, 6):
        F[6, j], F[7, j] = -turned * F[1, j], turned * F[0, j]
    F[6, 8], F[7, 8] = -y, x


@loops
def carry(P: Float[ndarray, "n n"], moves: Moves) -> None:
    """P <- (F P) of the whole state: rows only."""
    own, nodes = moves.own, moves.moving.size
    for q in range(2, 2 * nodes):
        place, velocity = P[q], P[2 * nodes + q]
        if moves.moving[q // 2] > 0:
            for j in range(place.size):
                place[j] += moves.coast * velocity[j]
        else:
            for j in range(velocity.size):
                velocity[j] = 0.0
    before = np.empty((9, P.shape[0]))
    for i in range(9):
        for j in range(P.shape[0]):
            before[i, j] = P[own[i], j]
    for i in range(9):
        row = P[own[i]]
        for j in range(row.size):
            row[j] = 0.0
        for k in range(9):
            f, other = moves.F[i, k], before[k]
            if f != 0.0:
                for j in range(row.size):
                    row[j] += f * other[j]


@loops
def flip(P: Float[ndarray, "n n"]) -> None:
    """P <- P^T."""
    for i in range(P.shape[0]):
        for j in range(i):
            P[i, j], P[j, i] = P[j, i], P[i, j]


@loops
def add_white(P: Float[ndarray, "n n"], q: int, v: int, variance: float, t: float) -> None:
    """White acceleration of a place q and its velocity v for t [s]."""
    P[q, q] += variance * t**3 / 3
    P[v, v] += variance * t
    P[q, v] += variance * t**2 / 2
    P[v, q] += variance * t**2 / 2


@loops
def add_increment(P: Float[ndarray, "n n"], q: int, v: int, variance: float, dt: float) -> None:
    """The error of an increment over dt [s] in a place q and its velocity v."""
    P[q, q] += variance
    P[v, v] += variance / dt**2
    P[q, v] += variance / dt
    P[v, q] += variance / dt


@loops
def add_robot_noise(P: Float[ndarray, "n n"], params: Record, frame: Record, unrest: Float[ndarray, "2"]) -> None:
    heading = P.shape[0] - 5
    speed, dt = heading // 2, frame.dt
    t, safe_dt = min(dt, twin._COAST_S), max(dt, twin._SHORTEST_S)
    if frame.odometry_valid:
        increment, floor = frame.odometry_increment, params.odom_sigma_floor
        length = math.sqrt(increment[0] ** 2 + increment[1] ** 2 + 1e-12)
        by_way = (floor[0] + params.odom_sigma_xy * length) ** 2
        by_turn = (floor[1] + params.odom_sigma_yaw * abs(increment[2])) ** 2
        add_increment(P, 0, speed, by_way, safe_dt)
        add_increment(P, 1, speed + 1, by_way, safe_dt)
        add_increment(P, heading, heading + 1, by_turn, safe_dt)
    else:
        for q in range(2):
            add_white(P, q, speed + q, params.sigma_w**2, t)
            P[q, q] += unrest[0]
        add_white(P, heading, heading + 1, params.sigma_w_yaw**2, t)
        P[heading, heading] += unrest[1]
    for q in range(heading + 2, heading + 5):
        P[q, q] += twin._LEAST_NOISE[1]


@loops
def add_beacon_noise(P: Float[ndarray, "n n"], params: Record, dt: float, moving: Float[ndarray, "K"]) -> None:
    speed = 2 * moving.size
    for q in range(2, speed):
        if moving[q // 2] > 0:
            add_white(P, q, speed + q, params.sigma_w_carried**2, min(dt, twin._COAST_S))
        else:
            P[q, q] += params.sigma_w_beacon**2 * dt
            P[speed + q, speed + q] += twin._LEAST_NOISE[0]


@loops
def bound(P: Float[ndarray, "n n"], row: int, most: float) -> None:
    """Row and column shrunk to a standard deviation of `most`, where it is more."""
    if P[row, row] > most**2:
        scale = math.sqrt(most**2 / P[row, row])
        for j in range(P.shape[0]):
            P[row, j] *= scale
        for j in range(P.shape[0]):
            P[j, row] *= scale


@loops
def predict(belief: Belief, params: Record, measured: Measured, memory: Memory) -> None:
    """The belief at the frame, in place."""
    x, P, moving, frame = belief.mean, belief.cov, memory.nodes[1], measured.frame
    nodes, dt = moving.size, frame.dt
    own, F = take_robot(nodes), np.zeros((9, 9))
    robot = np.empty(9)
    for i in range(9):
        robot[i] = x[own[i]]
        F[i, i] = 1.0
    after = driving(robot, dt, frame.odometry_increment, F) if frame.odometry_valid else coasting(robot, dt, F)
    move_error(robot, after, F)
    moves = Moves(own, F, moving, coast_of(dt))
    for q in range(2, 2 * nodes):
        if moving[q // 2] > 0:
            x[q] += moves.coast * x[2 * nodes + q]
        else:
            x[2 * nodes + q] = 0.0
    for i in range(9):
        x[own[i]] = after[i]
    carry(P, moves)
    flip(P)
    carry(P, moves)
    for i in range(P.shape[0]):
        for j in range(i):
            P[i, j] = P[j, i] = (P[i, j] + P[j, i]) / 2
    add_robot_noise(P, params, frame, memory.state.unrest)
    add_beacon_noise(P, params, dt, moving)
    fastest, widest = twin._FASTEST, twin._WIDEST_MAP
    bound(P, 2 * nodes, fastest[0])
    bound(P, 2 * nodes + 1, fastest[0])
    bound(P, 4 * nodes + 1, fastest[1])
    bound(P, 4 * nodes, fastest[2])
    bound(P, 4 * nodes + 2, widest[0])
    bound(P, 4 * nodes + 3, widest[0])
    bound(P, 4 * nodes + 4, widest[1])
