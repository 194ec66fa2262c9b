"""Controllers behind one interface: expert, scan pipeline and learned policy."""

from triform.control.expert import EXPERTS, Expert, ExpertVariant, expert_into, expert_variant
from triform.control.learned import LearnedPolicy
from triform.control.registry import CONTROLLERS, make_controller, shipped_weights, weights_folder
from triform.control.scan_pipeline import ScanPipeline
from triform.control.teacher import Teacher
from triform.control.triangulating import Triangulating, TriangulatingLaw

__all__ = [
    "CONTROLLERS",
    "EXPERTS",
    "Expert",
    "ExpertVariant",
    "LearnedPolicy",
    "ScanPipeline",
    "Teacher",
    "Triangulating",
    "TriangulatingLaw",
    "expert_into",
    "expert_variant",
    "make_controller",
    "shipped_weights",
    "weights_folder",
]
