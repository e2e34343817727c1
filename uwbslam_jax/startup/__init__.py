"""Where the beacons stand before anything is known."""

from uwbslam_jax.startup import static_geometry as static_geometry
from uwbslam_jax.startup.adopt import adopt as adopt
from uwbslam_jax.startup.start_up import StartUp as StartUp
from uwbslam_jax.startup.static_geometry import Links as Links, Relative as Relative
