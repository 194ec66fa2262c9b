"""Controllers behind one interface, and the loop that drives any team with any of them."""

from triform.control.expert import EXPERTS, Expert, ExpertVariant, Springs, expert_into, expert_variant
from triform.control.gnn import GnnController
from triform.control.intensity import IntensityThreshold, bright_returns
from triform.control.learned import LearnedPolicy, view_maps
from triform.control.loop import control_steps, drive
from triform.control.mixed import MixedController, decide
from triform.control.orca import OrcaFilter, OrcaSettings
from triform.control.registry import (
    CONTROLLERS,
    POLICY,
    ControllerSpec,
    make_controller,
    shipped_weights,
    sight_of,
    weights_folder,
)
from triform.control.safety import (
    SafetyFilter,
    SafetySettings,
    free_velocities,
    limit_by_scans,
    reaction_time,
    rolling_arcs,
)
from triform.control.scan_pipeline import ScanPipeline
from triform.control.sight import Sight, has_sight
from triform.control.teacher import Teacher
from triform.control.triangulating import Triangulating, TriangulatingLaw

__all__ = [
    "CONTROLLERS",
    "EXPERTS",
    "POLICY",
    "ControllerSpec",
    "Expert",
    "ExpertVariant",
    "GnnController",
    "IntensityThreshold",
    "LearnedPolicy",
    "MixedController",
    "OrcaFilter",
    "OrcaSettings",
    "SafetyFilter",
    "SafetySettings",
    "ScanPipeline",
    "Sight",
    "Springs",
    "Teacher",
    "Triangulating",
    "TriangulatingLaw",
    "bright_returns",
    "control_steps",
    "decide",
    "drive",
    "expert_into",
    "expert_variant",
    "free_velocities",
    "has_sight",
    "limit_by_scans",
    "make_controller",
    "reaction_time",
    "rolling_arcs",
    "shipped_weights",
    "sight_of",
    "view_maps",
    "weights_folder",
]
