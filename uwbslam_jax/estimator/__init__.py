"""The compiled step: pure, of fixed shape, reads like the paper."""

from uwbslam_jax.estimator import compiled as compiled
from uwbslam_jax.estimator import ranging as ranging
from uwbslam_jax.estimator import state_vector as state_vector
from uwbslam_jax.estimator.compiled import CompileClock as CompileClock
from uwbslam_jax.estimator.published_frame import anchored as anchored
from uwbslam_jax.estimator.published_frame import frame_motion as frame_motion
from uwbslam_jax.estimator.published_frame import published as published
from uwbslam_jax.estimator.state import Estimate as Estimate
from uwbslam_jax.estimator.state import State as State
from uwbslam_jax.estimator.state import init as init
from uwbslam_jax.estimator.state import map_pose as map_pose
from uwbslam_jax.estimator.state import sight as sight
from uwbslam_jax.estimator.step import step as step
