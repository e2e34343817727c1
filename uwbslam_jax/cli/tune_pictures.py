"""Pictures of a fit: loss over its steps, the profile of each parameter, a slice through two of them.

They need matplotlib (the extra `plot`); without it there are none.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from uwbslam_jax.tuning import NoiseFit, Objective

_POINTS, _SIDE = 9, 7
"""Points of a profile and along a side of the slice [points]: each is a rollout of all recordings."""
_SPREADS = 3.0
"""A profile reaches so many standard deviations to either side [sigma], within which nearly all of it lies,"""
_REACH = (0.05, 1.0)
"""at least and at most so far [in the logarithm]: a sigma of the Hessian may be tiny, or infinite."""
_SLICED = ("gamma", "sigma_n")
"""The slice is through these where both are tuned, as they trade off [names]; else through the first two observed."""
_WORST = 60.0
"""Log-likelihood below the best beyond which a slice has one colour [nats], or its valley would have one."""


def draw(objective: Objective, tuned: NoiseFit, folder: Path) -> list[Path]:
    """Writes the pictures into a folder; none without matplotlib."""
    try:
        import matplotlib
    except ImportError:
        return []
    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    observed = [k for k, how in enumerate(tuned.told) if how != "not observed"]
    paths = [_save(_history(plt, tuned), folder / "loss.png")]
    if observed:
        paths.append(_save(_profiles(plt, objective, tuned, observed), folder / "profile.png"))
    if len(observed) > 1:
        paths.append(_save(_slice(plt, objective, tuned, observed), folder / "slice.png"))
    plt.close("all")
    return paths


def _save(figure: Any, path: Path) -> Path:
    figure.savefig(path, dpi=110, bbox_inches="tight")
    return path


def _history(plt: Any, tuned: NoiseFit) -> Any:
    figure, axes = plt.subplots(figsize=(6, 4))
    fitted, held = np.array(tuned.history).reshape(-1, 2).T
    steps = np.arange(len(fitted))
    axes.plot(steps, fitted, "o-", color="tab:blue")
    axes.set_xlabel("step")
    axes.set_ylabel("loss of the fitted part, a measurement", color="tab:blue")
    other = axes.twinx()
    other.plot(steps, held, "s--", color="tab:orange")
    other.set_ylabel("negative log-likelihood of the held-out part, a frame", color="tab:orange")
    return figure


def profile(objective: Objective, tuned: NoiseFit, k: int) -> tuple[np.ndarray, np.ndarray]:
    """Values (n,) of a parameter and by how much each is less likely than the best of them (n,). The others follow as
    the Hessian says that they would."""
    logs = np.log(tuned.values)
    spread = _reach(tuned, k)
    free = np.array([how == "" for how in tuned.told])
    free[k] = False
    follow = np.zeros(len(logs))
    at = np.flatnonzero(free)
    if len(at):
        follow[at] = -np.linalg.lstsq(tuned.hessian[np.ix_(at, at)], tuned.hessian[at, k], rcond=None)[0]
    follow[k] = 1.0
    steps = np.linspace(-spread, spread, _POINTS)
    losses = np.array([objective.value(logs + step * follow) for step in steps]) * objective.weight
    return np.exp(logs[k] + steps), losses - losses.min()


def _reach(tuned: NoiseFit, k: int) -> float:
    spread = _SPREADS * float(tuned.sigma[k]) if np.isfinite(tuned.sigma[k]) else _REACH[1]
    return float(np.clip(spread, *_REACH))


def _profiles(plt: Any, objective: Objective, tuned: NoiseFit, observed: list[int]) -> Any:
    figure, every = plt.subplots(1, len(observed), figsize=(3.4 * len(observed), 3.2), squeeze=False)
    for axes, k in zip(every[0], observed, strict=True):
        values, worse = profile(objective, tuned, k)
        axes.plot(values, worse, "o-", label="profile")
        if np.isfinite(tuned.sigma[k]):
            line = 0.5 * (np.log(values / tuned.values[k]) / tuned.sigma[k]) ** 2
            axes.plot(values, line, ":", color="gray", label="by the Hessian")
        axes.axvline(tuned.values[k], color="tab:red", lw=1)
        axes.set(xlabel=tuned.names[k], ylabel="log-likelihood below the best")
        axes.legend()
    figure.tight_layout()
    return figure


def _slice(plt: Any, objective: Objective, tuned: NoiseFit, observed: list[int]) -> Any:
    first, second = observed[:2]
    if all(name in tuned.names for name in _SLICED):
        first, second = (tuned.names.index(name) for name in _SLICED)
    logs = np.log(tuned.values)
    axis = [np.linspace(-1, 1, _SIDE) * 2 * _reach(tuned, k) for k in (first, second)]
    losses = np.zeros((_SIDE, _SIDE))
    for row, b in enumerate(axis[1]):
        for column, a in enumerate(axis[0]):
            tried = logs.copy()
            tried[first], tried[second] = logs[first] + a, logs[second] + b
            losses[row, column] = objective.value(tried) * objective.weight
    figure, axes = plt.subplots(figsize=(5, 4))
    x, y = (tuned.values[k] * np.exp(steps) for k, steps in zip((first, second), axis, strict=True))
    filled = axes.contourf(x, y, np.minimum(losses - losses.min(), _WORST), levels=20, cmap="viridis_r")
    axes.plot(tuned.values[first], tuned.values[second], "r+", markersize=12)
    axes.set(xlabel=tuned.names[first], ylabel=tuned.names[second])
    figure.colorbar(filled, ax=axes, label="log-likelihood below the best")
    return figure
