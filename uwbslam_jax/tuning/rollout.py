"""A recording from the end of its start-up on, as one differentiable function of the parameters.

Start-up is run once with the parameters given: what it decided, the map it drew and the frames from there on are held
fixed. The host's part of a run (beacons that join or are carried, the back end, a map that moves its window) has no
derivative and no part in a rollout.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from uwbslam_jax.errors import RolloutError
from uwbslam_jax.estimator import State, step
from uwbslam_jax.mapping import EPOCH_LEVEL, TILE, Grid
from uwbslam_jax.measurements import Frame, Message, RangeMessage, StampedFrame
from uwbslam_jax.session import CONTROL_EVERY, FrameAssembler, Session, fit_beams
from uwbslam_jax.settings import MOST_BEACONS, Config, Params, Settings

_SETTLED = 30
"""Frames after start-up has decided that beacons have to be placed which it was not yet sure of."""
_MARGIN_M = 6.4
"""A robot this near to the window's edge has left it [m]."""
_BORDER_M = 0.5
"""Of a window around what is seen [m]."""
_EVERY_BEAM = 20
"""Every so many beams tell how far a scan sees."""
FEWEST_FRAMES = 60
"""A shorter rollout tells nothing."""


class Losses(NamedTuple):
    """What each frame of a rollout tells; T frames.

    Attributes:
      ranges, matches: (T,) negative log-likelihood of the innovations and of the match.
      counts: (T,) how many ranges were used.
      poses: (T, 3) the robot's [m, m, rad].
    """

    ranges: Float[Array, "T"]
    matches: Float[Array, "T"]
    counts: Float[Array, "T"]
    poses: Float[Array, "T 3"]


class Rollout(NamedTuple):
    """A recording made ready.

    Attributes:
      config: static. params: those that start-up was run with. state: when it had decided.
      frames: stacked on the first axis, T. stamps: (T,) [ns].
      slots: node id -> slot.
      cut: why it ends before the recording does, "" where it does not.
    """

    config: Config
    params: Params
    state: State
    frames: Frame
    stamps: np.ndarray
    slots: dict[int, int]
    cut: str

    @property
    def count(self) -> int:
        """Number of frames T."""
        return len(self.stamps)

    @property
    def seconds(self) -> float:
        """From its first frame to its last [s]."""
        return float(self.stamps[-1] - self.stamps[0]) / 1e9

    def loss(self, params: Params) -> Float[Array, ""]:
        """Negative log-likelihood of the ranges and matches, a measurement; differentiable, the estimator's decisions
        held. params: see `Params`; those of the rollout where nothing is to be changed."""
        return _loss(self.config, params, self.params, self.state, self.frames)


def prepare(messages: Sequence[Message], settings: Settings) -> Rollout:
    """Runs start-up on a recording and keeps what follows.

    Raises:
      RolloutError: start-up decides nothing, or too few frames follow.
    """
    settings = fit_nodes(fit_beams(settings, messages), messages)
    session = Session(settings)
    assembler = FrameAssembler(settings, session.config.max_ranges)
    waiting: list[StampedFrame] = []
    kept: list[StampedFrame] = []
    settled = 0
    for frame in assembler.frames(messages):
        if settled >= _SETTLED:
            kept.append(frame)
            continue
        waiting.append(frame)
        if len(waiting) == CONTROL_EVERY:
            session.steps(waiting)
            waiting = []
            settled += CONTROL_EVERY if session.decided_at is not None or settings.filter.lidar_only else 0
    if not kept:
        raise RolloutError(f"start-up has decided nothing ({session.status})")
    # a buffer of its own: the session's steps donate theirs
    config, params, state = session.config, session.params, jax.tree.map(jnp.array, session.state)
    count, cut, grid = _in_window(config, params, state, kept)
    if count < FEWEST_FRAMES:
        raise RolloutError(f"{count} frames after start-up, must be {FEWEST_FRAMES} at least{cut and ': '}{cut}")
    config = dataclasses.replace(config, cells=grid.levels[0].shape[0])
    stamps = np.array([frame.stamp for frame in kept[:count]], np.int64)
    frames = stacked(kept[:count])
    return Rollout(config, params, state._replace(grid=grid), frames, stamps, dict(session.slots), cut)


def fit_nodes(settings: Settings, messages: Sequence[Message]) -> Settings:
    """Settings with no more slots for beacons than there are ids: a step's cost grows with them."""
    ids = {node for m in messages if isinstance(m, RangeMessage) for node in (m.source, m.target)}
    beacons = min(max(len(ids - {settings.robot.id}), 1), MOST_BEACONS)
    return dataclasses.replace(settings, uwb=dataclasses.replace(settings.uwb, max_beacons=beacons))


def _in_window(config: Config, params: Params, state: State, kept: Sequence[StampedFrame]) -> tuple[int, str, Grid]:
    """How many frames a window can hold that does not move, why they are not all, and that window: no larger than what
    is seen in them, for its size is what a rollout costs."""
    frames = stacked(kept)
    poses = np.asarray(losses(config, params, state, frames).poses, float)
    side = config.cells * config.resolution
    outside = np.abs(poses[:, :2] - np.asarray(state.grid.origin, float) - side / 2).max(axis=1) > side / 2 - _MARGIN_M
    count = int(np.argmax(outside)) if outside.any() else len(poses)
    cut = f"the robot leaves the map's window (map.size_m) after {count} frames" if outside.any() else ""
    ends = [poses[:count, :2]] + [_ends(frame.frame, pose) for frame, pose in zip(kept[:count], poses, strict=False)]
    seen = np.concatenate(ends) if count else poses[:1, :2]
    low, high = np.quantile(seen, 0.001, axis=0) - _BORDER_M, np.quantile(seen, 0.999, axis=0) + _BORDER_M
    tile = TILE * config.resolution
    first, last = np.floor(low / tile), np.ceil(high / tile)
    tiles = min(int(2 * np.ceil((last - first).max() / 2)), config.cells // TILE)
    origin = np.round((first + last - tiles) / 2) * tile
    return count, cut, cropped(state.grid, config.resolution, origin, tiles * TILE)


def _ends(frame: Frame, pose: np.ndarray) -> np.ndarray:
    """Where some of a scan's beams end, about (n, 2) [m]."""
    some = np.flatnonzero(frame.scan.valid)[::_EVERY_BEAM]
    bearing = pose[2] + frame.scan.angle_min + some * frame.scan.angle_increment
    return pose[:2] + frame.scan.ranges[some, None] * np.stack([np.cos(bearing), np.sin(bearing)], -1)


def cropped(grid: Grid, resolution: float, origin: np.ndarray, cells: int) -> Grid:
    """The part of a window that another one sees, whose corner is at origin (2,) [m], a whole number of tiles away."""
    shift = np.round((np.asarray(grid.origin, float) - origin) / resolution).astype(int)

    def part(layer: Float[Array, "_ _"], level: int) -> Float[Array, "_ _"]:
        old, new = np.asarray(layer), np.zeros((cells >> level, cells >> level), np.float32)
        n, (col, row) = len(old), shift >> level
        rows, cols = (slice(max(s, 0), min(s + n, len(new))) for s in (row, col))
        if rows.start < rows.stop and cols.start < cols.stop:
            new[rows, cols] = old[rows.start - row : rows.stop - row, cols.start - col : cols.stop - col]
        return jnp.asarray(new)

    levels = tuple(part(layer, k) for k, layer in enumerate(grid.levels))
    return Grid(levels, jnp.asarray(origin, jnp.float32), part(grid.epochs, EPOCH_LEVEL))


def stacked(frames: Sequence[StampedFrame]) -> Frame:
    """Frames on one leading axis, on the device."""
    return jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *[frame.frame for frame in frames])


@partial(jax.jit, static_argnums=0)
def losses(config: Config, params: Params, state: State, frames: Frame) -> Losses:
    """Every frame's losses from a state on; differentiable in forward mode.

    What is differentiated is the step with its decisions held: cells that are hit, gates, the choice between search and
    match. Where a decision changes the function jumps; the derivative is that between two jumps.
    """
    return lax.scan(partial(_step, config, params), state, frames)[1]


def _mean(config: Config, params: Params, before: Params, state: State, frames: Frame) -> Float[Array, ""]:
    told = losses(config, params, rescaled(params, before, state), frames)
    return (jnp.sum(told.ranges) + jnp.sum(told.matches)) / (jnp.sum(told.counts) + jnp.sum(frames.has_scan))


@partial(jax.custom_vjp, nondiff_argnums=(0,))
@partial(jax.jit, static_argnums=0)
def _loss(config: Config, params: Params, before: Params, state: State, frames: Frame) -> Float[Array, ""]:
    return _mean(config, params, before, state, frames)


@partial(jax.jit, static_argnums=0)
def _loss_and_gradient(config: Config, params: Params, *rest: Any) -> tuple[Float[Array, ""], Params]:
    """All derivatives at once in forward mode: parameters are few, and the way back over a recording would have to
    keep or draw again its map at each frame."""
    flat, unravel = ravel_pytree(params)

    def loss(flat: Float[Array, "p"]) -> tuple[Float[Array, ""], Float[Array, ""]]:
        value = _mean(config, unravel(flat), *rest)
        return value, value

    gradient, value = jax.jacfwd(loss, has_aux=True)(flat)
    return value, unravel(gradient)


_loss.defvjp(_loss_and_gradient, lambda _, gradient, by: (jax.tree.map(lambda g: by * g, gradient), None, None, None))


def rescaled(params: Params, before: Params, state: State) -> State:
    """The state for other parameters than those it was reached with: how much a pair scatters is told in sigma_n."""
    log = state.scatter.log + jnp.log(before.sigma_n / params.sigma_n)
    return state._replace(scatter=state.scatter._replace(log=log))


def _step(config: Config, params: Params, state: State, frame: Frame) -> tuple[State, Losses]:
    # cells are drawn by whole numbers and do not depend on any parameter but by jumps: there is no derivative to carry
    levels = tuple(lax.stop_gradient(level) for level in state.grid.levels)
    state, told = step(config, params, state._replace(grid=state.grid._replace(levels=levels)), frame)
    used = jnp.sum(told.weight > 0).astype(jnp.float32)
    assert told.match_log_likelihood is not None  # only the host goes without
    return state, Losses(-told.log_likelihood, -told.match_log_likelihood, used, told.pose)
