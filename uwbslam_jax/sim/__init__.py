"""Worlds, devices and their faults, for recordings with ground truth."""

from uwbslam_jax.sim.catalogue import SCENARIOS as SCENARIOS, make_scenario as make_scenario, spread as spread
from uwbslam_jax.sim.rays import cast as cast, strike as strike
from uwbslam_jax.sim.scenario import (
    INF as INF,
    Beacon as Beacon,
    Interval as Interval,
    Lidar as Lidar,
    Scenario as Scenario,
    Uwb as Uwb,
    Wheels as Wheels,
    settings_overrides as settings_overrides,
    stream as stream,
)
from uwbslam_jax.sim.simulate import (
    START_NS as START_NS,
    beacon_positions as beacon_positions,
    scan_ranges as scan_ranges,
    simulate as simulate,
)
