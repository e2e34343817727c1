"""Where the beacons stand before anything is known."""

from uwbslam_jax.startup import decide as decide, static_geometry as static_geometry
from uwbslam_jax.startup.adopt import Adopted as Adopted, adopt as adopt
from uwbslam_jax.startup.keyframe_buffer import Buffer as Buffer
from uwbslam_jax.startup.static_geometry import Links as Links, Relative as Relative
