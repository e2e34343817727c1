"""The whole run, solved."""

from uwbslam_jax.backend.back_end import BackEnd as BackEnd, notable as notable
from uwbslam_jax.backend.final_solution import Hindsight as Hindsight
from uwbslam_jax.backend.graph import Graph as Graph
from uwbslam_jax.backend.smoothing import Problem as Problem, Solution as Solution
