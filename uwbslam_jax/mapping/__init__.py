"""A sweep, the cells, the tiles: the map."""

from uwbslam_jax.mapping import grid as grid
from uwbslam_jax.mapping.grid import EPOCH_LEVEL as EPOCH_LEVEL
from uwbslam_jax.mapping.grid import Grid as Grid
from uwbslam_jax.mapping.sweep import Surface as Surface
from uwbslam_jax.mapping.sweep import Sweep as Sweep
from uwbslam_jax.mapping.sweep import find_surface as find_surface
from uwbslam_jax.mapping.sweep import stand_ins as stand_ins
from uwbslam_jax.mapping.sweep import undo_motion as undo_motion
from uwbslam_jax.mapping.tiled_map import TILE as TILE
from uwbslam_jax.mapping.tiled_map import Tiles as Tiles
from uwbslam_jax.mapping.tiled_map import draw_onto as draw_onto
from uwbslam_jax.mapping.tiled_map import redraw as redraw
