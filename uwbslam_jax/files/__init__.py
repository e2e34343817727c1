"""Recordings in, results out: all that is on disk."""

from uwbslam_jax.files import result_log as result_log
from uwbslam_jax.files import ros_types as ros_types
from uwbslam_jax.files import settings_file as settings_file
from uwbslam_jax.files.bag import Source as Source
from uwbslam_jax.files.log_summary import format_summary as format_summary
from uwbslam_jax.files.log_summary import inspect as inspect
from uwbslam_jax.files.mcap_log import LogReader as LogReader
from uwbslam_jax.files.mcap_log import LogWriter as LogWriter
from uwbslam_jax.files.ros_types import recorded as recorded
from uwbslam_jax.files.run_folder import read_run as read_run
from uwbslam_jax.files.run_folder import write_result as write_result
