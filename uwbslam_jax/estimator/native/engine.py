"""The step of this wing between Python and its loops: the buffers, and what of them the host sees."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import numpy as np
from numpy.lib.stride_tricks import as_strided

from uwbslam_jax.estimator.native import records
from uwbslam_jax.estimator.native.grid import polar_tables
from uwbslam_jax.estimator.native.records import Leaves, fields
from uwbslam_jax.estimator.native.step import Buffers, step
from uwbslam_jax.estimator.packing import params_like
from uwbslam_jax.estimator.state import Estimate, State, init
from uwbslam_jax.measurements import Frame, empty_frame
from uwbslam_jax.settings import Config, Params


class NativeStep:
    """The state of a run in buffers, and the step over it.

    Attributes:
      config: of the steps, preset "robust".
    """

    def __init__(self, config: Config):
        self.config = config
        state = jax.eval_shape(partial(init, config))
        shapes = [level.shape for level in (*state.grid.levels, state.grid.epochs)]
        places = np.cumsum([0, *(rows * cols for rows, cols in shapes)]).tolist()
        b = self._buffers = _buffers(config, places[-1])
        self._maps = [b.cells[i:j].reshape(s) for i, j, s in zip(places, places[1:], shapes, strict=False)]
        self._params = Leaves(params_like(config), fields(b.params) | {"bias": b.bias, "height": b.height})
        parts = {f"scatter_{name}": part for name, part in zip(("log", "last", "heard"), b.scatter, strict=True)}
        parts |= {"belief_mean": b.mean, "belief_cov": b.cov, "active": b.nodes[0], "moving": b.nodes[1]}
        levels = {f"grid_levels[{k}]": level for k, level in enumerate(self._maps[:-1])}
        self._state = Leaves(state, fields(b.state) | parts | levels | {"grid_epochs": self._maps[-1]})
        ranges = dict(zip(("range", "age", "power_gap", "valid"), b.ranges, strict=True))
        ranges |= {"i": b.slots[0], "j": b.slots[1]}
        beams = {"scan_ranges": b.beams[0], "scan_valid": b.beams[1]}
        frame = empty_frame(config.max_beams, config.max_ranges)
        self._frame = Leaves(frame, fields(b.frame) | beams | {f"ranges_{name}": row for name, row in ranges.items()})
        k, (down, right) = config.nodes, b.cov.strides
        self._told = list(fields(b.told).items())
        self._places = b.mean[: 2 * k].reshape(k, 2)
        self._place_covs = as_strided(b.cov, (k, 2, 2), (2 * (down + right), down, right), writeable=False)
        self._of: Params | None = None
        self._view: State | None = None

    @property
    def state(self) -> State:
        """The state on the host. Belief, scatter and map are the buffers themselves: the next step changes them."""
        view = self._view if self._view is not None else self._state.view()
        self._view = view
        return view

    @state.setter
    def state(self, state: State) -> None:
        if state is not self._view:
            self._state.write(jax.device_get(state))
            self._view = None

    def step(self, params: Params, frame: Frame) -> Estimate:
        """One frame into the state; its estimate."""
        if params is not self._of:
            self._params.write(jax.device_get(params))
            self._of = params
        self._frame.write(frame)
        step(self._buffers)
        self._view = None
        return self._estimate()

    def _estimate(self) -> Estimate:
        b = self._buffers
        told: Any = {name: field.copy() for name, field in self._told}
        told |= {"beacons": self._places.copy(), "beacon_covs": self._place_covs.copy()}
        told |= zip(("active", "moving"), b.nodes > 0, strict=True)
        told |= zip(("innovation", "normalised", "weight"), b.ranges_told.copy(), strict=True)
        return Estimate(match_log_likelihood=None, **told)


def _buffers(config: Config, cells: int) -> Buffers:
    """All zero but for what the configuration tells. cells: of all levels and the epochs."""
    k, beams, n = config.nodes, config.max_beams, 4 * config.nodes + 5
    zeros = partial(np.zeros, dtype=np.float32)
    of_config = np.zeros(1, records.CONFIG)
    for name in records.CONFIG.names or ():
        of_config[name] = getattr(config, name)
    return Buffers(
        config=of_config,
        params=np.zeros(1, records.PARAMS),
        bias=np.zeros(k),
        height=np.zeros(k),
        state=np.zeros(1, records.STATE),
        mean=zeros(n),
        cov=zeros((n, n)),
        nodes=zeros((2, k)),
        scatter=zeros((3, k, k)),
        frame=np.zeros(1, records.FRAME),
        beams=zeros((2, beams)),
        slots=zeros((2, config.max_ranges)),
        ranges=zeros((4, config.max_ranges)),
        told=np.zeros(1, records.TOLD),
        ranges_told=zeros((3, config.max_ranges)),
        cells=zeros(cells),
        tables=polar_tables(config.cells, config.levels, config.resolution),
        sweep=zeros((4, beams)),
        surface=zeros((3, beams)),
        before=zeros((3, beams)),
        after=zeros((3, beams)),
        on_wall=zeros(beams),
        ends=zeros((10, beams)),
        cell=np.zeros(beams, np.int32),
    )
