"""The command `tune`: its options, the fit from the recordings to the last file, and what it prints."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro
from tqdm import tqdm
from tyro.conf import Positional, arg

from uwbslam_jax.cli import tune_pictures
from uwbslam_jax.errors import ConfigError, RolloutError
from uwbslam_jax.evaluation import Truth
from uwbslam_jax.files import LogReader, settings_file
from uwbslam_jax.measurements import Message, TruthMessage
from uwbslam_jax.settings import Settings
from uwbslam_jax.tuning import Calibration, Objective, Piece, Score, Tuned, calibration, fit, parameters, piece, prepare

_BLOCK = 10
"""Frames whose log-likelihoods are averaged before their spread is taken: neighbours are alike."""


@dataclass
class TuneOptions:
    """Find noise parameters, range biases and the LiDAR's mounting from recordings; writes settings for `run`."""

    logs: Positional[tuple[Path, ...]]
    """MCAP recordings, or ROS 2 bag folders with one each."""
    out: Annotated[Path, arg(aliases=["-o"])]
    """Folder for tuned.toml, the table and the pictures; it is created."""
    params: tuple[str, ...] = ()
    """What to tune: sigma_n, sigma_w, sigma_w_yaw, sigma_w_beacon, sigma_l, sigma_map, gamma ..., bias.ID, lidar.x,
    lidar.y, lidar.yaw. By default sigma_n and sigma_l."""
    objective: Literal["likelihood", "truth"] = "likelihood"
    """What noises are tuned for: the likelihood of ranges and matches, or the track's error where there is truth."""
    config: Path | None = None
    """Settings in TOML to start from; flags go before it."""
    quiet: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """No progress."""
    settings: Annotated[Settings, arg(name="")] = field(default_factory=Settings)


def tune(options: TuneOptions) -> None:
    """The command `tune`."""
    settings = settings_file.check(options.settings)
    names = parameters.check(options.params or parameters.DEFAULTS[settings.filter.preset])
    if settings.filter.lidar_only:
        raise ConfigError("filter.lidar_only = true: tuning needs ranges")
    options.out.mkdir(parents=True, exist_ok=True)  # before the long work, not after it
    with tqdm(bar_format="{desc} [{elapsed}]", leave=False, disable=True if options.quiet else None) as bar:
        logs = [read(path, settings) for path in options.logs]
        if options.objective == "truth" and (
            without := [p for p, log in zip(options.logs, logs, strict=True) if not log[1]]
        ):
            raise RolloutError(f"{without[0]}: has no ground truth of the robot")
        geometry = [name for name in names if not parameters.is_noise(name)]
        noises = tuple(name for name in names if parameters.is_noise(name))
        calibrated = calibrate(options.logs, logs, settings, geometry, bar.set_description_str)
        found = settings
        if calibrated is not None:
            found = parameters.configured(found, dict(zip(geometry, calibrated.values.tolist(), strict=True)))
        tuned = objective = None
        if noises:
            objective = _objective(options, logs, found, noises, bar.set_description_str)
            tuned = fit.fit(objective, bar.set_description_str)
            found = parameters.configured(found, dict(zip(noises, tuned.values.tolist(), strict=True)))
            bar.set_description_str("pictures")
            pictures = tune_pictures.draw(objective, tuned, options.out)
        else:
            pictures = []
    settings_file.check(found)
    (options.out / "tuned.toml").write_text(settings_file.differences(found), encoding="utf-8")
    text = table(calibrated, tuned)
    (options.out / "tuning.md").write_text(text, encoding="utf-8")
    (options.out / "tuning.json").write_text(_json(calibrated, tuned), encoding="utf-8")
    for told in [] if objective is None else cuts(objective.pieces):
        print(f"warning: {told}", file=sys.stderr)
    print(text)
    print(f"settings: {options.out / 'tuned.toml'}")
    print(
        "pictures: " + (", ".join(map(str, pictures)) or "left out" + ("" if tuned is None else ", without matplotlib"))
    )


def read(path: Path, settings: Settings) -> tuple[list[Message], Truth | None]:
    """The messages of a recording, and its ground truth.

    Raises:
      LogError: it cannot be read.
    """
    topics = {"scan_topic": settings.lidar.topic, "uwb_topic": settings.uwb.topic}
    odom = settings.odom.topic if settings.odom.use else None
    reader = LogReader(path, **topics, odom_topic=odom, robot_id=settings.robot.id, max_range=settings.uwb.max_range)
    messages = list(reader)
    truths = [m for m in messages if isinstance(m, TruthMessage)]
    return messages, Truth.from_messages(truths) if any(m.node is None for m in truths) else None


def calibrate(
    paths: Sequence[Path], logs: Sequence[tuple[list[Message], Truth | None]], settings: Settings, names, progress
) -> Calibration | None:
    """Geometry from all recordings: each by itself, averaged by what each is sure of. None where nothing is asked."""
    if not names:
        return None
    found = []
    for path, (messages, _) in zip(paths, logs, strict=True):
        progress(f"{path.name}: mounting and biases")
        try:
            found.append(calibration.calibrate(messages, settings, names))
        except RolloutError as error:
            raise RolloutError(f"{path}: {error}") from None
    return calibration.together(found)


def _objective(options: TuneOptions, logs, settings: Settings, noises: tuple[str, ...], progress) -> Objective:
    pieces: list[Piece] = []
    for path, (messages, truth) in zip(options.logs, logs, strict=True):
        progress(f"{path.name}: start-up")
        try:
            pieces.append(piece(prepare(messages, settings), truth))
        except RolloutError as error:
            raise RolloutError(f"{path}: {error}") from None
    start = np.log([max(parameters.value(settings, name), 1e-9) for name in noises])
    progress("compiling")
    return Objective(pieces, noises, start, options.objective)


def cuts(pieces: Sequence[Piece]) -> list[str]:
    """Why rollouts end before their recordings do."""
    return [
        f"recording {k + 1}: {p.rollout.cut}; what follows is left out" for k, p in enumerate(pieces) if p.rollout.cut
    ]


def gain(before: Score, after: Score) -> tuple[float, float]:
    """By how much a frame of the held-out part is more likely, and the standard error of that."""
    more = after.frames - before.frames
    blocks = [block.mean() for block in np.array_split(more, max(len(more) // _BLOCK, 1))]
    return float(np.mean(more)), float(np.std(blocks, ddof=1) / math.sqrt(len(blocks))) if len(blocks) > 1 else math.nan


def table(calibrated: Calibration | None, tuned: Tuned | None) -> str:
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


def _json(calibrated: Calibration | None, tuned: Tuned | None) -> str:
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
