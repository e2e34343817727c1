"""Worlds, devices and their faults, for recordings with ground truth."""

from uwbslam_jax.sim.catalogue import SCENARIOS as SCENARIOS
from uwbslam_jax.sim.catalogue import make_scenario as make_scenario
from uwbslam_jax.sim.catalogue import spread as spread
from uwbslam_jax.sim.rays import cast as cast
from uwbslam_jax.sim.scenario import INF as INF
from uwbslam_jax.sim.scenario import Beacon as Beacon
from uwbslam_jax.sim.scenario import Interval as Interval
from uwbslam_jax.sim.scenario import Lidar as Lidar
from uwbslam_jax.sim.scenario import Scenario as Scenario
from uwbslam_jax.sim.scenario import Uwb as Uwb
from uwbslam_jax.sim.scenario import Wheels as Wheels
from uwbslam_jax.sim.scenario import settings_overrides as settings_overrides
from uwbslam_jax.sim.scenario import stream as stream
from uwbslam_jax.sim.simulate import START_NS as START_NS
from uwbslam_jax.sim.simulate import beacon_positions as beacon_positions
from uwbslam_jax.sim.simulate import scan_ranges as scan_ranges
from uwbslam_jax.sim.simulate import simulate as simulate
