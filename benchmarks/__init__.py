"""Measured figures: each module is run by `python -m` and writes its tables to results/."""

import uwbslam_jax as uwbslam_jax  # before numpy and JAX, whose threads and cache it sets up
