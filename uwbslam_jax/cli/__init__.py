"""The commands of the command line."""

from uwbslam_jax.cli import commands as commands
