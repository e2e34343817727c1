"""The whole run, solved."""

from uwbslam_jax.backend.final_solution import Hindsight as Hindsight, Question as Question, look_back as look_back
from uwbslam_jax.backend.graph import Graph as Graph
from uwbslam_jax.backend.range_means import Node as Node, RangeMeans as RangeMeans
from uwbslam_jax.backend.revision import (
    Reviser as Reviser,
    Revision as Revision,
    is_news as is_news,
    take_over as take_over,
)
from uwbslam_jax.backend.smoothing import Problem as Problem, Solution as Solution
