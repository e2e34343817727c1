"""The report and the live page."""

from uwbslam_jax.web.live_page import LivePage as LivePage
from uwbslam_jax.web.live_page import Status as Status
from uwbslam_jax.web.report import write_report as write_report
from uwbslam_jax.web.server import LiveView as LiveView
from uwbslam_jax.web.server import parse_address as parse_address
