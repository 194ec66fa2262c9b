"""Runs and their measures: scenarios, rollouts, events, metrics."""

from triform.evaluation.metrics import RunTable, converge_time, measure, summarise, trailing_mean
from triform.evaluation.rollout import Trajectory, rollout
from triform.evaluation.scenario import Scenario

__all__ = [
    "RunTable",
    "Scenario",
    "Trajectory",
    "converge_time",
    "measure",
    "rollout",
    "summarise",
    "trailing_mean",
]
