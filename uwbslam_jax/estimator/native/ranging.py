"""Ranges between nodes: the model, the NLOS power rule and the robust weights. Twin: estimator.ranging."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from uwbslam_jax.estimator import ranging as twin
from uwbslam_jax.estimator.native.loops import loops
from uwbslam_jax.estimator.native.records import EPS, Belief, Measured, Memory, Model, Told
from uwbslam_jax.numerics import gaussian


class Exchange(NamedTuple):
    """One range: its slots, and how old it is [s]."""

    i: int
    j: int
    age: float


class Geometry(NamedTuple):
    """Of an exchange: its predicted range [m], unit vector in the plane, lever arm, and whose: +1 i's, -1 j's."""

    predicted: float
    x: float
    y: float
    lever_x: float
    lever_y: float
    end: float


@loops
def geometry(vector: Float[ndarray, "n"], exchange: Exchange, model: Model) -> Geometry:
    i, j, age = exchange
    params, nodes = model.params, model.bias.size
    angle = vector[4 * nodes] + vector[4 * nodes + 1] * age
    c, s = math.cos(angle), math.sin(angle)
    x, y = params.antenna[0], params.antenna[1]
    lever_x, lever_y = c * x - s * y, s * x + c * y
    end = (1.0 if i == 0 else 0.0) - (1.0 if j == 0 else 0.0)
    a, b, speed = 2 * i, 2 * j, 2 * nodes
    flat_x = vector[a] - vector[b] + age * (vector[speed + a] - vector[speed + b]) + end * lever_x
    flat_y = vector[a + 1] - vector[b + 1] + age * (vector[speed + a + 1] - vector[speed + b + 1]) + end * lever_y
    rise = model.height[i] - model.height[j]
    slant = math.sqrt(flat_x**2 + flat_y**2 + rise**2)
    per = 1.0 / slant if slant > 0 else 0.0
    bias = model.bias[i] + (model.bias[j] if i != j else 0.0)
    predicted = (1.0 + params.bias_scale) * slant + bias
    return Geometry(predicted, flat_x * per, flat_y * per, lever_x, lever_y, end)


@loops
def row_of(at: Int[ndarray, "10"], h: Float[ndarray, "10"], exchange: Exchange, g: Geometry, model: Model) -> None:
    """The ten entries of the state on which a range depends, and its derivatives by them."""
    i, j, age = exchange
    nodes, scale = model.bias.size, 1.0 + model.params.bias_scale
    for a in range(2):
        slope = scale * (g.x if a == 0 else g.y)
        at[a], at[2 + a], at[4 + a], at[6 + a] = 2 * i + a, 2 * j + a, 2 * (nodes + i) + a, 2 * (nodes + j) + a
        h[a], h[2 + a], h[4 + a], h[6 + a] = slope, -slope, age * slope, -age * slope
    at[8], at[9] = 4 * nodes, 4 * nodes + 1
    turning = g.end * scale * (g.y * g.lever_x - g.x * g.lever_y)
    h[8], h[9] = turning, age * turning


@loops
def robust_weight(normalised: float) -> float:
    return (1.0 / (1.0 + (normalised / twin._SOFT) ** 2)) ** 2


@loops
def loudness(log: float) -> float:
    return min(max((math.exp(log) / twin._QUIET) ** 2, 1.0), twin._LOUDEST)


@loops
def log_density(innovation: float, S: float) -> float:
    normal = -0.5 * (innovation**2 / S + math.log(2 * math.pi * S)) + math.log1p(-twin._ASTRAY)
    even = math.log(twin._ASTRAY / twin._ASTRAY_M)
    return max(normal, even) + math.log1p(math.exp(-abs(normal - even)))


@loops
def exchange_of(measured: Measured, m: int) -> Exchange:
    return Exchange(int(measured.slots[0, m]), int(measured.slots[1, m]), float(measured.ranges[1, m]))


@loops
def usable_of(measured: Measured, active: Float[ndarray, "K"], nlos_gap_db: float) -> Int[ndarray, "u"]:
    """Which slots of a frame's ranges are used: between nodes that have a place, and in line of sight by the power
    rule."""
    count, usable = 0, np.empty(measured.ranges.shape[1], np.int64)
    for m in range(usable.size):
        if measured.ranges[3, m] > 0 and not measured.ranges[2, m] > nlos_gap_db:
            i, j, _ = exchange_of(measured, m)
            if active[i] > 0 and active[j] > 0:
                usable[count] = m
                count += 1
    return usable[:count]


@loops
def move_of(scatter: Float[ndarray, "3 K K"], exchange: Exchange, normalised: float) -> float:
    """What a range teaches of its pair's scatter."""
    i, j, _ = exchange
    if not scatter[2, i, j] > 0:
        return 0.0
    jump = (normalised - scatter[1, i, j]) / math.sqrt(2.0)
    square = (jump / (twin._NORMAL_MEDIAN * math.exp(scatter[0, i, j]))) ** 2
    return twin._LEARN * (1.0 - 2.0 / (1.0 + square**2))


@loops
def learn_scatter(
    scatter: Float[ndarray, "3 K K"], measured: Measured, usable: Int[ndarray, "u"], quiet: Float[ndarray, "u 2"]
) -> None:
    """quiet: of each usable range its innovation over its standard deviation for quiet pairs, and its move."""
    for u in range(usable.size):
        i, j, _ = exchange_of(measured, usable[u])
        scatter[0, i, j] += quiet[u, 1]
        scatter[0, j, i] += quiet[u, 1]
        scatter[1, i, j] = scatter[1, j, i] = quiet[u, 0]
        scatter[2, i, j] = scatter[2, j, i] = 1.0
    low, high = twin._SCATTER_LIMITS
    for u in range(usable.size):
        i, j, _ = exchange_of(measured, usable[u])
        scatter[0, i, j] = min(max(scatter[0, i, j], low), high)
        scatter[0, j, i] = min(max(scatter[0, j, i], low), high)


@loops
def inflate(P: Float[ndarray, "n n"]) -> None:
    """What the twin's square root adds to a covariance, see numerics.symmetric_root."""
    eps = gaussian._ROUNDINGS * EPS * P.shape[0]
    for i in range(P.shape[0]):
        P[i, i] += eps * max(P[i, i], gaussian._LEAST_VARIANCE)


@loops
def correct(
    P: Float[ndarray, "n n"],
    shift: Float[ndarray, "n"],
    at: Int[ndarray, "10"],
    h: Float[ndarray, "10"],
    z: Float[ndarray, "2"],
) -> None:
    """One range of innovation and variance z into the covariance and the shift of the mean so far."""
    n = P.shape[0]
    g = np.zeros(n)
    for a in range(10):
        row, slope = P[at[a]], h[a]
        for j in range(n):
            g[j] += slope * row[j]
    S, left = z[1], z[0]
    for a in range(10):
        S += h[a] * g[at[a]]
        left -= h[a] * shift[at[a]]
    for i in range(n):
        if g[i] != 0.0:
            k, row = g[i] / S, P[i]
            shift[i] += k * left
            for j in range(n):
                row[j] -= k * g[j]


@loops
def update(
    belief: Belief, measured: Measured, usable: Int[ndarray, "u"], model: Model, memory: Memory, told: Told
) -> None:
    """EKF update by all usable ranges, in place: one after the other, all at the same linearisation, which gives what
    the twin's information form gives.

    Args:
      usable: which slots of the frame's ranges. told: gets innovation, normalised, weight and log_likelihood.
    """
    P, n, scatter, log_likelihood = belief.cov, belief.mean.size, memory.scatter, 0.0
    for m in range(told.ranges.shape[1]):
        told.ranges[0, m] = told.ranges[1, m] = told.ranges[2, m] = 0.0
    at, h = np.empty((usable.size, 10), np.int64), np.empty((usable.size, 10))
    quiet, z = np.empty((usable.size, 2)), np.empty((usable.size, 2))
    for u in range(usable.size):
        m, exchange = usable[u], exchange_of(measured, usable[u])
        g = geometry(belief.mean, exchange, model)
        row_of(at[u], h[u], exchange, g, model)
        innovation, spread = measured.ranges[0, m] - g.predicted, 0.0
        for a in range(10):
            for b in range(10):
                spread += h[u, a] * h[u, b] * P[at[u, a], at[u, b]]
        variance = model.params.sigma_n**2
        quiet[u, 0] = innovation / math.sqrt(spread + variance)
        quiet[u, 1] = move_of(scatter, exchange, quiet[u, 0])
        variance *= loudness(scatter[0, exchange.i, exchange.j]) ** 2
        S = spread + variance
        normalised = innovation / math.sqrt(S)
        weight = robust_weight(normalised)
        z[u, 0], z[u, 1] = innovation, variance / weight
        told.ranges[0, m], told.ranges[1, m], told.ranges[2, m] = innovation, normalised, weight
        log_likelihood += log_density(innovation, S)
    told.told.log_likelihood = log_likelihood
    learn_scatter(scatter, measured, usable, quiet)
    inflate(P)
    shift = np.zeros(n)
    for u in range(usable.size):
        correct(P, shift, at[u], h[u], z[u])
    for i in range(n):
        belief.mean[i] += shift[i]
