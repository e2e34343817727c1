"""The command `tune`: its options, the fit from the recordings to the last file, and what it prints."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro
from tqdm import tqdm
from tyro.conf import Positional, arg

from uwbslam_jax import api
from uwbslam_jax.cli import tune_pictures
from uwbslam_jax.files import settings_file
from uwbslam_jax.settings import Settings


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
    options.out.mkdir(parents=True, exist_ok=True)  # before the long work, not after it
    with tqdm(bar_format="{desc} [{elapsed}]", leave=False, disable=True if options.quiet else None) as bar:
        progress = bar.set_description_str
        tuned = api.tune(options.logs, options.params, settings, objective=options.objective, progress=progress)
        pictures = []
        if tuned.objective is not None and tuned.noises is not None:
            progress("pictures")
            pictures = tune_pictures.draw(tuned.objective, tuned.noises, options.out)
    settings_file.save_settings(settings_file.check(tuned.settings), options.out / "tuned.toml")
    (options.out / "tuning.md").write_text(tuned.table(), encoding="utf-8")
    (options.out / "tuning.json").write_text(tuned.json(), encoding="utf-8")
    for cut in tuned.cuts():
        print(f"warning: {cut}", file=sys.stderr)
    print(tuned.table())
    print(f"settings: {options.out / 'tuned.toml'}")
    left_out = "left out" + ("" if tuned.noises is None else ", without matplotlib")
    print(f"pictures: {', '.join(map(str, pictures)) or left_out}")
