"""SE(2) and the gauge map of relative positioning. A pose is (x, y, theta) in [m, m, rad]; pure functions only."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float


def wrap_angle(angle: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """The same angle in [-pi, pi) [rad]; smooth (slope 1) wherever it is defined."""
    return angle - 2 * jnp.pi * jnp.floor((angle + jnp.pi) / (2 * jnp.pi))


def rotation(theta: Float[Array, ""]) -> Float[Array, "2 2"]:
    """Matrix that turns a vector counter-clockwise by theta [rad]."""
    c, s = jnp.cos(theta), jnp.sin(theta)
    return jnp.stack([jnp.stack([c, -s]), jnp.stack([s, c])])


def perpendicular(vectors: Float[Array, "*n 2"]) -> Float[Array, "*n 2"]:
    """Vectors turned by +90 degrees: the derivative of a rotation at zero."""
    return jnp.stack([-vectors[..., 1], vectors[..., 0]], axis=-1)


def compose(a: Float[Array, "3"], b: Float[Array, "3"]) -> Float[Array, "3"]:
    """Pose b, given in the frame of pose a, in the frame that a is given in."""
    return jnp.concatenate([a[:2] + rotation(a[2]) @ b[:2], wrap_angle(a[2:] + b[2:])])


def inverse(a: Float[Array, "3"]) -> Float[Array, "3"]:
    """Pose of the outer frame seen from pose a."""
    return jnp.concatenate([-rotation(-a[2]) @ a[:2], wrap_angle(-a[2:])])


def between(a: Float[Array, "3"], b: Float[Array, "3"]) -> Float[Array, "3"]:
    """Pose b seen from pose a: compose(a, between(a, b)) = b."""
    return compose(inverse(a), b)


def transform_points(pose: Float[Array, "3"], points: Float[Array, "n 2"]) -> Float[Array, "n 2"]:
    """Points given in the frame of a pose, in the frame that the pose is given in [m]."""
    # written out: on a CPU the product by a 2 x 2 matrix is 20 times slower, for its transposes
    c, s = jnp.cos(pose[2]), jnp.sin(pose[2])
    x, y = points[:, 0], points[:, 1]
    return jnp.stack([pose[0] + (c * x - s * y), pose[1] + (s * x + c * y)], axis=-1)


def safe_norm(vectors: Float[Array, "*n 2"]) -> Float[Array, "*n"]:
    """Euclidean length with gradient 0 at the zero vector, where that of a plain norm is NaN."""
    squared = jnp.sum(vectors**2, axis=-1)
    positive = squared > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, squared, 1.0)), 0.0)


def gauge_pose(origin: Float[Array, "2"], on_x_axis: Float[Array, "2"]) -> Float[Array, "3"]:
    """Rigid motion that puts one point at the origin and another on the positive x axis (paper, "Elimination of
    location ambiguities"). A point x goes to compose(gauge_pose, x)."""
    along = on_x_axis - origin
    theta = -jnp.arctan2(along[1], along[0])
    return jnp.concatenate([-rotation(theta) @ origin, theta[None]])
