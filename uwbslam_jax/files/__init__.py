"""Recordings in, results out: all that is on disk."""

from uwbslam_jax.files import result_log as result_log, ros_types as ros_types, settings_file as settings_file
from uwbslam_jax.files.bag import Source as Source
from uwbslam_jax.files.log_summary import format_summary as format_summary, inspect as inspect
from uwbslam_jax.files.mcap_log import LogReader as LogReader, LogWriter as LogWriter
from uwbslam_jax.files.ros_types import recorded as recorded
from uwbslam_jax.files.run_folder import read_run as read_run, write_result as write_result
