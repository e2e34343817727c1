"""Mathematics that knows no robot."""

from uwbslam_jax.numerics import gaussian as gaussian
from uwbslam_jax.numerics.freedom import (
    HEIGHT_START_M as HEIGHT_START_M,
    Freedom as Freedom,
    Off as Off,
    fewest_open as fewest_open,
    tells_scale as tells_scale,
)
from uwbslam_jax.numerics.gaussian import (
    Gaussian as Gaussian,
    inverse3 as inverse3,
    symmetric_root as symmetric_root,
    update_projected as update_projected,
)
from uwbslam_jax.numerics.multilateration import (
    Spot as Spot,
    fit as fit,
    locate as locate,
    mirrored as mirrored,
    multilaterate as multilaterate,
    scaled as scaled,
    settle as settle,
)
from uwbslam_jax.numerics.pose_graph import (
    LIDAR as LIDAR,
    MAP as MAP,
    WHEELS as WHEELS,
    Edges as Edges,
    Pairs as Pairs,
    PoseGraph as PoseGraph,
    Stage as Stage,
    TrackRanges as TrackRanges,
)
from uwbslam_jax.numerics.robust import (
    CALIBRATED_M as CALIBRATED_M,
    DECIDED as DECIDED,
    RANGE_FLOOR_M as RANGE_FLOOR_M,
    SIGMA_ENOUGH_M as SIGMA_ENOUGH_M,
    largest_sigma as largest_sigma,
    mean_sigma as mean_sigma,
    median_range as median_range,
    misfit as misfit,
    near_middle as near_middle,
    scatter_along as scatter_along,
    soften as soften,
    widened as widened,
)
from uwbslam_jax.numerics.row_buffer import Column as Column
from uwbslam_jax.numerics.se2 import (
    gauge_pose as gauge_pose,
    perpendicular as perpendicular,
    rotation as rotation,
    safe_norm as safe_norm,
    transform_points as transform_points,
    wrap_angle as wrap_angle,
)
from uwbslam_jax.numerics.se2_host import (
    between as between,
    carried_along as carried_along,
    compose as compose,
    numeric_jacobian as numeric_jacobian,
    rigid_fit as rigid_fit,
    rotation_matrix as rotation_matrix,
    transformed as transformed,
    turned as turned,
    wrapped as wrapped,
)
from uwbslam_jax.numerics.sparse_least_squares import (
    SingularError as SingularError,
    Sink as Sink,
    cost_of as cost_of,
    covariance as covariance,
    minimise as minimise,
)
