"""What steps a run, behind one interface: the JAX step, or its native twin. A run uses one of them from first to last.

Both make the same decisions and the same poses but for rounding; a run stepped again by the engine that it was stepped
by gives the same bits.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING

from uwbslam_jax.estimator import compiled
from uwbslam_jax.estimator.native import kept
from uwbslam_jax.estimator.state import Estimate, State
from uwbslam_jax.measurements import Frame
from uwbslam_jax.settings import Config, Params, Settings

if TYPE_CHECKING:
    from uwbslam_jax.estimator.native.engine import NativeStep


class JaxEngine:
    """The compiled step. Serves everything.

    Attributes:
      name: as in FilterSettings.engine.
      state: between two steps. What was read of it is void after the next one.
    """

    name = "jax"

    def __init__(self, state: State):
        self.state = state

    def step(self, config: Config, params: Params, frames: Sequence[Frame]) -> list[Estimate]:
        """Steps over at most GROUP frames in order; their estimates, on the host."""
        self.state, estimates = compiled.step(config, params, self.state, frames)
        return estimates


class NativeEngine:
    """Its native twin. Serves preset "robust". name, state, step: as of JaxEngine."""

    name = "native"

    def __init__(self, state: State):
        self._given: State | None = state
        self._step: NativeStep | None = None

    @property
    def state(self) -> State:
        """As of JaxEngine."""
        if self._given is not None:
            return self._given
        assert self._step is not None  # it took the state over
        return self._step.state

    @state.setter
    def state(self, state: State) -> None:
        self._given = state

    def step(self, config: Config, params: Params, frames: Sequence[Frame]) -> list[Estimate]:
        """As of JaxEngine."""
        if self._step is None or self._step.config != config:
            from uwbslam_jax.estimator.native.engine import NativeStep

            self._given, self._step = self.state, NativeStep(config)
        if self._given is not None:
            self._step.state, self._given = self._given, None
        return [self._step.step(params, frame) for frame in frames]


Engine = JaxEngine | NativeEngine
"""What steps a run."""


def chosen(settings: Settings, *, compile_beside: bool = False) -> Settings:
    """The settings with one of the engines in place of "auto": the native one where it serves the preset and is
    compiled. Compiling takes most of a minute, in which the JAX step has long begun.

    Args:
      compile_beside: what is not compiled yet is, for the next run, by a process of its own.
    """
    if settings.filter.engine != "auto":
        return settings
    native = settings.filter.preset == "robust" and kept.is_kept()
    if settings.filter.preset == "robust" and not native and compile_beside:
        kept.compile_beside()
    engine = "native" if native else "jax"
    return dataclasses.replace(settings, filter=dataclasses.replace(settings.filter, engine=engine))


def begun(settings: Settings, state: State) -> Engine:
    """The engine that the settings name, with a state to begin with; "auto" here is the JAX one, see `chosen`."""
    return NativeEngine(state) if settings.filter.engine == "native" else JaxEngine(state)
