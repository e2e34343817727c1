"""Both engines from the same state, frame by frame: how far they differ."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np

from uwbslam_jax.estimator import Estimate, State, compiled
from uwbslam_jax.estimator.native.engine import NativeStep
from uwbslam_jax.measurements import Frame
from uwbslam_jax.settings import Config, Params

POSE, COVARIANCE, MEDIAN = 5e-4, 0.05, 1e-5
"""How far the engines may be apart: pose [m, rad], covariance as a share of its diagonal, and both in the median."""
OF_SIGMA = 2e-3
"""And so many standard deviations: along a corridor without ends the twin's own rounding is larger."""
RARE, FAR_POSE, FAR_COVARIANCE = 0.01, 5e-3, 0.2
"""In so few frames they may be that far apart: where an alignment swings around its tolerance to its last step, or a
beam that tells much ends on the edge of a cell, rounding decides what is next [share, m or rad, share]."""
CELLS = 40
"""Cells of the map that a scan drawn at one place may draw otherwise, of a million: those beside a beam's edge."""
_FLAGS = ("active", "moving", "poor", "searched", "drawn")
_COUNTS = ("scans_drawn", "active", "moving", "frame_slots")
_jax_step = compiled.step


def _apart(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.abs(np.asarray(a, float) - np.asarray(b, float)).max())


@dataclass
class Differences:
    """Of the frames so far.

    Attributes:
      pose: of pose, matched pose and beacons [m, rad]. beyond: the same less OF_SIGMA.
      variance: of the covariance, as a share of its diagonal. cells: drawn otherwise at the same pose.
      decisions: where one was another, in words. searched, drawn, poor: how many of the frames were.
    """

    pose: list[float] = field(default_factory=list)
    beyond: list[float] = field(default_factory=list)
    variance: list[float] = field(default_factory=list)
    cells: list[int] = field(default_factory=list)
    decisions: list[str] = field(default_factory=list)
    searched: int = 0
    drawn: int = 0
    poor: int = 0

    def __str__(self) -> str:
        return (
            f"{len(self.pose)} frames, {self.searched} searched, {self.drawn} drawn, {self.poor} poor; pose median "
            f"{np.median(self.pose):.1e} worst {max(self.pose):.1e}; covariance median {np.median(self.variance):.1e} "
            f"worst {max(self.variance):.1e}; cells worst {max(self.cells)}; {len(self.decisions)} decisions "
            f"{self.decisions[:3]}"
        )

    def check(self) -> None:
        """Raises AssertionError where they are too far apart."""
        beyond, variance = np.array(self.beyond), np.array(self.variance)
        assert not self.decisions, self
        assert np.mean((beyond > POSE) | (variance > COVARIANCE)) <= RARE, self
        assert beyond.max() < FAR_POSE, self
        assert variance.max() < FAR_COVARIANCE, self
        assert max(self.cells) <= CELLS, self
        assert np.median(self.pose) < MEDIAN, self
        assert np.median(self.variance) < MEDIAN, self


class BothEngines:
    """Steps with the JAX engine, and looks what the native one makes of the same state and frame.

    Attributes:
      found: their differences.
    """

    def __init__(self) -> None:
        self.found = Differences()
        self._native: dict[Config, NativeStep] = {}

    def step(
        self, config: Config, params: Params, state: State, frames: Sequence[Frame]
    ) -> tuple[State, list[Estimate]]:
        """In place of compiled.step; a state is not used up."""
        if config not in self._native:
            self._native[config] = NativeStep(config)
        native, estimates = self._native[config], []
        for frame in frames:
            native.state = jax.tree.map(np.array, state)
            mine = native.step(params, frame)
            state, (theirs,) = _jax_step(config, params, jax.tree.map(jnp.array, state), [frame])
            self._compare(native.state, mine, state, theirs)
            estimates.append(theirs)
        return state, estimates

    def _compare(self, state: State, mine: Estimate, reference: State, theirs: Estimate) -> None:
        f, at = self.found, f"frame {len(self.found.pose)}: "
        f.searched, f.drawn = f.searched + int(theirs.searched), f.drawn + int(theirs.drawn)
        f.poor += int(theirs.poor)
        same = [(name, getattr(mine, name), getattr(theirs, name)) for name in _FLAGS]
        same += [(name, getattr(state, name), getattr(reference, name)) for name in _COUNTS]
        same += [("used", mine.weight > 0, theirs.weight > 0)]
        f.decisions += [f"{at}{name} {a} {b}" for name, a, b in same if not np.array_equal(a, b)]
        learnt = [state.scatter, state.unrest, state.map_spread._replace(apart=np.zeros(()))]
        also = [reference.scatter, reference.unrest, reference.map_spread._replace(apart=np.zeros(()))]
        learnt, also = (
            jax.tree.leaves([learnt, mine.normalised, mine.weight]),
            jax.tree.leaves([also, theirs.normalised, theirs.weight]),
        )
        off = [_apart(a, b) / (1.0 + float(np.abs(b).max())) for a, b in zip(learnt, also, strict=True)]
        f.decisions += [f"{at}learnt otherwise, {max(off):.1e}"] if max(off) > 2e-3 else []
        P, Q = np.asarray(state.belief.cov, float), np.asarray(reference.belief.cov, float)
        std = np.sqrt(np.diagonal(Q))
        sigma = float(np.sqrt(np.diagonal(theirs.pose_cov)).max())
        apart = max(_apart(getattr(mine, name), getattr(theirs, name)) for name in ("pose", "matched_pose", "beacons"))
        f.pose.append(apart)
        f.beyond.append(apart - OF_SIGMA * sigma)
        f.variance.append(_apart(P / np.outer(std, std), Q / np.outer(std, std)))
        if apart < POSE:
            maps = zip(jax.tree.leaves(state.grid), jax.tree.leaves(reference.grid), strict=True)
            f.cells.append(sum(int((np.abs(np.asarray(a) - np.asarray(b)) > 1e-3).sum()) for a, b in maps))
