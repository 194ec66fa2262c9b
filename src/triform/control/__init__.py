"""Controllers behind one interface: expert, scan pipeline and learned policy."""

from triform.control.expert import SENSING_RANGE, Expert, expert_into
from triform.control.learned import LearnedPolicy
from triform.control.registry import CONTROLLERS, make_controller, shipped_weights, weights_folder
from triform.control.scan_pipeline import ScanPipeline
from triform.control.teacher import TEACHERS, Teacher

__all__ = [
    "CONTROLLERS",
    "SENSING_RANGE",
    "TEACHERS",
    "Expert",
    "LearnedPolicy",
    "ScanPipeline",
    "Teacher",
    "expert_into",
    "make_controller",
    "shipped_weights",
    "weights_folder",
]
