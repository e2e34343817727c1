"""Ready-made scenarios by name and seed; each seed has its own world, beacons and orientation.

Nothing here measures; `simulate` turns a scenario into messages.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from uwbslam_jax.sim import rays, worlds
from uwbslam_jax.sim.paths import Along, Carried, Path, Piece, Rest, Track, Turn
from uwbslam_jax.sim.scenario import INF, Beacon, Follow, Lidar, Pause, Scenario, Uwb, Walk, Wheels, stream
from uwbslam_jax.sim.worlds import World


def make_scenario(name: str, seed: int = 0, duration_s: float | None = None) -> Scenario:
    """A ready-made scenario; each seed has its own world, beacons and orientation. `SCENARIOS` lists the names.

    duration_s: instead of the scenario's own; what happens once (but for the paper's schedule) happens sooner then.

    Raises:
      ValueError: no scenario of this name.
    """
    if name not in _MAKERS:
        raise ValueError(f"no scenario is called {name!r}; there are {', '.join(SCENARIOS)}")
    made = _MAKERS[name](seed, duration_s)
    rng = stream(seed, "placement")
    pose = (*rng.uniform(-15.0, 15.0, 2), rng.uniform(-np.pi, np.pi))

    def placed(beacon: Beacon) -> Beacon:
        moves = tuple(replace(m, to=_spot(pose, m.to)) if isinstance(m, Walk) else m for m in beacon.moves)
        return replace(beacon, position=_spot(pose, beacon.position), moves=moves)

    beacons = tuple(placed(b) for b in made.beacons)
    return replace(made, name=name, world=made.world.placed(pose), path=made.path.placed(pose), beacons=beacons)


def _spot(pose: Sequence[float], xy: tuple[float, float]) -> tuple[float, float]:
    x, y = worlds.place(pose, np.array([xy]))[0]
    return float(x), float(y)


def spread(world: World, route: np.ndarray, count: int, rng: np.random.Generator, apart: float) -> np.ndarray:
    """Random free places (count, 2) [m], 0.3 from walls, 0.5 from the route (n, 2), `apart` from each other."""
    low, high = world.outline.min(0), world.outline.max(0)
    while True:
        spots = rng.uniform(low, high, (800, 2))
        spots = spots[worlds.free(world, spots)]
        spots = spots[rays.point_segment_distance(spots, world.segments).min(1) > 0.3]
        to_route = np.min(np.hypot(*np.moveaxis(spots[:, None] - route[None, :, :2], -1, 0)), axis=1)
        chosen: list[np.ndarray] = []
        for spot in spots[to_route > 0.5]:
            if len(chosen) < count and all(np.hypot(*(spot - other)) > apart for other in chosen):
                chosen.append(spot)
        if len(chosen) == count and _off_line(np.array(chosen)) > 1.0:
            return np.array(chosen)
        apart *= 0.97  # a small or crowded floor


def _off_line(spots: np.ndarray) -> float:
    """How far places (n, 2) are from lying on one line, rms [m]; beacons on a line leave the side open for good."""
    if len(spots) < 3:
        return INF
    return float(np.linalg.svd(spots - spots.mean(0), compute_uv=False)[1] / np.sqrt(len(spots)))


def _beacons(world: World, track: Track, seed: int, ids: Sequence[int], height: float = 0.0) -> tuple[Beacon, ...]:
    """Beacons at random places spread over the floor."""
    spots = spread(world, track.sample(0.25), len(ids), stream(seed, "beacons"), apart=4.0)
    return tuple(Beacon(int(i), (float(x), float(y)), height) for i, (x, y) in zip(ids, spots, strict=True))


def _directed(world: World, seed: int) -> World:
    """The world with its lap begun at a corner of the seed's choice, clockwise where the seed is odd."""
    lap = world.lap[::-1] if seed % 2 else world.lap
    return replace(world, lap=np.roll(lap, stream(seed, "direction").integers(len(lap)), axis=0))


class _Drive(NamedTuple):
    """How laps are driven: after a rest, in arcs of a radius; the driver wanders as far as `sway` to either side."""

    speed: float = 0.8  # m/s
    radius: float = 1.2  # m
    sway: float = 0.0  # m
    rest: float = 4.0  # s


def _laps(world: World, seed: int, duration: float, ids: Sequence[int], drive: _Drive, height: float = 0.0) -> Scenario:
    """Rest for a while, then laps to the end."""
    track = Track(world.lap, drive.radius, closed=True)
    if drive.sway > 0.0:
        track = track.swayed(drive.sway, stream(seed, "sway"))
    path = Path([Rest(drive.rest), Along(track, 0.0, drive.speed * max(duration - drive.rest, 1.0), drive.speed)])
    return Scenario("laps", seed, duration, world, path, _beacons(world, track, seed, ids, height))


def _along_corridors(track: Track, seed: int, ids: np.ndarray) -> tuple[Beacon, ...]:
    """Beacons along the walls on either side of a track, about evenly, the ids (n,) in any order."""
    rng, n = stream(seed, "beacons"), len(ids)
    s = (np.arange(n) + rng.uniform(-0.25, 0.25, n)) * track.length / n + rng.uniform(0.0, track.length)
    pose, offset = track.pose(s), rng.choice([-1.0, 1.0], n) * rng.uniform(0.6, 0.85, n)
    x, y = pose[:, 0] - offset * np.sin(pose[:, 2]), pose[:, 1] + offset * np.cos(pose[:, 2])
    ids = rng.permutation(ids)
    return tuple(Beacon(int(ids[k]), (float(x[k]), float(y[k]))) for k in range(n))


def _workshop(seed: int, duration: float | None) -> Scenario:
    world = _directed(worlds.workshop(seed), seed)
    made = _laps(world, seed, duration or 150.0, (1, 2, 3, 4, 5), _Drive())
    track = Track(world.lap, 1.2, closed=True)
    if duration is None:  # three laps, then a rest
        made = replace(made, path=Path([Rest(4.0), Along(track, 0.0, 3.0 * track.length)]))
    return made


def _hall(
    seed: int,
    duration: float | None,
    ids: Sequence[int] = (7, 3, 12, 5, 9),
    height: float = 0.0,
    **drive: float,
) -> Scenario:
    world = _directed(worlds.hall(seed), seed)
    ids = [int(i) for i in stream(seed, "ids").permutation(ids)]
    driver = stream(seed, "driver")
    drive = {"speed": driver.uniform(0.6, 1.0), "rest": driver.uniform(0.5, 6.0), "sway": 0.15, **drive}
    return _laps(world, seed, duration or 150.0, ids, _Drive(**drive), height)


def _hall40(seed: int, duration: float | None) -> Scenario:
    made = _hall(seed, duration)
    return replace(made, lidar=Lidar(rate=40.0), uwb=Uwb(rate=20.0))


def _fast(seed: int, duration: float | None) -> Scenario:
    return _hall(seed, duration, speed=1.6, radius=0.9, sway=0.05)


def _spot_turns(seed: int, duration: float | None) -> Scenario:
    """Stop and go round the lap: after each stretch a rest, a turn on the spot, a look around or a bit backwards."""
    made = _hall(seed, duration)
    track = Track(made.world.lap, 1.2, closed=True)
    rng = stream(seed, "stops")
    pieces: list[Piece] = [Rest(4.0)]
    s = 0.0
    while len(pieces) == 1 or sum(p.duration for p in pieces) < made.duration:
        s_next = s + rng.uniform(3.0, 7.0)
        pieces.append(Along(track, s, s_next))
        s = s_next
        deed, side = rng.integers(4), rng.choice([-1.0, 1.0])
        if deed == 0:
            pieces.append(Rest(rng.uniform(1.0, 3.0)))
        elif deed == 1:
            pieces += [Turn(side * np.pi / 2), Rest(1.0), Turn(-side * np.pi / 2)]
        elif deed == 2:
            pieces += [Turn(side * 2.0 * np.pi)]
        else:
            back = rng.uniform(1.0, 2.0)
            pieces += [Rest(0.5), Along(track, s, s - back, 0.4), Rest(0.5)]
            s -= back
    return replace(made, path=Path(pieces))


def _nlos(seed: int, duration: float | None) -> Scenario:
    """The powers show half to all of the blocked exchanges: that is a matter of the walls."""
    return replace(_hall(seed, duration), uwb=Uwb(nlos=True, nlos_detectable=stream(seed, "walls").uniform(0.5, 1.0)))


def _early(seed: int, duration: float | None) -> Scenario:
    """Two radios that lock early in stretches of 30 s: 40 % of the ranges every minute, or all of them 40 % of the
    time where the seed is odd."""
    made = _hall(seed, duration)
    share, period = (1.0, 75.0) if seed % 2 else (0.4, 60.0)
    stretches = tuple((t, t + 30.0) for t in np.arange(20.0, made.duration, period))
    return replace(made, uwb=Uwb(early_node=made.beacons[1].id, early=stretches, early_share=share))


def _schedule(seed: int, duration: float | None) -> Scenario:
    """The paper's, in steps of 0.1 s."""
    made = _workshop(seed, duration)
    beacons = {b.id: b for b in made.beacons}
    beacons[5] = replace(beacons[5], alive=((13.5, INF),), moves=(Follow(13.5, 31.1),))
    beacons[3] = replace(beacons[3], alive=((0.0, 31.1), (46.6, INF)), moves=(Follow(46.6, 62.6),))
    return replace(made, beacons=tuple(beacons.values()))


def _frame_moved(seed: int, duration: float | None) -> Scenario:
    """The two beacons that fix the frame, the lowest id and the one farthest from it, are carried and switched off."""
    made = _hall(seed, duration)
    track = Track(made.world.lap, 1.2, closed=True)
    goals = spread(made.world, track.sample(0.25), 2, stream(seed, "moved"), apart=4.0)
    beacons = {b.id: b for b in made.beacons}
    first = beacons[min(beacons)]
    farthest = max(made.beacons, key=lambda b: np.hypot(*np.subtract(b.position, first.position)))
    for k, number in enumerate((first.id, farthest.id)):
        goal = (float(goals[k][0]), float(goals[k][1]))
        begin = 0.4 * made.duration + 8.0 * k
        walk = Walk(begin, begin + 12.0, goal)
        beacons[number] = replace(beacons[number], moves=(walk,), alive=((0.0, begin + 45.0),))
    return replace(made, beacons=tuple(beacons.values()))


def _corridor(seed: int, duration: float | None, recesses: bool = False) -> Scenario:
    """Two laps to and fro with turns on the spot, walls seen 6 m far; the driver sways by up to 0.3 m."""
    world = worlds.corridor(recesses=recesses, seed=seed)
    driver = stream(seed, "sway")
    ends = world.lap + np.column_stack([np.zeros(2), driver.uniform(-0.1, 0.1, 2)])
    side = stream(seed, "direction").choice([-1.0, 1.0])
    pieces: list[Piece] = [Rest(4.0)]
    for to in (ends, ends[::-1], ends, ends[::-1]):
        track = Track(to, 1.0).swayed(0.2, driver)
        pieces += [Along(track, 0.0, track.length), Turn(side * np.pi)]
    path = Path([*pieces, Rest(2.0)])
    rng = stream(seed, "beacons")
    along = np.linspace(1.0, 21.7, 5) + rng.uniform(-0.6, 0.6, 5)
    across = np.where(np.arange(5) % 2 == 0, 0.3, 2.1) + rng.uniform(-0.1, 0.1, 5)
    beacons = tuple(Beacon(k + 1, (float(np.clip(along[k], 0.4, 22.3)), float(across[k]))) for k in range(5))
    return Scenario("", seed, duration or path.duration, world, path, beacons, Lidar(reach=6.0))


def _straight(seed: int, duration: float | None) -> Scenario:
    """12 m straight ahead before the first turn."""
    world = worlds.hall(seed, size=(12.5, 22.0))
    lap = world.lap[[1, 0, 3, 2]] if seed % 2 else world.lap
    lap = np.roll(lap, 2, axis=0)  # the edge before the first waypoint is a long one
    track = Track(lap, 1.2, closed=True)
    track = Track(lap, 1.2, closed=True, lead=0.5 * float(np.hypot(*(lap[0] - lap[-1]))) - track.first_turn + 12.0)
    made = _laps(world, seed, duration or 150.0, (4, 2, 8, 6, 1), _Drive())
    return replace(made, path=Path([Rest(4.0), Along(track, 0.0, 0.8 * max(made.duration - 4.0, 1.0))]))


def _blind(seed: int, duration: float | None) -> Scenario:
    made = _hall(seed, duration)
    begin = made.duration * 7.0 / 15.0
    return replace(made, lidar=Lidar(blind=((begin, begin + 5.0),)))


def _uwb_silent(seed: int, duration: float | None) -> Scenario:
    made = _hall(seed, duration)
    return replace(made, uwb=Uwb(silent=((0.4 * made.duration, 0.6 * made.duration),)))


def _put_elsewhere(made: Scenario) -> tuple[Path, float]:
    """A path on which the robot is picked up half way and put down a good part of a lap farther, turned by 120 degrees,
    a second later; and when that begins [s]."""
    track = Track(made.world.lap, 1.2, closed=True)
    driven = 0.8 * (made.duration * 7.0 / 15.0 - 6.0)
    first: list[Piece] = [Rest(4.0), Along(track, 0.0, driven)]
    when = Path(first).duration
    before = track.pose(np.array([driven]))[0]
    there = driven + 0.35 * track.length
    x, y, tangent = track.pose(np.array([there]))[0]
    yaw = before[2] + 2.0 * np.pi / 3.0
    back = (tangent - yaw + np.pi) % (2.0 * np.pi) - np.pi
    rest = 0.8 * max(made.duration - when - 6.0, 1.0)
    return Path([*first, Carried((x, y, yaw), 1.0), Rest(2.0), Turn(back), Along(track, there, there + rest)]), when


def _kidnapped(seed: int, duration: float | None) -> Scenario:
    """Half way carried elsewhere, unseen by the LiDAR."""
    made = _hall(seed, duration)
    path, when = _put_elsewhere(made)
    return replace(made, path=path, lidar=Lidar(blind=((when, when + 1.0),)))


def _gap(seed: int, duration: float | None) -> Scenario:
    """Half way switched off for an hour, in which it is carried elsewhere."""
    made = _hall(seed, duration)
    path, when = _put_elsewhere(made)
    return replace(made, path=path, pause=Pause(when, when + 1.0, 3600.0))


def _large(seed: int, duration: float | None) -> Scenario:
    """A building of 150 x 100 m, four times round its corridors, 2 km; 32 beacons hear 40 m far."""
    world = _directed(worlds.office(seed, size=(150.0, 100.0)), seed)
    track = Track(world.lap, 0.9, closed=True).swayed(0.15, stream(seed, "sway"))
    path = Path([Rest(4.0), Along(track, 0.0, 4.2 * track.length, 1.6), Rest(2.0)])
    if duration is not None:
        path = Path([Rest(4.0), Along(track, 0.0, 1.6 * max(duration - 4.0, 1.0), 1.6)])
    beacons = _along_corridors(track, seed, 1 + np.arange(32))
    lidar, uwb = Lidar(rate=5.0, beams=541), Uwb(rate=5.0, beacon_pairs=False, reach=40.0)
    return Scenario("", seed, duration or path.duration, world, path, beacons, lidar, uwb)


def _slow_lidar(seed: int, duration: float | None) -> Scenario:
    made = _hall(seed, duration or 300.0, ids=(2, 4, 6), speed=0.35)
    lidar = Lidar(rate=1.0, beams=361, field_of_view=np.pi, time_increment=1.0 / 75.0 / 720.0)
    return replace(made, lidar=lidar, uwb=Uwb(beacon_pairs=False), wheels=Wheels())


def _sparse(seed: int, duration: float | None) -> Scenario:
    """A log of old: a scan of half a circle every metre, wheels in between."""
    made = _hall(seed, duration or 300.0, speed=0.4)
    lidar = Lidar(rate=0.4, beams=181, field_of_view=np.pi, time_increment=1.0 / 75.0 / 360.0)
    return replace(made, lidar=lidar, uwb=Uwb(rate=5.0, outliers=0.02), wheels=Wheels(rate=10.0))


def _lever_arms(seed: int, duration: float | None) -> Scenario:
    made = _hall(seed, duration, height=1.4)
    return replace(made, lidar=Lidar(pose=(0.3, 0.0, np.deg2rad(10.0))), uwb=Uwb(antenna=(0.0, 0.2, 0.6)))


def _heights(seed: int, duration: float | None, *, beacon_pairs: bool = True) -> Scenario:
    """Beacons 0.3 to 3 m above the robot's antenna, and nobody has measured how much."""
    made = _hall(seed, duration)
    heights = stream(seed, "heights").uniform(0.3, 3.0, len(made.beacons))
    beacons = (replace(b, height=float(h), surveyed=False) for b, h in zip(made.beacons, heights, strict=True))
    return replace(made, beacons=tuple(beacons), uwb=Uwb(beacon_pairs=beacon_pairs))


def _biased(seed: int, duration: float | None) -> Scenario:
    """Each node's antenna delay is off by 0.15 m rms, and nobody has calibrated it."""
    made = _hall(seed, duration)
    ids = [0, *sorted(b.id for b in made.beacons)]
    bias = stream(seed, "bias").normal(size=len(ids))
    bias *= 0.15 / np.sqrt(np.mean(bias**2))
    return replace(made, uwb=Uwb(bias={i: float(b) for i, b in zip(ids, bias, strict=True)}))


def _office(seed: int, duration: float | None) -> Scenario:
    """Twice round the corridors, 300 m; beacons along the corridors' walls hear 25 m far."""
    world = _directed(worlds.office(seed), seed)
    track = Track(world.lap, 0.9, closed=True).swayed(0.15, stream(seed, "sway"))
    path = Path([Rest(4.0), Along(track, 0.0, 2.0 * track.length), Rest(2.0)])
    if duration is not None:
        path = Path([Rest(4.0), Along(track, 0.0, 0.8 * max(duration - 4.0, 1.0))])
    beacons = _along_corridors(track, seed, np.arange(11, 19))
    return Scenario("", seed, duration or path.duration, world, path, beacons, uwb=Uwb(reach=25.0))


_MAKERS: dict[str, Callable[[int, float | None], Scenario]] = {
    "workshop": _workshop,
    "hall": _hall,
    "hall40": _hall40,
    "fast": _fast,
    "spot": _spot_turns,
    "robot_only": lambda seed, duration: replace(_hall(seed, duration), uwb=Uwb(beacon_pairs=False)),
    "three": lambda seed, duration: _hall(seed, duration, ids=(7, 3, 12)),
    "nlos": _nlos,
    "nlos_silent": lambda seed, duration: replace(_hall(seed, duration), uwb=Uwb(nlos=True, report_powers=False)),
    "early": _early,
    "schedule": _schedule,
    "frame_moved": _frame_moved,
    "corridor": _corridor,
    "corridor_recess": lambda seed, duration: _corridor(seed, duration, recesses=True),
    "straight": _straight,
    "blind": _blind,
    "uwb_silent": _uwb_silent,
    "kidnapped": _kidnapped,
    "gap": _gap,
    "slow_lidar": _slow_lidar,
    "sparse": _sparse,
    "lever_arms": _lever_arms,
    "biased": _biased,
    "heights": _heights,
    "heights_robot_only": lambda seed, duration: _heights(seed, duration, beacon_pairs=False),
    "scale": lambda seed, duration: replace(_hall(seed, duration), uwb=Uwb(scale=0.07)),
    "office": _office,
    "large": _large,
}
"""What makes a scenario of a seed and a duration, its own where None [name -> function]."""
SCENARIOS = tuple(_MAKERS)
"""Ready-made scenarios [names]."""
