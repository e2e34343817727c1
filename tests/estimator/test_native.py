"""The native engine computes what its twin computes: from one state both make the same of one frame."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterable

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import small_room as room
from known_room import BEACONS, BEAMS, CONFIG, FLAT, PAIRS, PARAMS, POSE, drawn_map, knowing
from two_engines import BothEngines

import uwbslam_jax as us
from uwbslam_jax.estimator import State, compiled, init
from uwbslam_jax.estimator.native import records
from uwbslam_jax.estimator.native.engine import NativeStep
from uwbslam_jax.estimator.native.records import Leaves, fields
from uwbslam_jax.measurements import Frame, Message, Odometry, Scan
from uwbslam_jax.settings import Settings

NOTHING = Odometry(np.zeros(3, np.float32), np.bool_(False))


def odometry(*increment: float) -> Odometry:
    return Odometry(np.float32(increment), np.bool_(True))


def measured(pose=POSE, config=CONFIG, dt=0.1, noise=0.02, gap=np.nan, seed=0, **kinds) -> Frame:
    """A frame of the small room seen from a pose."""
    rng = np.random.default_rng(seed)
    z = room.distances(np.vstack([pose[:2], BEACONS]), PAIRS) + noise * rng.normal(size=6)
    ranges = room.ranges(PAIRS, z, config.max_ranges, age=-rng.uniform(0, dt), gap=gap)
    scan = room.scan(pose, BEAMS)
    far = np.where(scan.valid, scan.ranges + 0.5 * noise * rng.normal(size=BEAMS), 0.0).astype(np.float32)
    scan = scan._replace(ranges=far, time_increment=np.float32(0.1 / BEAMS))
    return room.frame(config, dt, kinds.get("scan", scan), ranges, kinds.get("odometry"))


def upside_down(scan: Scan) -> Scan:
    """The same beams, counted clockwise."""
    last = scan.angle_min + np.float32(BEAMS - 1) * scan.angle_increment
    return scan._replace(
        ranges=scan.ranges[::-1].copy(),
        valid=scan.valid[::-1].copy(),
        angle_min=last,
        angle_increment=-scan.angle_increment,
    )


def few_returns(scan: Scan, count: int) -> Scan:
    return scan._replace(valid=scan.valid & (np.arange(BEAMS) < count))


def cases() -> dict[str, tuple[State, Frame]]:
    """States in the middle of a run, and what is measured then: every branch of the step is taken."""
    grid, moved, rng = drawn_map(), POSE + np.array([0.06, -0.04, 0.03]), np.random.default_rng(1)
    driving = knowing(grid, velocity=(0.5, 0.2), yaw_rate=0.4)
    one = measured(moved)
    strange = one.scan._replace(ranges=rng.uniform(0.5, 2.5, BEAMS).astype(np.float32), valid=np.ones(BEAMS, bool))
    carried = driving._replace(moving=jnp.array([False, True, False, False]))
    drawn_elsewhere = driving._replace(drawn_pose=jnp.zeros(3))
    loud = driving._replace(scatter=driving.scatter._replace(log=jnp.full((4, 4), 1.2), heard=jnp.ones((4, 4), bool)))
    restless = driving._replace(unrest=jnp.array([0.01, 0.004]))
    apart = jnp.diag(jnp.array([0.004, 0.003, 0.001], jnp.float32))
    spread = driving.map_spread._replace(epoch=jnp.float32(9.0), apart=apart)
    other_epoch = driving._replace(map_spread=spread)
    lost = driving._replace(belief=driving.belief._replace(cov=100.0 * driving.belief.cov))
    gaps = np.array([np.nan, 20.0, 3.0, 11.0, 10.0, np.nan])
    return {
        "first": (init(CONFIG), measured()),
        "driving": (driving, one),
        "drawn": (drawn_elsewhere, one),
        "no scan": (driving, measured(moved, scan=None)),
        "no return": (driving, measured(moved, scan=few_returns(one.scan, 0))),
        "few returns": (driving, measured(moved, scan=few_returns(one.scan, 15))),
        "half a turn": (drawn_elsewhere, measured(moved, scan=few_returns(one.scan, 31))),
        "upside down": (drawn_elsewhere, measured(moved, scan=upside_down(one.scan))),
        "wheels": (driving, measured(moved, odometry=odometry(0.05, 0.01, 0.03))),
        "wheels that jump": (driving, measured(moved, dt=0.01, odometry=odometry(0.4, -0.2, 1.0))),
        "wheels at once": (driving, measured(moved, dt=0.0, odometry=odometry(0.01, 0.0, 0.0))),
        "a beacon is carried": (carried, one),
        "loud pairs": (loud, measured(moved, noise=0.3)),
        "behind walls": (driving, measured(moved, gap=gaps)),
        "not active": (driving._replace(active=jnp.array([True, True, False, True])), one),
        "no beacon": (driving._replace(active=jnp.array([True, False, False, False])), one),
        "a long gap": (driving, measured(moved, dt=40.0)),
        "a jump": (driving, measured(POSE + np.array([0.4, 0.3, 0.1]))),
        "a restless one": (restless, measured(POSE + np.array([0.3, 0.2, -0.15]))),
        "ground of another epoch": (other_epoch, one),
        "turned": (knowing(grid), measured(POSE + np.array([0.0, 0.0, 2.0]))),
        "turned and moved": (lost, measured(POSE + np.array([0.3, -0.2, -1.2]))),
        "elsewhere": (driving, measured(moved, scan=strange)),
        "spinning": (knowing(grid, yaw_rate=6.0), measured(POSE + np.array([0.0, 0.0, 0.6]))),
        "out of the window": (knowing(grid, pose=np.array([40.0, 2.0, 0.3])), one),
    }


def test_both_engines_make_the_same_of_every_kind_of_frame():
    both = BothEngines()
    for name, (state, frame) in cases().items():
        before = len(both.found.decisions)
        both.step(CONFIG, PARAMS, state, [frame])
        assert len(both.found.decisions) == before, f"{name}: {both.found.decisions[-1]}"
    assert both.found.searched >= 3
    assert both.found.poor >= 1
    assert both.found.drawn >= 4
    both.found.check()


@pytest.mark.parametrize("config", [CONFIG, FLAT], ids=["two levels", "one"])
def test_both_engines_make_the_same_of_random_states(config):
    both, rng = BothEngines(), np.random.default_rng(4)
    for seed in range(25):
        pose = POSE + rng.normal(size=3) * np.array([0.5, 0.5, 1.0])
        start = pose + rng.normal(size=3) * np.array([0.05, 0.05, 0.03])
        state = knowing(drawn_map(), start, tuple(0.3 * rng.normal(size=2)), float(rng.normal()), seed)
        state = state._replace(grid=state.grid._replace(levels=state.grid.levels[: config.levels]))
        wheels = odometry(*(0.03 * rng.normal(size=3))) if seed % 3 == 0 else NOTHING
        frames = [measured(pose, config, seed=seed, odometry=wheels), measured(pose, config, seed=99 - seed)]
        both.step(config, PARAMS, state, frames)
    both.found.check()


def test_both_engines_make_the_same_of_a_corridor_without_ends():
    walls = np.array([[[-90.0, -1.2], [90.0, -1.2]], [[-90.0, 1.4], [90.0, 1.4]]]) + 0.05
    frames = []
    for n in range(16):
        scan = room.scan(np.array([0.12 * n, 0.02 * n, 0.02 * n]), BEAMS, walls)
        near = scan.valid & (scan.ranges < 9.0)
        frames.append(
            measured(scan=scan._replace(valid=near, ranges=np.where(near, scan.ranges, 0).astype(np.float32)))
        )
    both = BothEngines()
    _, estimates = both.step(CONFIG, PARAMS, init(CONFIG), frames)
    information = estimates[-1].information
    assert information[0, 0] < 0.2 * information[1, 1]  # blind along the corridor
    assert both.found.drawn > 10
    both.found.check()


def test_a_state_that_is_nowhere_harms_nothing():
    native = NativeStep(CONFIG)
    state = jax.tree.map(np.array, knowing(drawn_map()))
    for poisoned in (np.nan, np.inf, 1e30):
        state.belief.mean[0] = poisoned
        native.state = state
        before = [level.copy() for level in native.state.grid.levels]
        native.step(PARAMS, measured())
        for level, old in zip(native.state.grid.levels, before, strict=True):
            np.testing.assert_array_equal(level, old)


def test_the_same_steps_give_the_same_bits_and_a_state_goes_in_as_it_comes_out():
    def driven(again: bool) -> list[np.ndarray]:
        native = NativeStep(CONFIG)
        native.state = knowing(drawn_map(), velocity=(0.5, 0.2))
        for seed in range(5):
            if again:
                native.state = jax.tree.map(np.array, native.state)
            native.step(PARAMS, measured(POSE + 0.05 * seed, seed=seed))
        return [np.array(leaf) for leaf in jax.tree.leaves(native.state)]

    for a, b in zip(driven(False), driven(True), strict=True):
        assert a.dtype == b.dtype
        assert a.tobytes() == b.tobytes()


def test_a_tree_with_a_leaf_that_the_loops_do_not_know_is_refused():
    told = np.zeros(1, records.TOLD)
    with pytest.raises(TypeError, match="sigma"):
        Leaves(PARAMS, fields(told))


class Enough(Exception):
    """So many frames were compared."""


def compared(
    monkeypatch: pytest.MonkeyPatch, settings: Settings, messages: Iterable[Message], frames: int
) -> BothEngines:
    """A run of some messages, both engines in every step of it, up to so many frames."""
    both = BothEngines()

    def step(*args):
        if len(both.found.pose) >= frames:
            raise Enough
        return both.step(*args)

    monkeypatch.setattr(compiled, "step", step)
    slam = us.Slam(settings)
    with contextlib.suppress(Enough):
        for message in messages:
            slam.add(message)
    print(both.found)
    return both


DRIVES = {
    "hall": ("hall", {}, 600),
    "hall at 40 Hz": ("hall40", {}, 450),
    "office": ("office", {}, 450),
    "corridor": ("corridor", {}, 600),
    "kidnapped": ("kidnapped", {}, 900),
    "wheels": ("sparse", {}, 300),
    "three nodes": ("three", {"max_beacons": 2}, 250),
    "51 nodes": ("hall", {"max_beacons": 50}, 150),
    "one level": ("hall", {"levels": 1}, 200),
    "two levels": ("office", {"levels": 2}, 200),
    "four levels": ("hall", {"levels": 4}, 200),
    "LiDAR only": ("office", {"lidar_only": True}, 200),
}
"""Scenario, what is set otherwise, and so many frames of it."""


@pytest.mark.slow
@pytest.mark.parametrize("drive", DRIVES)
def test_both_engines_make_the_same_of_a_drive(monkeypatch, drive):
    name, others, frames = DRIVES[drive]
    made = us.simulate(name, 1)
    settings = made.settings
    for section in ("uwb", "map", "filter"):
        old = getattr(settings, section)
        fitting = {key: value for key, value in others.items() if hasattr(old, key)}
        settings = dataclasses.replace(settings, **{section: dataclasses.replace(old, **fitting)})
    compared(monkeypatch, settings, made, frames).found.check()


@pytest.mark.slow
def test_both_engines_make_the_same_of_a_drive_with_the_lidar_upside_down(monkeypatch):
    made = us.simulate("hall", 1)

    def turned(message: Message) -> Message:
        if not isinstance(message, us.ScanMessage):
            return message
        return dataclasses.replace(message, angle_min=-message.angle_min, angle_increment=-message.angle_increment)

    robot = dataclasses.replace(made.settings.robot, lidar_flip=True)
    settings = dataclasses.replace(made.settings, robot=robot)
    compared(monkeypatch, settings, map(turned, made), 250).found.check()


@pytest.mark.slow
def test_both_engines_make_the_same_of_a_recorded_building(monkeypatch, shared_data):
    path = shared_data / "intel" / "intel.mcap"
    both = compared(monkeypatch, Settings(), us.read(path), 1000)
    assert both.found.searched >= 1
    both.found.check()


@pytest.mark.slow
def test_both_engines_make_the_same_where_a_run_only_localises(monkeypatch):
    config = dataclasses.replace(CONFIG, draws=False)
    both = BothEngines()
    for state, frame in cases().values():
        both.step(config, PARAMS, state, [frame])
    assert both.found.drawn == 0
    both.found.check()
