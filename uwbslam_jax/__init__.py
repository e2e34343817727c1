"""Range-aided 2D SLAM: LiDAR and UWB ranges in, track, beacons and map out.

    import uwbslam_jax as us
    result = us.run("recording.mcap")
    result.save("out")

Names are loaded when they are first used: drivers import `uwbslam_jax.measurements` without JAX.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from uwbslam_jax import process

__version__ = "0.1.0"

process.prepare()  # before JAX and numpy are imported, which read their settings once

if TYPE_CHECKING:
    from uwbslam_jax import estimator as estimator
    from uwbslam_jax.api import (
        Result as Result,
        Slam as Slam,
        evaluate as evaluate,
        inspect as inspect,
        read as read,
        rollout as rollout,
        run as run,
        tune as tune,
    )
    from uwbslam_jax.errors import UwbslamError as UwbslamError
    from uwbslam_jax.evaluation import Truth as Truth
    from uwbslam_jax.files import load_settings as load_settings, save_settings as save_settings
    from uwbslam_jax.measurements import (
        OdometryMessage as OdometryMessage,
        RangeMessage as RangeMessage,
        ScanMessage as ScanMessage,
        TruthMessage as TruthMessage,
    )
    from uwbslam_jax.result import BeaconEstimate as BeaconEstimate, MapImage as MapImage
    from uwbslam_jax.session import Update as Update
    from uwbslam_jax.settings import (
        FilterSettings as FilterSettings,
        LidarSettings as LidarSettings,
        MapSettings as MapSettings,
        OdomSettings as OdomSettings,
        RobotSettings as RobotSettings,
        Settings as Settings,
        UwbSettings as UwbSettings,
    )
    from uwbslam_jax.sim import SCENARIOS as SCENARIOS
    from uwbslam_jax.simulation import Simulation as Simulation, simulate as simulate
    from uwbslam_jax.tuning import Rollout as Rollout, Tuned as Tuned

_HOME = {
    "api": "Result Slam evaluate inspect read rollout run tune",
    "errors": "UwbslamError",
    "evaluation": "Truth",
    "files": "load_settings save_settings",
    "measurements": "OdometryMessage RangeMessage ScanMessage TruthMessage",
    "result": "BeaconEstimate MapImage",
    "session": "Update",
    "settings": "FilterSettings LidarSettings MapSettings OdomSettings RobotSettings Settings UwbSettings",
    "sim": "SCENARIOS",
    "simulation": "Simulation simulate",
    "tuning": "Rollout Tuned",
}
"""Module or wing -> the names that it gives to the front door; a test holds it to the imports above."""
_PLACE = {name: f"uwbslam_jax.{module}" for module, names in _HOME.items() for name in names.split()}
"""Name -> full name of its module."""

__all__ = ["__version__", "estimator", *_PLACE]


def __getattr__(name: str) -> Any:
    if name == "estimator":
        return import_module("uwbslam_jax.estimator")
    if name not in _PLACE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(_PLACE[name]), name)
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
