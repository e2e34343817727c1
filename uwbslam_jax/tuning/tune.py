"""What recordings tell of the parameters: geometry from whole runs, then noises along rollouts; and that as a table."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from uwbslam_jax.errors import ConfigError, RolloutError
from uwbslam_jax.evaluation import Truth
from uwbslam_jax.measurements import Message
from uwbslam_jax.settings import Settings
from uwbslam_jax.tuning import calibration, parameters
from uwbslam_jax.tuning.calibration import Calibration
from uwbslam_jax.tuning.fit import NoiseFit, fit
from uwbslam_jax.tuning.likelihood import Goal, Objective, Piece, Score, piece
from uwbslam_jax.tuning.rollout import prepare

_BLOCK = 10
"""Frames whose log-likelihoods are averaged before their spread is taken: neighbours are alike."""


class Log(NamedTuple):
    """A recording: what it is called, its messages, its settings with what it tells of its robot, and its ground truth
    where it has some."""

    name: str
    messages: Sequence[Message]
    settings: Settings
    truth: Truth | None


@dataclass(frozen=True)
class Tuned:
    """What was found.

    Attributes:
      settings: those given, with what was found and what all recordings tell of their robot alike.
      calibration: range biases and mounting, None where none was asked for; noises: likewise.
      objective: what the noises were fitted to.
    """

    settings: Settings
    calibration: Calibration | None
    noises: NoiseFit | None
    objective: Objective | None

    @property
    def values(self) -> dict[str, float]:
        """Name -> what was found, of every parameter."""
        parts = [part for part in (self.calibration, self.noises) if part is not None]
        return {name: float(value) for part in parts for name, value in zip(part.names, part.values, strict=True)}

    def cuts(self) -> list[str]:
        """Why rollouts end before their recordings do."""
        pieces = [] if self.objective is None else self.objective.pieces
        told = [(k, p.rollout.cut) for k, p in enumerate(pieces, 1) if p.rollout.cut]
        return [f"recording {k}: {cut}; what follows is left out" for k, cut in told]

    def table(self) -> str:
        """Parameters before and after with their 95 % intervals, and the held-out part, in Markdown."""
        return table(self.calibration, self.noises)

    def json(self) -> str:
        """All that was found, as JSON."""
        return _json(self.calibration, self.noises)


def check_request(names: tuple[str, ...], settings: Settings) -> tuple[str, ...]:
    """Names of the parameters, the preset's defaults where there are none. Raises ConfigError, see `tune`."""
    if settings.filter.lidar_only:
        raise ConfigError("filter.lidar_only = true: tuning needs ranges")
    return parameters.check(names or parameters.DEFAULTS[settings.filter.preset])


def tune(
    logs: Sequence[Log], names: tuple[str, ...], settings: Settings, goal: Goal, progress: Callable[[str], object]
) -> Tuned:
    """Geometry from all recordings, then noises with that geometry; each with its own robot.

    Args:
      names: of the parameters, the preset's defaults where there are none. goal: what noises are tuned for.

    Raises:
      ConfigError: an unknown name, settings without ranges, or the LiDAR's place asked of recordings that tell
        different ones. RolloutError: a recording that tells nothing of them.
    """
    names = check_request(names, settings)
    if goal == "truth" and (without := [log.name for log in logs if log.truth is None]):
        raise RolloutError(f"{without[0]}: has no ground truth of the robot")
    geometry = [name for name in names if not parameters.is_noise(name)]
    noises = tuple(name for name in names if parameters.is_noise(name))
    calibrated = found = objective = None
    robots = [log.settings.robot for log in logs]
    if all(robot == robots[0] for robot in robots):
        settings = replace(settings, robot=robots[0])
    elif asked := [name for name in geometry if name in parameters.MOUNTING]:
        raise ConfigError(f"{asked[0]}: the recordings tell of different robots; tune it of each by itself")
    if geometry:
        parts = [_told(log, "mounting and biases", progress, calibration.calibrate, geometry) for log in logs]
        calibrated = calibration.together(parts)
        values = dict(zip(geometry, calibrated.values.tolist(), strict=True))
        settings = parameters.configured(settings, values)
        logs = [log._replace(settings=parameters.configured(log.settings, values)) for log in logs]
    if noises:
        rollouts = [_told(log, "start-up", progress, prepare) for log in logs]
        pieces: list[Piece] = [piece(one, log.truth) for one, log in zip(rollouts, logs, strict=True)]
        start = np.log([max(parameters.value(settings, name), 1e-9) for name in noises])
        progress("compiling")
        objective = Objective(pieces, noises, start, goal)
        found = fit(objective, progress)
        settings = parameters.configured(settings, dict(zip(noises, found.values.tolist(), strict=True)))
    return Tuned(settings, calibrated, found, objective)


def _told(log: Log, what: str, progress: Callable[[str], object], function: Callable, *arguments: Any) -> Any:
    """A function of one recording's messages and settings; what it cannot use is told with the recording's name."""
    progress(f"{log.name}: {what}")
    try:
        return function(log.messages, log.settings, *arguments)
    except RolloutError as error:
        raise RolloutError(f"{log.name}: {error}") from None


def gain(before: Score, after: Score) -> tuple[float, float]:
    """By how much a frame of the held-out part is more likely, and the standard error of that."""
    more = after.frames - before.frames
    blocks = [block.mean() for block in np.array_split(more, max(len(more) // _BLOCK, 1))]
    return float(np.mean(more)), float(np.std(blocks, ddof=1) / math.sqrt(len(blocks))) if len(blocks) > 1 else math.nan


def table(calibrated: Calibration | None, tuned: NoiseFit | None) -> str:
    """Parameters before and after with their 95 % intervals, and the held-out part, in Markdown."""
    lines = ["| parameter | unit | before | tuned | 95 % | told |", "| --- | --- | ---: | ---: | --- | --- |"]
    if calibrated is not None:
        for k, name in enumerate(calibrated.names):
            value, spread = float(calibrated.values[k]), 1.96 * float(calibrated.sigma[k])
            interval = "-" if calibrated.told[k] else f"{value - spread:.4f} to {value + spread:.4f}"
            told = calibrated.told[k] or "observed"
            lines.append(_row(name, f"{calibrated.start[k]:.4f}", f"{value:.4f}", interval, told))
    if tuned is None:
        return "\n".join(lines) + "\n"
    for k, name in enumerate(tuned.names):
        low, high = tuned.interval(k)
        interval = "-" if tuned.told[k] else f"{low:.4g} to {high:.4g}"
        told = (tuned.told[k] or "observed") + (", the likelihood jumps nearby" if tuned.jumps[k] else "")
        lines.append(_row(name, f"{tuned.start[k]:.4g}", f"{tuned.values[k]:.4g}", interval, told))
    before, after = tuned.before, tuned.after
    lines += ["", "| held-out part | before | tuned |", "| --- | ---: | ---: |"]
    lines.append(f"| log-likelihood a range | {before.per_range:.3f} | {after.per_range:.3f} |")
    lines.append(f"| log-likelihood a match | {before.per_match:.3f} | {after.per_match:.3f} |")
    if math.isfinite(after.track_rms):
        lines.append(f"| track, RMS after one rigid motion [m] | {before.track_rms:.4f} | {after.track_rms:.4f} |")
    more, error = gain(before, after)
    lines += ["", f"More likely a held-out frame by {more:.3f} +- {error:.3f} (standard error). Fit: {tuned.stopped}."]
    return "\n".join(lines) + "\n"


def _row(name: str, *cells: str) -> str:
    return f"| {' | '.join([name, parameters.unit(name) or '-', *cells])} |"


def _json(calibrated: Calibration | None, tuned: NoiseFit | None) -> str:
    found: dict[str, Any] = {}
    for key, part in (("calibration", calibrated), ("tuning", tuned)):
        if part is not None:
            found[key] = _plain(asdict(part))
    if tuned is not None:
        for key, score in (("before", tuned.before), ("after", tuned.after)):
            found["tuning"][key] = _plain({k: v for k, v in score._asdict().items() if k != "frames"})
    return json.dumps(found, indent=1) + "\n"


def _plain(value: Any) -> Any:
    """The same for JSON: lists for arrays, null for what is not finite."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist())
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
