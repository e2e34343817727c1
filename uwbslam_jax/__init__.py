"""Range-aided 2D SLAM: LiDAR and UWB ranges in, track, beacons and map out."""

from uwbslam_jax import process

__version__ = "0.1.0"

process.prepare()  # before JAX and numpy are imported, which read their settings once
