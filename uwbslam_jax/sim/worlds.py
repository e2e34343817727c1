"""Worlds of line segments to simulate in: a workshop, random halls, a corridor, an office.

A world is walls and furniture seen from above. Nothing here moves, measures or knows noise; rays are in `rays`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from uwbslam_jax.sim.paths import Track
from uwbslam_jax.sim.rays import point_segment_distance

Point = Sequence[float] | np.ndarray
"""x, y [m]."""
CLEARANCE = 0.7
"""Furniture stays this far from the route [m]: a robot and who carries a beacon beside it fit through."""
WIDEST_CORNER = 1.5
"""Routes of a corner radius up to this keep the clearance [m]: those of the catalogue have up to 1.2 m."""


@dataclass(frozen=True)
class World:
    """A place seen from above.

    Attributes:
      segments: (S, 4) float64, x1, y1, x2, y2 of each piece of wall or furniture [m].
      name: what it is.
      lap: (W, 2) waypoints of a route that is free of obstacles [m]; closed, but for the corridor.
      outline: (V, 2) corners of the floor [m].
    """

    segments: np.ndarray
    name: str
    lap: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    outline: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))

    def placed(self, pose: Sequence[float]) -> World:
        """This world turned by pose[2] [rad], then shifted by pose[:2] [m]."""
        segments = place(pose, self.segments.reshape(-1, 2)).reshape(-1, 4)
        return replace(self, segments=segments, lap=place(pose, self.lap), outline=place(pose, self.outline))


def place(pose: Sequence[float], points: np.ndarray) -> np.ndarray:
    """points (n, 2) [m] from the frame at pose (x, y [m], yaw [rad]) into the frame that pose is given in, (n, 2)."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return points @ np.array([[c, s], [-s, c]]) + np.asarray(pose[:2])


# What is where --------------------------------------------------------------------------------------------------------


def inside(outline: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Whether points (n, 2) lie in the polygon outline (V, 2) [m]; (n,) bool."""
    return _enclosed(polygon(outline), points)


def free(world: World, points: np.ndarray) -> np.ndarray:
    """Whether points (n, 2) lie on the floor and in no furniture; for worlds of closed shapes. (n,) bool."""
    return _enclosed(world.segments, points)


def _enclosed(segments: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Whether the ray from each point (n, 2) towards +x meets an odd number of segments (S, 4), (n,) bool."""
    x1, y1, x2, y2 = segments.T
    x, y = points[:, :1], points[:, 1:]
    straddles = (y1 > y) != (y2 > y)
    crossed = straddles & (x < x1 + (y - y1) * (x2 - x1) / np.where(y1 == y2, 1.0, y2 - y1))
    return np.sum(crossed, axis=1) % 2 == 1


# Building blocks -----------------------------------------------------------------------------------------------------


def polygon(corners: np.ndarray) -> np.ndarray:
    """Segments (V, 4) around the corners (V, 2) [m]."""
    return np.hstack([corners, np.roll(corners, -1, axis=0)])


def box(centre: Point, size: Point, angle: float = 0.0) -> np.ndarray:
    """Corners (4, 2) of a box of a size (length, width) [m] turned by angle [rad]."""
    half = 0.5 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * np.asarray(size)
    return place((centre[0], centre[1], angle), half)


def _ring(centre: np.ndarray, radius: float, corners: int = 8) -> np.ndarray:
    """Corners (corners, 2) of a round column of a radius [m]."""
    turn = 2.0 * np.pi * np.arange(corners) / corners
    return centre + radius * np.stack([np.cos(turn), np.sin(turn)], -1)


class _Floor:
    """A floor being furnished: takes a shape only where it disturbs neither the route nor other shapes."""

    def __init__(self, outline: np.ndarray, lap: np.ndarray):
        self.outline, self.lap, self.segments = outline, lap, polygon(outline)
        route = [Track(lap, radius, closed=True).sample(0.2)[:, :2] for radius in (0.3, WIDEST_CORNER)]
        self.route = np.concatenate(route)

    def put(self, shape: np.ndarray, gap: float = 0.03) -> bool:
        """Adds a shape (V, 2) [m] if it lies on the floor, `gap` [m] from all others; says whether it did."""
        if np.min(np.hypot(*(self.route - shape.mean(0)).T)) < CLEARANCE:  # most are refused here, cheaply
            return False
        edges, corners = polygon(shape), self.segments[:, :2]
        marks = np.concatenate([edges[:, :2] + f * (edges[:, 2:] - edges[:, :2]) for f in np.linspace(0, 1, 9)])
        ok = np.all(_enclosed(self.segments, marks)) and not np.any(inside(shape, corners))
        ok = ok and point_segment_distance(self.route, edges).min() > CLEARANCE
        ok = ok and point_segment_distance(marks, self.segments).min() > gap
        ok = ok and point_segment_distance(corners, edges).min() > gap
        if ok:
            self.segments = np.concatenate([self.segments, edges])
        return bool(ok)

    def scatter(self, count: int, draw: Callable[[], np.ndarray], gap: float = 0.03) -> None:
        """Adds up to `count` shapes from draw() -> (V, 2); gives up on a full floor."""
        put = 0
        for _ in range(40 * count):
            put += self.put(draw(), gap)
            if put == count:
                return

    def world(self, name: str) -> World:
        return World(self.segments, name, self.lap, self.outline)


def _wall_with_niches(rng: np.random.Generator, width: float, depth: float, share: float) -> np.ndarray:
    """Corners (V, 2) of a room width x depth [m] with niches (outward) and pilasters (inward) along its walls.

    share is the part of places along a wall that has one.
    """
    corners = np.array([[0.0, 0.0], [width, 0.0], [width, depth], [0.0, depth]])
    outline = []
    for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        length = float(np.hypot(*(end - start)))
        along = (end - start) / length
        outward = np.array([along[1], -along[0]])
        outline.append(start)
        at = rng.uniform(0.6, 1.6)
        while at < length - 3.2:
            span = rng.uniform(0.5, 2.4)
            out = rng.uniform(0.15, 0.9) if rng.uniform() < 0.65 else -rng.uniform(0.12, 0.35)
            if rng.uniform() < share:
                for s, o in ((at, 0.0), (at, out), (at + span, out), (at + span, 0.0)):
                    outline.append(start + s * along + o * outward)
            at += span + rng.uniform(0.7, 2.2)
    return np.array(outline)


def _against_wall(rng: np.random.Generator, width: float, depth: float, size: tuple[float, float]) -> np.ndarray:
    """Corners of a box of a size (length, width) [m] with its long side at a wall of the room width x depth."""
    side = rng.integers(4)
    gap = rng.uniform(0.04, 0.12) + 0.5 * size[1]
    length = width if side % 2 == 0 else depth
    at = rng.uniform(0.5 * size[0] + 0.1, length - 0.5 * size[0] - 0.1)
    centre = [(at, gap), (width - gap, at), (at, depth - gap), (gap, at)][side]
    return box(centre, size, 0.5 * np.pi * (side % 2))


def _furnish(rng: np.random.Generator, floor: _Floor, width: float, depth: float, tilt: float) -> None:
    """Benches and shelves along the walls, machines and pillars on the floor; tilt [rad] is how skew they stand."""

    def anywhere(low: tuple[float, float], high: tuple[float, float]) -> np.ndarray:
        centre = rng.uniform([0.6, 0.6], [width - 0.6, depth - 0.6])
        return box(centre, rng.uniform(low, high), rng.normal(0.0, tilt))

    grid = [(0.5 * width, 0.28 * depth), (0.5 * width, 0.5 * depth), (0.5 * width, 0.72 * depth)]
    for centre in grid:  # the columns that carry the roof
        if rng.uniform() < 0.7:
            floor.put(box(np.array(centre) + rng.normal(0, 0.15, 2), (0.35, 0.35)))
    floor.scatter(6, lambda: _against_wall(rng, width, depth, (rng.uniform(1.2, 2.4), rng.uniform(0.6, 0.8))))
    floor.scatter(4, lambda: _against_wall(rng, width, depth, (rng.uniform(0.8, 1.4), rng.uniform(0.35, 0.5))))
    floor.scatter(4, lambda: anywhere((0.8, 0.6), (2.0, 1.2)), gap=0.3)
    floor.scatter(4, lambda: anywhere((0.25, 0.25), (0.7, 0.5)), gap=0.25)
    floor.scatter(2, lambda: _ring(rng.uniform([0.6, 0.6], [width - 0.6, depth - 0.6]), rng.uniform(0.15, 0.3)), 0.25)


# Worlds --------------------------------------------------------------------------------------------------------------


def workshop(seed: int = 0) -> World:
    """The 12 x 19 m workshop: benches and shelves along the walls, machines on the floor, a lap of 38.5 m between."""
    rng = np.random.default_rng([seed, 12, 19])
    width, depth = 12.0, 19.0
    lap = np.array([[2.65, 2.7], [9.35, 2.7], [9.35, 16.3], [2.65, 16.3]])
    floor = _Floor(_wall_with_niches(rng, width, depth, 0.35), lap)
    _furnish(rng, floor, width, depth, tilt=0.05)
    return floor.world("workshop")


def hall(seed: int, size: tuple[float, float] | None = None) -> World:
    """A random hall of 10-16 x 14-22 m (or of a given size [m]) with niches, furniture and a free lap."""
    rng = np.random.default_rng([seed, 14, 22])
    drawn = rng.uniform([10.0, 14.0], [16.0, 22.0])
    width, depth = drawn if size is None else size
    left, right, low, high = rng.uniform(2.2, 2.8, 4)
    lap = np.array([[left, low], [width - right, low], [width - right, depth - high], [left, depth - high]])
    if size is None:  # no right angles, and the long sides bend a little in the middle
        middle = 0.5 * (lap[[1, 3]] + lap[[2, 0]]) + rng.uniform(-0.6, 0.6, (2, 1)) * np.array([1.0, 0.0])
        lap += rng.uniform(-0.3, 0.3, (4, 2))
        lap = np.array([lap[0], lap[1], middle[0], lap[2], lap[3], middle[1]])
    floor = _Floor(_wall_with_niches(rng, width, depth, 0.6), lap)
    _furnish(rng, floor, width, depth, tilt=0.4)
    return floor.world("hall")


def corridor(length: float = 22.7, width: float = 2.4, recesses: bool = False, seed: int = 0) -> World:
    """A straight corridor [m], bare or with doors set back into its walls at irregular places."""
    rng = np.random.default_rng([seed, 22, 7])
    outline = [np.array([0.0, 0.0])]
    for wall, direction in ((0.0, 1.0), (width, -1.0)):
        along = []
        at = rng.uniform(1.0, 2.5)
        while recesses and at < length - 1.6:
            span, deep = rng.uniform(0.8, 1.2), rng.uniform(0.1, 0.25)
            along += [(at, 0.0), (at, deep), (at + span, deep), (at + span, 0.0)]
            at += span + rng.uniform(0.8, 3.0)
        for s, o in along:
            outline.append(np.array([s if direction > 0 else length - s, wall - direction * o]))
        outline.append(np.array([length if direction > 0 else 0.0, wall]))
        if direction > 0:
            outline.append(np.array([length, width]))
    lap = np.array([[1.4, 0.5 * width], [length - 1.4, 0.5 * width]])
    corners = np.array(outline)
    return World(polygon(corners), "corridor", lap, corners)


def office(seed: int = 0, size: tuple[float, float] = (60.0, 40.0), corridor_width: float = 2.2) -> World:
    """An office floor [m]: rooms along the outside, a corridor all round, a core of rooms; some doors stand open."""
    rng = np.random.default_rng([seed, 60, 40])
    width, depth = size
    outer = rng.uniform(4.6, 5.2)  # depth of the rooms along the facade
    near, far = outer, outer + corridor_width
    insets = (0.0, near, far, far + 4.5, 0.5 * (near + far))
    facade, ring, core, back, lap = (box((0.5 * width, 0.5 * depth), (width - 2 * m, depth - 2 * m)) for m in insets)
    segments = [polygon(facade), polygon(back)]
    for corners, inward in ((ring, -1.0), (core, 1.0)):
        room = near if inward < 0 else 4.5
        for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            segments.append(_rooms(rng, start, end, inward * room))
    return World(np.concatenate(segments), "office", lap, facade)


def _rooms(rng: np.random.Generator, start: np.ndarray, end: np.ndarray, deep: float) -> np.ndarray:
    """One corridor wall from start to end (2,) with a row of rooms `deep` [m] behind it (left of it if > 0), (n, 4)."""
    length = float(np.hypot(*(end - start)))
    along = (end - start) / length
    across = np.array([-along[1], along[0]])
    side, lines = np.sign(deep), []

    def line(*points: tuple[float, float]) -> None:
        world = [start + s * along + o * across for s, o in points]
        lines.extend(np.concatenate(pair) for pair in pairwise(world))

    at = 0.0
    while at < length - 1e-9:
        span = rng.uniform(2.8, 6.0)
        span = length - at if length - at - span < 2.8 else span
        door = at + rng.uniform(0.4, span - 1.4)
        recess = side * rng.uniform(0.06, 0.2)
        line((at, 0.0), (door, 0.0), (door, recess))
        line((door + 0.9, recess), (door + 0.9, 0.0), (at + span, 0.0))
        if rng.uniform() < 0.4:  # open: the leaf stands in the room, which is seen through the gap
            line((door, recess), (door + 0.15, recess + side * 0.88))
            desk = box((at + 0.5 * span, 0.7 * deep), rng.uniform([1.2, 0.6], [1.8, 0.9]), rng.normal(0, 0.1))
            lines.extend(polygon(place((*start, np.arctan2(along[1], along[0])), desk)))
        else:
            line((door, recess), (door + 0.9, recess))
        at += span
        if at < length - 1e-9:
            line((at, 0.0), (at, deep))
    return np.array(lines)
