"""Two scans laid over each other: the relative pose, what is told of it, and when nothing is."""

from __future__ import annotations

import jax
import numpy as np
import pytest
import small_room as room

from uwbslam_jax.backend.registration import Registration, register, view
from uwbslam_jax.measurements import Snapshot
from uwbslam_jax.settings import Settings, make_params

PARAMS = make_params(Settings())
BEAMS = 360
CORRIDOR = np.array([[[-50.0, -1.0], [50.0, -1.0]], [[50.0, 1.0], [-50.0, 1.0]]])
"""Two walls whose ends are out of reach."""


def snapshot(pose: np.ndarray, walls: np.ndarray = room.WALLS, reach: float = np.inf, sigma: float = 0.01) -> Snapshot:
    """A scan with noise, taken at rest."""
    scan = room.scan(pose, BEAMS, walls)
    noise = np.random.default_rng(int(1e3 * abs(pose).sum())).normal(0, sigma, BEAMS).astype(np.float32)
    seen = scan.valid & (scan.ranges < reach)
    return Snapshot(scan._replace(ranges=scan.ranges + noise, valid=seen), np.zeros(2, np.float32), np.float32(0))


def relative(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    c, s = np.cos(a[2]), np.sin(a[2])
    d = b[:2] - a[:2]
    return np.array([c * d[0] + s * d[1], -s * d[0] + c * d[1], b[2] - a[2]])


def laid(old: Snapshot, new: Snapshot, guess: np.ndarray) -> Registration:
    stacked = jax.tree.map(lambda leaf: np.asarray(leaf)[None], view(PARAMS.lidar, old))
    return jax.tree.map(
        lambda leaf: np.asarray(leaf)[0], register(stacked, view(PARAMS.lidar, new), np.float32(guess[None]))
    )


@pytest.mark.parametrize("off", [(0.0, 0.0, 0.0), (0.25, -0.2, 0.08), (-0.3, 0.1, -0.08)])
@pytest.mark.parametrize("to", [(0.3, 0.2, 0.1), (-1.5, 1.0, 1.2), (1.0, -1.5, -2.5)])
def test_a_scan_finds_its_place_in_another(to, off) -> None:
    old = np.array([0.0, 0.0, 0.3])
    new = np.array(to)
    want = relative(old, new)
    found = laid(snapshot(old), snapshot(new), want + np.array(off))
    np.testing.assert_allclose(found.pose[:2], want[:2], atol=0.01)  # a beam's noise; 300 of them
    assert abs(found.pose[2] - want[2]) < 0.004
    assert found.share > 0.8
    sigma = np.sqrt(np.diag(np.linalg.inv(found.information)))
    assert np.all(sigma < [0.02, 0.02, 0.01])
    error = found.pose - want
    assert error @ found.information @ error < 16.3  # chi-square of 3 degrees of freedom, 0.1 %


def test_a_scan_most_of_whose_returns_are_missing_finds_its_place_too() -> None:
    """Black and glass surfaces, a damaged line: a third of the beams come back, other ones each time."""
    old, new = np.array([0.0, 0.0, 0.3]), np.array([0.3, 0.2, 0.4])
    rng = np.random.default_rng(3)
    want = relative(old, new)
    pair = []
    for pose in (old, new):
        whole = snapshot(pose)
        scan = whole.scan
        kept = scan.valid & (rng.random(BEAMS) < 0.33)
        pair.append(whole._replace(scan=scan._replace(ranges=np.where(kept, scan.ranges, 0), valid=kept)))
    found = laid(*pair, want + np.array([0.1, -0.1, 0.04]))
    np.testing.assert_allclose(found.pose[:2], want[:2], atol=0.02)
    assert abs(found.pose[2] - want[2]) < 0.01
    assert found.share > 0.6


def test_a_corridor_tells_nothing_along_itself() -> None:
    old, new = np.zeros(3), np.array([0.6, 0.1, 0.05])
    guess = relative(old, new) + np.array([0.2, 0.1, 0.02])
    found = laid(snapshot(old, CORRIDOR, 8.0), snapshot(new, CORRIDOR, 8.0), guess)
    along, across, turn = np.diag(found.information)
    assert along < 0.3**-2
    assert across > 0.02**-2
    assert turn > 0.01**-2
    assert abs(found.pose[1] - new[1]) < 0.01
    assert abs(found.pose[2] - new[2]) < 0.004


def test_a_scan_of_another_place_does_not_fit() -> None:
    elsewhere = room.WALLS * 0.6 + np.array([1.0, 0.5])
    found = laid(snapshot(np.zeros(3)), snapshot(np.zeros(3), elsewhere), np.zeros(3))
    assert found.share < 0.5


def test_a_scan_without_returns_tells_nothing() -> None:
    blind = snapshot(np.zeros(3), reach=0.0)
    for old, new in ((blind, snapshot(np.zeros(3))), (snapshot(np.zeros(3)), blind)):
        found = laid(old, new, np.array([0.1, 0.0, 0.0]))
        assert found.share == 0
        np.testing.assert_array_equal(found.information, 0)
        np.testing.assert_allclose(found.pose, [0.1, 0, 0], atol=1e-6)
