"""Rollouts, measures, tables and figures.

The modules that draw (``figures``, ``animation``, ``reproduce``, ``sweep``, ``demo``) need matplotlib and are imported
by their own names, so that evaluating needs none of it.
"""

from triform.evaluation.dynamic import ChangedRuns, DynamicConfig, run_changes, run_dynamic, summarise_changes
from triform.evaluation.evaluate import EvaluateConfig, Evaluation, evaluate, run_evaluation
from triform.evaluation.metrics import RunTable, converge_time, measure, summarise, trailing_mean
from triform.evaluation.rollout import Trajectory, rollout
from triform.evaluation.scenario import Scenario

__all__ = [
    "ChangedRuns",
    "DynamicConfig",
    "EvaluateConfig",
    "Evaluation",
    "RunTable",
    "Scenario",
    "Trajectory",
    "converge_time",
    "evaluate",
    "measure",
    "rollout",
    "run_changes",
    "run_dynamic",
    "run_evaluation",
    "summarise",
    "summarise_changes",
    "trailing_mean",
]
