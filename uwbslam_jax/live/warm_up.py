"""A short simulated run before a live one, so that all that a run compiles is compiled before the first scan comes."""

from __future__ import annotations

import dataclasses

from uwbslam_jax.estimator import CompileClock
from uwbslam_jax.measurements import Message
from uwbslam_jax.session import Runner
from uwbslam_jax.settings import RobotSettings, Settings, UwbSettings
from uwbslam_jax.sim import INF, START_NS, Lidar, make_scenario, simulate

_RATE = 5.0
"""Scans a second: few, as each is traced through a world [Hz]."""
_REST_S = 3.5
"""The simulated robot rests for four seconds, most of which is left out [s]."""
_AFTER_S = 8.0
"""Goes on for so long after the frame is decided: until biases have been looked for, too [s]."""
_LONGEST_S = 40.0
"""Length of the simulation [s]: the frame is decided well before, and a run that does not decide ends all the same."""


def rehearse(settings: Settings) -> None:
    """Runs a simulated workshop with the sizes of these settings until its frame is decided and a little longer."""
    made = make_scenario("workshop", 0, _LONGEST_S)
    made = dataclasses.replace(made, lidar=Lidar(rate=_RATE, beams=settings.lidar.max_beams, reach=INF))
    sizes = UwbSettings(max_beacons=settings.uwb.max_beacons, sigma_n=settings.uwb.sigma_n)
    settings = dataclasses.replace(settings, robot=RobotSettings(), uwb=sizes)
    with CompileClock() as clock:
        runner = Runner(settings, clock, online=True)
        for message in simulate(made):
            if _seconds(message) > _REST_S:
                runner.add(message)
            decided = runner.session.decided_at
            if settings.filter.lidar_only and _seconds(message) > _REST_S + 3.0:
                break
            if decided is not None and message.stamp - decided > _AFTER_S * 1e9:
                break
        runner.finish()


def _seconds(message: Message) -> float:
    return (message.stamp - START_NS) / 1e9
