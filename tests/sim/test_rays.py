"""Rays against analytic cases; how they do against a slow second implementation is in test_simulate."""

from __future__ import annotations

import numpy as np

from uwbslam_jax.sim import rays, worlds


def test_cast_in_a_square_room_is_analytic() -> None:
    room = worlds.polygon(np.array([[-5.0, -5.0], [5.0, -5.0], [5.0, 5.0], [-5.0, 5.0]]))
    origin = np.array([1.0, -2.0])
    angles = -2.0 + 2.0 * np.pi * np.arange(1440) / 1440
    with np.errstate(divide="ignore"):
        to_x = np.where(np.cos(angles) > 0, 5.0 - origin[0], -5.0 - origin[0]) / np.cos(angles)
        to_y = np.where(np.sin(angles) > 0, 5.0 - origin[1], -5.0 - origin[1]) / np.sin(angles)
    np.testing.assert_allclose(rays.cast(room, origin, angles), np.minimum(to_x, to_y), rtol=0, atol=1e-9)


def test_cast_leaks_through_no_corner() -> None:
    room = worlds.polygon(np.array([[-5.0, -5.0], [5.0, -5.0], [5.0, 5.0], [-5.0, 5.0]]))
    corner = np.pi / 4 + np.pi / 2 * np.arange(-2, 2)
    np.testing.assert_allclose(rays.cast(room, np.zeros(2), corner), np.sqrt(50.0), atol=1e-9)


def test_a_ray_tells_at_what_angle_it_meets_the_nearest_wall() -> None:
    near, far = [1.0, -5.0, 1.0, 5.0], [-9.0, 2.0, 9.0, 3.0]
    angles = np.deg2rad([-80.0, 0.0, 60.0, 90.0, 180.0])
    reach, glance = rays.strike(np.array([far, near]), np.zeros(2), angles)
    slope = np.arctan2(1.0, 18.0)
    np.testing.assert_allclose(np.rad2deg(glance[1:3]), [90.0, 30.0], atol=1e-9)
    np.testing.assert_allclose(glance[3], np.pi / 2 - slope, atol=1e-12)
    np.testing.assert_allclose(reach[[1, 3]], [1.0, 2.5], atol=1e-12)
    assert np.isinf(reach[[0, 4]]).all()  # below the near wall's end, and away from both
    assert not glance[[0, 4]].any()
