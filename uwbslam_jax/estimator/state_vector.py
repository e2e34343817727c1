"""The state vector by name: which entries are positions, velocities, heading, yaw rate and map error.

    positions (K, 2) m | velocities (K, 2) m/s | heading rad | yaw rate rad/s | map error (3,) m, m, rad

K = 1 + max_beacons nodes; slot 0 is the robot. The map error is what the map's own drift adds to a matched pose:
a match reports pose + map error, for it is against a map that the robot's own past poses drew.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from uwbslam_jax.measurements import Leaf


class Nodes(NamedTuple):
    """The state vector taken apart; see the module's first lines for shapes and units."""

    positions: Float[Array, "K 2"]
    velocities: Float[Array, "K 2"]
    heading: Float[Array, ""]
    yaw_rate: Float[Array, ""]
    map_error: Float[Array, "3"]


def node_count(size: int) -> int:
    """Number of nodes K of a state vector of that size."""
    return (size - 5) // 4


def state_size(nodes: int) -> int:
    """Size of the state vector of K nodes."""
    return 4 * nodes + 5


def unpack(vector: Float[Leaf, "n"]) -> Nodes:
    """Names for the entries of a state vector."""
    k = node_count(vector.shape[0])
    return Nodes(
        positions=vector[: 2 * k].reshape(k, 2),
        velocities=vector[2 * k : 4 * k].reshape(k, 2),
        heading=vector[4 * k],
        yaw_rate=vector[4 * k + 1],
        map_error=vector[4 * k + 2 :],
    )


def pack(nodes: Nodes) -> Float[Array, "n"]:
    """The state vector of named entries."""
    scalars = jnp.stack([nodes.heading, nodes.yaw_rate])
    return jnp.concatenate([nodes.positions.ravel(), nodes.velocities.ravel(), scalars, nodes.map_error])


def pose_indices(nodes: int) -> tuple[int, int, int]:
    """Where the robot's x, y and heading stand in the state vector."""
    return 0, 1, 4 * nodes


def map_error_indices(nodes: int) -> tuple[int, int, int]:
    """Where the map error stands in the state vector."""
    return 4 * nodes + 2, 4 * nodes + 3, 4 * nodes + 4


def robot_pose(vector: Float[Leaf, "n"]) -> Float[Leaf, "3"]:
    """The robot's x, y, heading [m, m, rad]."""
    return vector[jnp.array(pose_indices(node_count(vector.shape[0])))]


def matched_pose_jacobian(nodes: int) -> Float[Array, "3 n"]:
    """C with C @ vector = robot pose + map error, the pose that a scan match reports."""
    C = jnp.zeros((3, state_size(nodes)))
    rows = jnp.arange(3)
    return C.at[rows, jnp.array(pose_indices(nodes))].set(1.0).at[rows, jnp.array(map_error_indices(nodes))].set(1.0)
