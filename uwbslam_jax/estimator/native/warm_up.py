"""Compiles the step and keeps it, see `kept`."""

from __future__ import annotations

import dataclasses
import os

from uwbslam_jax.estimator.native import kept
from uwbslam_jax.estimator.native.engine import NativeStep
from uwbslam_jax.measurements import empty_frame
from uwbslam_jax.settings import MapSettings, Settings, UwbSettings, make_config, make_params

_NICENESS = 5
"""Priority of the process that does it, below that of the run beside which it does [nice]."""


def warm_up() -> None:
    """Compiles the step, or loads what is kept of it. One program serves every configuration."""
    settings = Settings(uwb=UwbSettings(max_beacons=1), map=MapSettings(size_m=6.4))
    config = dataclasses.replace(make_config(settings), max_beams=2)
    NativeStep(config).step(make_params(settings), empty_frame(2, config.max_ranges))


def main() -> None:
    """The process that kept.compile_beside starts."""
    if hasattr(os, "nice"):
        os.nice(_NICENESS)
    try:
        warm_up()
    finally:
        kept.mark_of_work().unlink(missing_ok=True)
