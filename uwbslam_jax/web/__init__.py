"""The report and the live page."""

from uwbslam_jax.web.live_page import LivePage as LivePage, Status as Status
from uwbslam_jax.web.report import write_report as write_report
from uwbslam_jax.web.server import LiveView as LiveView, parse_address as parse_address
