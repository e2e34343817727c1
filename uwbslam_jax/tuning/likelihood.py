"""How good noise parameters are for recordings, by value and gradient: likelihood of rollouts, or their tracks' error.

Each rollout has a first part that is fitted and a last one that is held out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from uwbslam_jax.estimator import State
from uwbslam_jax.evaluation import Truth
from uwbslam_jax.measurements import Frame
from uwbslam_jax.settings import Config, Params
from uwbslam_jax.tuning import parameters
from uwbslam_jax.tuning.rollout import Losses, Rollout, losses, rescaled

Goal = Literal["likelihood", "truth"]
HELD_SHARE = 0.25
"""Last part of a rollout that takes no part in the fit."""
_FLAT_M2 = 1e-12
"""Keeps the logarithm of a mean square error finite where the track is exact [m^2]."""
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


def piece(rollout: Rollout, truth: Truth | None = None, held: float = HELD_SHARE) -> Piece:
    """A rollout cut into a fitted and a held-out part."""
    true = np.full((rollout.count, 2), np.nan)
    if truth is not None:
        true = truth.poses_at(rollout.stamps)[:, :2]
    return Piece(rollout, true, round((1 - held) * rollout.count))


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
        total, gradient = self._prior(logs), (logs - self.start) / parameters.LOG_SPREAD**2
        for p in self.pieces:
            r = p.rollout
            frames = jax.tree.map(lambda x, n=p.count: x[:n], r.frames)
            true = jnp.asarray(p.true[: p.count], jnp.float32)
            x = jnp.asarray(logs, jnp.float32)
            one, slope = _value_and_gradient(r.config, self.names, self.goal, x, (r.params, r.state), (frames, true))
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
        return 0.5 * float(np.sum(((logs - self.start) / parameters.LOG_SPREAD) ** 2))


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

    def centred(points: Float[Array, "T 2"]) -> Float[Array, "T 2"]:
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
def _losses(
    config: Config, names: tuple[str, ...], logs: Float[Array, "p"], params: Params, state: State, frames: Frame
) -> Losses:
    tuned = parameters.put(params, names, logs)
    return losses(config, tuned, rescaled(tuned, params, state), frames)


@partial(jax.jit, static_argnums=(0, 1, 2))
def _value_and_gradient(
    config: Config,
    names: tuple[str, ...],
    goal: Goal,
    logs: Float[Array, "p"],
    start: tuple[Params, State],
    data: tuple[Frame, Float[Array, "T 2"]],
) -> tuple[Float[Array, ""], Float[Array, "p"]]:
    """Of a rollout from its start, with the truth of its frames."""
    (params, state), (frames, true) = start, data

    def total(logs: Float[Array, "p"]) -> tuple[Float[Array, ""], Float[Array, ""]]:
        tuned = parameters.put(params, names, logs)
        value = _total(losses(config, tuned, rescaled(tuned, params, state), frames), true, goal)
        return value, value

    gradient, value = jax.jacfwd(total, has_aux=True)(logs)
    return value, gradient
