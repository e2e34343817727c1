"""A beacon's life after start-up."""

from uwbslam_jax.beacons import state_edits as state_edits
from uwbslam_jax.beacons.evidence import MEMORY_S as MEMORY_S
from uwbslam_jax.beacons.keeper import BeaconKeeper as BeaconKeeper
