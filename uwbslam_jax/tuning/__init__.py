"""Gradients through whole recordings: noises, biases and the LiDAR's mounting."""

from uwbslam_jax.tuning.calibration import Calibration as Calibration
from uwbslam_jax.tuning.fit import NoiseFit as NoiseFit, fit as fit
from uwbslam_jax.tuning.likelihood import Objective as Objective
from uwbslam_jax.tuning.rollout import Rollout as Rollout, cropped as cropped, prepare as prepare
from uwbslam_jax.tuning.tune import Log as Log, Tuned as Tuned, check_request as check_request, tune as tune
