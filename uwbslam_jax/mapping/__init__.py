"""A sweep, the cells, the tiles: the map."""

from uwbslam_jax.mapping import grid as grid, sweep as sweep
from uwbslam_jax.mapping.grid import EPOCH_LEVEL as EPOCH_LEVEL, Grid as Grid
from uwbslam_jax.mapping.sweep import (
    Surface as Surface,
    Sweep as Sweep,
    find_surface as find_surface,
    stand_ins as stand_ins,
    undo_motion as undo_motion,
)
from uwbslam_jax.mapping.tiled_map import TILE as TILE, Tiles as Tiles, draw_onto as draw_onto, redraw as redraw
