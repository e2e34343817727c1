"""The compiled step: pure, of fixed shape, reads like the paper."""

from uwbslam_jax.estimator import compiled as compiled, ranging as ranging, state_vector as state_vector
from uwbslam_jax.estimator.compiled import CompileClock as CompileClock
from uwbslam_jax.estimator.engines import Engine as Engine, begun as begun, chosen as chosen
from uwbslam_jax.estimator.host_view import (
    Changes as Changes,
    HostView as HostView,
    Moved as Moved,
    SlotEvent as SlotEvent,
)
from uwbslam_jax.estimator.published_frame import (
    anchored as anchored,
    frame_motion as frame_motion,
    published as published,
)
from uwbslam_jax.estimator.state import (
    Estimate as Estimate,
    State as State,
    init as init,
    map_pose as map_pose,
    sight as sight,
    widened as widened,
)
from uwbslam_jax.estimator.step import step as step
from uwbslam_jax.settings import (
    Config as Config,
    Params as Params,
    make_config as make_config,
    make_params as make_params,
)
