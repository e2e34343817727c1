"""Devices at work: a live run."""

from uwbslam_jax.live.devices import Devices as Devices
from uwbslam_jax.live.live_run import LiveRun as LiveRun
from uwbslam_jax.live.publisher import Publisher as Publisher
from uwbslam_jax.live.recorder import DROPPED as DROPPED
from uwbslam_jax.live.warm_up import rehearse as rehearse
