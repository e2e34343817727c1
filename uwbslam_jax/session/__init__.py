"""One run: frames in, the step, the host's look, a Result out."""

from uwbslam_jax.session import saved_state as saved_state
from uwbslam_jax.session.frame_assembler import FrameAssembler as FrameAssembler, robot_unheard as robot_unheard
from uwbslam_jax.session.message_clocks import MessageClocks as MessageClocks
from uwbslam_jax.session.odometry_track import OdometryTrack as OdometryTrack
from uwbslam_jax.session.recent import Recent as Recent
from uwbslam_jax.session.result_builder import Facts as Facts
from uwbslam_jax.session.runner import PEEK_SCANS as PEEK_SCANS, Runner as Runner, fit_beams as fit_beams
from uwbslam_jax.session.saved_state import Saved as Saved
from uwbslam_jax.session.session import CONTROL_EVERY as CONTROL_EVERY, Session as Session
from uwbslam_jax.session.update import Update as Update
