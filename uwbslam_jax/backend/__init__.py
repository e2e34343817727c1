"""The whole run, solved."""

from uwbslam_jax.backend.final_solution import Hindsight as Hindsight
from uwbslam_jax.backend.final_solution import Question as Question
from uwbslam_jax.backend.final_solution import look_back as look_back
from uwbslam_jax.backend.graph import Graph as Graph
from uwbslam_jax.backend.range_means import Node as Node
from uwbslam_jax.backend.range_means import RangeMeans as RangeMeans
from uwbslam_jax.backend.revision import Reviser as Reviser
from uwbslam_jax.backend.revision import Revision as Revision
from uwbslam_jax.backend.revision import is_news as is_news
from uwbslam_jax.backend.revision import take_over as take_over
from uwbslam_jax.backend.smoothing import Problem as Problem
from uwbslam_jax.backend.smoothing import Solution as Solution
