"""Noise parameters from recordings: BFGS of optimistix over their logarithms, from a wide prior about where it starts.

What the recordings do not tell is found by the curvature at the end, and put back to where it was.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from uwbslam_jax.tuning import parameters
from uwbslam_jax.tuning.likelihood import Objective, Score

Progress = Callable[[str], object]
_MOST_STEPS = 40
"""Of BFGS; a fit that has not converged by then says so."""
_TOLERANCE = 1e-3
"""The fit ends when a step is shorter than this in the logarithms and tells less than this a measurement,"""
_STANDSTILL = 0.5
"""or when two steps gained less than this log-likelihood each."""
_PATIENCE = 3
"""The fit is stopped early when the held-out part got worse so many times in a row."""
_SCANNED = (0.25, 0.5, 2.0, 4.0)
"""Multiples of each value that are tried before the fit: there may be more than one minimum. Where sigma_n is far too
small the filter takes every pair for one behind a wall, raises its noise, and is content with that."""
_STEP = 0.05
"""Of the differences of gradients that give the Hessian, in logarithms."""
_LONGEST = 0.3
"""Of a Newton step in one logarithm."""
_JUMP = 5.0
"""What the negative log-likelihood jumps by where it is told."""
_OBSERVED = 0.5
"""A logarithm known no better than this is not observed by the recordings."""
_TOLD = 2.0
"""Log-likelihood by which a value has to be worse to be ruled out (95 %)."""
_BISECTIONS = 6
"""A bound is found to 1/64 of the way between its two ends."""


@dataclass(frozen=True)
class NoiseFit:
    """What was found, p parameters.

    Attributes:
      names: of the parameters. start, values: (p,) before and after.
      sigma: (p,) standard deviation of the logarithms, from the Hessian.
      told: "" for a parameter that is observed; "at most" or "at least" for one that is told from one side only, its
        value is that bound; "not observed" for one that has the value it started from.
      jumps: (p,) whether the likelihood jumps nearby: there the estimator decides otherwise, or loses its way.
      hessian: (p, p) of the negative log-posterior by the logarithms.
      history: loss a measurement, and held-out loss a frame, at every step that was accepted.
      stopped: why the fit ended. evaluations: of value and gradient.
      before, after: of the held-out part.
    """

    names: tuple[str, ...]
    start: np.ndarray
    values: np.ndarray
    sigma: np.ndarray
    told: tuple[str, ...]
    jumps: np.ndarray
    hessian: np.ndarray
    history: list[tuple[float, float]]
    stopped: str
    before: Score
    after: Score
    evaluations: int

    def interval(self, k: int) -> tuple[float, float]:
        """95 % confidence interval of a value that is observed."""
        spread = math.exp(1.96 * float(self.sigma[k]))
        return float(self.values[k]) / spread, float(self.values[k]) * spread


def fit(objective: Objective, progress: Progress = lambda text: None) -> NoiseFit:
    """Minimises an objective from its start. progress: told a line at every step."""
    start = objective.start
    told = dict.fromkeys(objective.names, "")
    history: list[tuple[float, float]] = []
    logs, stopped = _descend(objective, _scanned(objective), history, progress)
    hessian, jumps = _hessian(objective, logs, progress)
    while objective.free.any():
        sigma = _sigma(hessian, objective.free)
        hidden = np.flatnonzero(objective.free & ~(sigma < _OBSERVED))
        if not len(hidden):
            break
        for k in map(int, hidden):
            logs[k], told[objective.names[k]] = _bound(objective, logs, k)
            progress(f"{objective.names[k]} {told[objective.names[k]]}")
        # the others are fitted once more beside those that stay where they are now
        objective.free[hidden] = False
        logs, stopped = _descend(objective, logs, history, progress)
    logs = _polished(objective, logs, np.diag(hessian))
    return NoiseFit(
        objective.names,
        np.exp(start),
        np.exp(logs),
        _sigma(hessian, objective.free),
        tuple(told.values()),
        jumps,
        hessian,
        history,
        stopped,
        objective.held_out(start),
        objective.held_out(logs),
        objective.evaluations,
    )


def _scanned(objective: Objective) -> np.ndarray:
    """The best place to begin at, of multiples of one parameter after the other."""
    logs = objective.start.copy()
    least = objective.value(logs)
    for k in range(len(logs)):
        for move in np.log(_SCANNED):
            tried = logs.copy()
            tried[k] = objective.start[k] + move
            found = objective.value(tried)
            if found < least:
                logs, least = tried, found
    return logs


def _descend(
    objective: Objective, start: np.ndarray, history: list[tuple[float, float]], progress: Progress
) -> tuple[np.ndarray, str]:
    """BFGS until it converges, or the held-out part gets worse and worse."""
    if not objective.free.any():
        return start, "nothing is observed"

    @jax.custom_vjp
    def loss(logs: Float[Array, "p"]) -> Float[Array, ""]:
        return jnp.float32(objective.value(np.asarray(logs, float)))

    def forward(logs: Float[Array, "p"]) -> tuple[Float[Array, ""], Float[Array, "p"]]:
        value, gradient = objective.value_and_gradient(np.asarray(logs, float))
        return jnp.float32(value), jnp.asarray(gradient, jnp.float32)

    loss.defvjp(forward, lambda gradient, cotangent: (cotangent * gradient,))
    solver = optx.BFGS(rtol=_TOLERANCE, atol=_TOLERANCE)

    def fn(logs: Float[Array, "p"], _: None) -> tuple[Float[Array, ""], None]:
        return loss(logs), None

    y = jnp.asarray(start, jnp.float32)
    state = solver.init(fn, y, None, {}, jax.ShapeDtypeStruct((), jnp.float32), None, frozenset())
    accepted, best, worse = 0, (math.inf, start), 0
    losses: list[float] = []
    for _ in range(_MOST_STEPS):
        y, state, _ = solver.step(fn, y, None, {}, state, frozenset())
        if int(state.num_accepted_steps) > accepted:
            accepted = int(state.num_accepted_steps)
            logs = np.asarray(y, float)
            held = -objective.held_out(logs).per_frame
            losses.append(float(state.f_info.f))
            history.append((losses[-1], held))
            named = ", ".join(f"{name} {v:.4g}" for name, v in zip(objective.names, np.exp(logs), strict=True))
            progress(f"loss {history[-1][0]:.4f}, held out {held:.3f}: {named}")
            worse = 0 if held < best[0] else worse + 1
            best = min(best, (held, logs), key=lambda pair: pair[0])
            if worse == _PATIENCE:
                return best[1], "the held-out part got worse"
            if len(losses) > 2 and max(-np.diff(losses[-3:])) * objective.weight < _STANDSTILL:
                return logs, "converged"
        tried = float(jnp.max(jnp.abs(state.y_eval - y)))
        if accepted > 1 and tried < _TOLERANCE:
            return np.asarray(y, float), "no shorter step is better"
        done, _ = solver.terminate(fn, y, None, {}, state, frozenset())
        if bool(done):
            return np.asarray(y, float), "converged"
    return np.asarray(y, float), f"{_MOST_STEPS} steps"


def _bound(objective: Objective, logs: np.ndarray, k: int) -> tuple[float, str]:
    """Where a parameter that is not observed goes: back to its start where that is no worse; else, where it is told
    from one side only, to the value nearest to the start that is not ruled out."""
    end, start = float(logs[k]), float(objective.start[k])

    def worse(at: float) -> float:
        tried = logs.copy()
        tried[k] = at
        return (objective.value(tried) - least) * objective.weight

    least = objective.value(logs)
    if worse(start) < _TOLD:
        return start, "not observed"
    inside, outside = end, start
    for _ in range(_BISECTIONS):
        middle = 0.5 * (inside + outside)
        inside, outside = (middle, outside) if worse(middle) < _TOLD else (inside, middle)
    return inside, "at most" if end < start else "at least"


def _hessian(objective: Objective, logs: np.ndarray, progress: Progress) -> tuple[np.ndarray, np.ndarray]:
    """Hessian of the negative log-posterior by central differences of its gradient, over more where a logarithm is
    known only roughly; and near which of them the function jumps."""
    p, w = len(logs), objective.weight
    hessian, jumps = np.zeros((p, p)), np.zeros(p, bool)
    middle, _ = objective.value_and_gradient(logs)
    for k in range(p):
        progress(f"curvature of {objective.names[k]}")
        for step in (_STEP, 4 * _STEP):
            (v1, g1), (v0, g0) = (objective.value_and_gradient(logs + s * np.eye(p)[k]) for s in (step, -step))
            hessian[k] = w * (g1 - g0) / (2 * step)
            # Simpson's rule would have the values differ by the gradient's mean where nothing jumps
            smooth = 0.5 * step * abs(g1[k] - g0[k])
            jumps[k] |= w * (max(v1, v0) - middle - abs(g1[k] + g0[k]) * step - smooth) > _JUMP
            if hessian[k, k] > _STEP**-2:
                break
    # a gradient that was taken beyond a jump is another's: of two entries that should be the same, the smaller
    smaller = np.where(np.abs(hessian) < np.abs(hessian.T), hessian, hessian.T)
    return smaller, jumps


def _polished(objective: Objective, logs: np.ndarray, curvature: np.ndarray) -> np.ndarray:
    """Newton steps one logarithm after the other: where one of them is held up by a jump of the function, a step of all
    together is too short for the others."""
    value, _ = objective.value_and_gradient(logs)
    for k in np.flatnonzero(objective.free):
        _, gradient = objective.value_and_gradient(logs)
        if curvature[k] <= 0:
            continue
        step = np.clip(-gradient[k] * objective.weight / curvature[k], -_LONGEST, _LONGEST)
        for share in (1.0, 0.5, 0.25):
            tried = logs + share * step * np.eye(len(logs))[k]
            found = objective.value(tried)
            if found < value:
                logs, value = tried, found
                break
    return logs


def _sigma(hessian: np.ndarray, free: np.ndarray) -> np.ndarray:
    """Standard deviations by the curvature of what is free; infinite for what is not."""
    at = np.flatnonzero(free)
    sigma = np.full(len(free), np.inf)
    values, vectors = np.linalg.eigh(hessian[np.ix_(at, at)])
    values = np.maximum(values, parameters.LOG_SPREAD**-2)  # the prior's, where differences of gradients are noise
    sigma[at] = np.sqrt(np.sum(vectors**2 / values, axis=1))
    return sigma
