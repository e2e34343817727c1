"""Recordings in, results out: all that is on disk."""

from uwbslam_jax.files import (
    mounting as mounting,
    result_log as result_log,
    ros_types as ros_types,
    settings_file as settings_file,
)
from uwbslam_jax.files.log_summary import LogSummary as LogSummary, inspect_log as inspect_log
from uwbslam_jax.files.mcap_log import LogWriter as LogWriter, Recording as Recording
from uwbslam_jax.files.ros_types import recorded as recorded
from uwbslam_jax.files.run_folder import read_run as read_run, write_result as write_result
from uwbslam_jax.files.settings_file import load_settings as load_settings, save_settings as save_settings
