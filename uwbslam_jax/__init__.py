"""Range-aided 2D SLAM: LiDAR and UWB ranges in, track, beacons and map out."""

__version__ = "0.1.0"
