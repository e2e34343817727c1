"""Where the beacons stand before anything is known."""

from uwbslam_jax.startup import static_geometry as static_geometry
from uwbslam_jax.startup.adopt import adopt as adopt
from uwbslam_jax.startup.keyframe_buffer import is_blind as is_blind, is_far as is_far
from uwbslam_jax.startup.placement import diagonal as diagonal, loose_sigma as loose_sigma, step_sigma as step_sigma
from uwbslam_jax.startup.start_up import StartUp as StartUp
from uwbslam_jax.startup.static_geometry import Links as Links, Relative as Relative
