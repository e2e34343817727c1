"""Noise parameters from recordings: the likelihood of a rollout, or the error of its track, minimised by its gradient.

BFGS of optimistix over logarithms, with a wide Gaussian prior about the values it starts from. What the recordings do
not tell is found by the Hessian at the end, and put back to where it was.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from uwbslam_jax import tunable
from uwbslam_jax.config import Config, Params
from uwbslam_jax.measurements import Frame
from uwbslam_jax.metrics import Truth
from uwbslam_jax.rollout import Losses, Rollout, checkpointed, losses, rescaled, whole_chunks
from uwbslam_jax.slam import State

Goal = Literal["likelihood", "truth"]
HELD_SHARE = 0.25
"""Last part of a rollout that takes no part in the fit."""
_MOST_STEPS = 40
_TOLERANCE = 1e-3
"""The fit ends when a step is shorter than this in the logarithms and tells less than this a measurement."""
_PATIENCE = 3
"""The fit is stopped early when the held-out part got worse so many times in a row."""
_STEP = 0.05
"""Of the differences of gradients that give the Hessian, in logarithms."""
_OBSERVED = 0.5
"""A logarithm known no better than this is not observed by the recordings."""
_FLAT_M2 = 1e-12
_WORST = 1e3
"""Loss of parameters with which the estimator breaks down, a measurement."""


class Piece(NamedTuple):
    """A rollout and what it is judged by.

    Attributes:
      rollout: see there. true: (T, 2) where the robot was [m], NaN where that is not known.
      count: frames that are fitted; the rest is held out.
    """

    rollout: Rollout
    true: Float[np.ndarray, "T 2"]
    count: int


class Score(NamedTuple):
    """What a part of the recordings tells about a set of parameters, the means over its frames.

    Attributes:
      per_range: log-likelihood of a range; per_match: of a match; per_frame: of both, a frame.
      track_rms: of the robot after one rigid motion [m], NaN without truth.
      frames: (n,) log-likelihood of each frame.
    """

    per_range: float
    per_match: float
    per_frame: float
    track_rms: float
    frames: np.ndarray


@dataclass
class Tuned:
    """What was found.

    Attributes:
      names: of the parameters. start, values: before and after. sigma: standard deviation of the logarithms, from the
        Hessian. observed: whether the recordings tell them; those that are not have the value they started from.
      hessian: (p, p) of the negative log-posterior by the logarithms.
      history: loss a measurement of fitted and held-out part, at every step that was accepted.
      stopped: why the fit ended.
      before, after: of the held-out part.
      evaluations: of value and gradient.
    """

    names: tuple[str, ...]
    start: np.ndarray
    values: np.ndarray
    sigma: np.ndarray
    observed: np.ndarray
    hessian: np.ndarray
    history: list[tuple[float, float]]
    stopped: str
    before: Score
    after: Score
    evaluations: int

    def interval(self, k: int) -> tuple[float, float]:
        """95 % confidence interval of a value."""
        spread = math.exp(1.96 * float(self.sigma[k]))
        return float(self.values[k]) / spread, float(self.values[k]) * spread


def piece(rollout: Rollout, truth: Truth | None = None, held: float = HELD_SHARE) -> Piece:
    """A rollout cut into a fitted and a held-out part."""
    true = np.full((rollout.count, 2), np.nan)
    if truth is not None:
        true = truth.poses_at(rollout.stamps)[:, :2]
    count = whole_chunks(jax.tree.map(lambda x: x[: round((1 - held) * rollout.count)], rollout.frames)).dt.shape[0]
    return Piece(rollout, true, count)


@dataclass
class Objective:
    """Negative log-posterior of noise parameters by their logarithms, a measurement.

    Attributes:
      pieces: recordings. names: of the parameters. start: (p,) logarithms that the prior is about.
      goal: what is minimised. free: (p,) which may move. evaluations: how often it was evaluated with its gradient.
    """

    pieces: Sequence[Piece]
    names: tuple[str, ...]
    start: np.ndarray
    goal: Goal = "likelihood"
    free: np.ndarray = field(default_factory=lambda: np.zeros(0, bool))
    evaluations: int = 0
    weight: float = 0.0

    def __post_init__(self) -> None:
        self.free = np.ones(len(self.names), bool)
        if self.goal == "truth":
            self.weight = float(sum(piece.count for piece in self.pieces))
            return
        scans = sum(int(np.sum(np.asarray(p.rollout.frames.has_scan)[: p.count])) for p in self.pieces)
        self.weight = scans + sum(
            float(np.sum(np.asarray(self.losses(p, self.start).counts)[: p.count])) for p in self.pieces
        )

    def losses(self, piece: Piece, logs: np.ndarray) -> Losses:
        """Of every frame of a rollout, held-out ones too."""
        r = piece.rollout
        return _losses(r.config, self.names, jnp.asarray(logs, jnp.float32), r.params, r.state, r.frames)

    def value(self, logs: np.ndarray) -> float:
        """Of the fitted part, forward only."""
        total = self._prior(logs)
        for piece in self.pieces:
            told = jax.tree.map(lambda x, n=piece.count: x[:n], self.losses(piece, logs))
            total += float(_total(told, jnp.asarray(piece.true[: piece.count], jnp.float32), self.goal))
        return total / self.weight

    def value_and_gradient(self, logs: np.ndarray) -> tuple[float, np.ndarray]:
        """Of the fitted part."""
        self.evaluations += 1
        total, gradient = self._prior(logs), (logs - self.start) / tunable.LOG_SPREAD**2
        for p in self.pieces:
            r = p.rollout
            frames = jax.tree.map(lambda x, n=p.count: x[:n], r.frames)
            true = jnp.asarray(p.true[: p.count], jnp.float32)
            x = jnp.asarray(logs, jnp.float32)
            one, slope = _value_and_gradient(r.config, self.names, self.goal, x, r.params, r.state, frames, true)
            total, gradient = total + float(one), gradient + np.asarray(slope, float)
        if not (np.isfinite(total) and np.isfinite(gradient).all()):
            return _WORST, np.zeros(len(logs))
        return total / self.weight, np.where(self.free, gradient, 0.0) / self.weight

    def held_out(self, logs: np.ndarray) -> Score:
        """Of the parts that are not fitted, all recordings together."""
        found = [(piece, self.losses(piece, logs)) for piece in self.pieces]
        ranges, matches, counts = (
            np.concatenate([np.asarray(getattr(told, key), float)[piece.count :] for piece, told in found])
            for key in ("ranges", "matches", "counts")
        )
        scans = np.concatenate([np.asarray(piece.rollout.frames.has_scan)[piece.count :] for piece, _ in found])
        rms = [_rms(np.asarray(told.poses)[piece.count :, :2], piece.true[piece.count :]) for piece, told in found]
        return Score(
            -float(ranges.sum() / max(counts.sum(), 1.0)),
            -float(matches.sum() / max(scans.sum(), 1)),
            -float(np.mean(ranges + matches)),
            float(np.sqrt(np.mean(np.square(rms)))),
            -(ranges + matches),
        )

    def _prior(self, logs: np.ndarray) -> float:
        return 0.5 * float(np.sum(((logs - self.start) / tunable.LOG_SPREAD) ** 2))


def _total(told: Losses, true: Float[Array, "T 2"], goal: Goal) -> Float[Array, ""]:
    """What is minimised of one rollout: with truth, T log of the mean square error after one rigid motion, which is a
    likelihood whose noise is not known."""
    if goal == "likelihood":
        return jnp.sum(told.ranges) + jnp.sum(told.matches)
    return told.poses.shape[0] * jnp.log(_square_error(told.poses[:, :2], true) + _FLAT_M2)


def _square_error(found: Float[Array, "T 2"], true: Float[Array, "T 2"]) -> Float[Array, ""]:
    """Mean squared distance after the best rigid motion [m^2], over where the truth is known."""
    known = jnp.all(jnp.isfinite(true), axis=1)[:, None]
    count = jnp.maximum(jnp.sum(known), 1)

    def centred(points):
        points = jnp.where(known, points, 0.0)
        return jnp.where(known, points - jnp.sum(points, axis=0, keepdims=True) / count, 0.0)

    a, b = centred(found), centred(true)
    along, across = jnp.sum(a * b), jnp.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    # what is left after the best turn, in closed form
    return jnp.maximum(jnp.sum(a**2) + jnp.sum(b**2) - 2 * jnp.hypot(along, across), 0.0) / count


def _rms(found: np.ndarray, true: np.ndarray) -> float:
    if not np.isfinite(true).all(axis=1).any():
        return float("nan")
    return float(np.sqrt(_square_error(jnp.asarray(found), jnp.asarray(true, jnp.float32))))


@partial(jax.jit, static_argnums=(0, 1))
def _losses(config: Config, names: tuple[str, ...], logs, params: Params, state: State, frames: Frame) -> Losses:
    tuned = tunable.put(params, names, logs)
    return losses(config, tuned, rescaled(tuned, params, state), frames)


@partial(jax.jit, static_argnums=(0, 1, 2))
def _value_and_gradient(config: Config, names, goal: Goal, logs, params, state, frames, true):
    def total(logs):
        tuned = tunable.put(params, names, logs)
        return _total(checkpointed(config, tuned, rescaled(tuned, params, state), frames), true, goal)

    return jax.value_and_grad(total)(logs)


def fit(objective: Objective, progress: Callable[[str], object] = lambda text: None) -> Tuned:
    """Minimises an objective from its start. progress: told a line at every step."""
    start = objective.start.copy()
    history: list[tuple[float, float]] = []
    logs, stopped = _descend(objective, start, history, progress)
    hessian = _hessian(objective, logs, progress)
    while True:
        sigma = _sigma(hessian, objective.free)
        hidden = objective.free & ~(sigma < _OBSERVED)
        if not hidden.any() or not (objective.free & ~hidden).any():
            break
        # what the recordings do not tell is put back, and the others are fitted beside it
        objective.free = objective.free & ~hidden
        told = ", ".join(name for name, gone in zip(objective.names, hidden, strict=True) if gone)
        progress(f"not observed: {told}")
        logs, stopped = _descend(objective, np.where(objective.free, logs, start), history, progress)
    observed = objective.free & (sigma < _OBSERVED)
    logs = np.where(observed, logs, start)
    return Tuned(
        objective.names,
        np.exp(start),
        np.exp(logs),
        sigma,
        observed,
        hessian,
        history,
        stopped,
        objective.held_out(start),
        objective.held_out(logs),
        objective.evaluations,
    )


def _descend(objective: Objective, start: np.ndarray, history, progress) -> tuple[np.ndarray, str]:
    """BFGS until it converges, or the held-out part gets worse and worse."""

    @jax.custom_vjp
    def loss(logs):
        return jnp.float32(objective.value(np.asarray(logs, float)))

    def forward(logs):
        value, gradient = objective.value_and_gradient(np.asarray(logs, float))
        return jnp.float32(value), jnp.asarray(gradient, jnp.float32)

    loss.defvjp(forward, lambda gradient, cotangent: (cotangent * gradient,))
    solver = optx.BFGS(rtol=_TOLERANCE, atol=_TOLERANCE)

    def fn(logs, _):
        return loss(logs), None

    y = jnp.asarray(start, jnp.float32)
    state = solver.init(fn, y, None, {}, jax.ShapeDtypeStruct((), jnp.float32), None, frozenset())
    accepted, best, worse = 0, (math.inf, start), 0
    for _ in range(_MOST_STEPS):
        y, state, _ = solver.step(fn, y, None, {}, state, frozenset())
        if int(state.num_accepted_steps) > accepted:
            accepted = int(state.num_accepted_steps)
            logs = np.asarray(y, float)
            held = -objective.held_out(logs).per_frame
            history.append((float(state.f_info.f), held))
            named = ", ".join(f"{name} {v:.4g}" for name, v in zip(objective.names, np.exp(logs), strict=True))
            progress(f"loss {history[-1][0]:.4f}, held out {held:.3f}: {named}")
            worse = 0 if held < best[0] else worse + 1
            best = min(best, (held, logs), key=lambda pair: pair[0])
            if worse == _PATIENCE:
                return best[1], "the held-out part got worse"
        done, _ = solver.terminate(fn, y, None, {}, state, frozenset())
        if bool(done):
            return np.asarray(y, float), "converged"
    return np.asarray(y, float), f"{_MOST_STEPS} steps"


def _hessian(objective: Objective, logs: np.ndarray, progress) -> np.ndarray:
    """Hessian of the negative log-posterior, by central differences of its gradient; where a logarithm is known only
    roughly, over as much."""
    p = len(logs)
    hessian = np.zeros((p, p))
    for k in range(p):
        progress(f"curvature of {objective.names[k]}")
        for step in (_STEP, 4 * _STEP):
            ahead, behind = (objective.value_and_gradient(logs + s * np.eye(p)[k])[1] for s in (step, -step))
            hessian[k] = objective.weight * (ahead - behind) / (2 * step)
            if hessian[k, k] > _STEP**-2:
                break
    return 0.5 * (hessian + hessian.T)


def _sigma(hessian: np.ndarray, free: np.ndarray) -> np.ndarray:
    """Standard deviations by the curvature of what is free; infinite where there is none."""
    at = np.flatnonzero(free)
    sigma = np.full(len(free), np.inf)
    values, vectors = np.linalg.eigh(hessian[np.ix_(at, at)])
    values = np.maximum(values, tunable.LOG_SPREAD**-2)  # the prior's, where differences of gradients are noise
    sigma[at] = np.sqrt(np.diag((vectors / values) @ vectors.T))
    return sigma
