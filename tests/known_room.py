"""The small room in the middle of a run: its map drawn, three beacons placed, the robot near a pose."""

from __future__ import annotations

import dataclasses
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import small_room as room

from uwbslam_jax import estimator
from uwbslam_jax.estimator import state_vector
from uwbslam_jax.estimator.state_vector import Nodes
from uwbslam_jax.mapping import grid as occupancy, undo_motion
from uwbslam_jax.measurements import Scan
from uwbslam_jax.settings import Config, Settings, UwbSettings, make_params

BEAMS = 60
CONFIG = Config(
    nodes=4,
    max_ranges=8,
    max_beams=BEAMS,
    resolution=0.1,
    levels=2,
    cells=128,
    nlos_gap_db=10.0,
    preset="robust",
    scan_matching=True,
    correction=True,
    lidar_only=False,
)
FLAT = dataclasses.replace(CONFIG, levels=1)
"""One level, where it is compiled anew: coarse to fine is the matching's own business."""
PARAMS = make_params(Settings(uwb=UwbSettings(max_beacons=3)))
BEACONS = np.array([[-3.5, -2.5], [4.0, -2.0], [1.0, 3.0]])
PAIRS = room.all_pairs(4)
POSE = np.array([0.33, -0.41, 0.6])


def sweep_of(scan: Scan):
    return undo_motion(jax.tree.map(jnp.asarray, scan), jnp.zeros(3), jnp.zeros(2), jnp.zeros(()))


@cache
def drawn_map():
    """The map after nine scans from three poses."""
    grid = occupancy.empty(CONFIG.cells, CONFIG.levels, CONFIG.resolution)
    draw = jax.jit(occupancy.integrate, static_argnums=3)
    for pose in [(0.0, 0.0, 0.0), (-2.0, 2.0, 1.0), (2.0, -1.5, -1.0)] * 3:
        sweep = sweep_of(room.scan(np.array(pose), 720))
        grid = draw(grid, jnp.array(pose, jnp.float32), sweep, CONFIG.resolution)
    return grid


def knowing(grid, pose=POSE, velocity=(0.0, 0.0), yaw_rate=0.0, seed=0) -> estimator.State:
    """A state in the middle of a run: the room drawn, three beacons placed, the robot near a pose."""
    state = estimator.init(CONFIG)
    positions = np.vstack([pose[:2], BEACONS])
    velocities = np.zeros((4, 2))
    velocities[0] = velocity
    nodes = Nodes(*(jnp.asarray(x, jnp.float32) for x in (positions, velocities, pose[2], yaw_rate, np.zeros(3))))
    n = state_vector.state_size(4)
    std = np.full(n, 1e-3)
    std[:2], std[2:8], std[8:10], std[16:18], std[18:] = 0.05, 0.03, 0.2, (0.05, 0.3), 0.02
    rng = np.random.default_rng(seed)
    correlation = 0.9 * np.eye(n) + 0.1 * np.corrcoef(rng.normal(size=(n, 2 * n)))
    cov = jnp.asarray(correlation * np.outer(std, std), jnp.float32)
    return state._replace(
        belief=state.belief._replace(mean=state_vector.pack(nodes), cov=cov),
        active=jnp.ones(4, bool),
        grid=grid,
        drawn_pose=jnp.asarray(pose, jnp.float32),
        scans_drawn=jnp.int32(100),
    )
