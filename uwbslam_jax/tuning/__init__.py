"""Gradients through whole recordings: noises, biases and the LiDAR's mounting."""

from uwbslam_jax.tuning import calibration as calibration
from uwbslam_jax.tuning import parameters as parameters
from uwbslam_jax.tuning.calibration import Calibration as Calibration
from uwbslam_jax.tuning.fit import Tuned as Tuned
from uwbslam_jax.tuning.fit import fit as fit
from uwbslam_jax.tuning.likelihood import Objective as Objective
from uwbslam_jax.tuning.likelihood import Piece as Piece
from uwbslam_jax.tuning.likelihood import Score as Score
from uwbslam_jax.tuning.likelihood import piece as piece
from uwbslam_jax.tuning.rollout import prepare as prepare
