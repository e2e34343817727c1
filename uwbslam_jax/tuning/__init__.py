"""Gradients through whole recordings: noises, biases and the LiDAR's mounting."""

from uwbslam_jax.tuning import calibration as calibration, parameters as parameters
from uwbslam_jax.tuning.calibration import Calibration as Calibration
from uwbslam_jax.tuning.fit import NoiseFit as NoiseFit, fit as fit
from uwbslam_jax.tuning.likelihood import Objective as Objective, Piece as Piece, Score as Score, piece as piece
from uwbslam_jax.tuning.rollout import prepare as prepare
