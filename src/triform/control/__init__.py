"""Controllers behind one interface: expert, scan pipeline and learned policy."""

from triform.control.expert import Expert, expert_into
from triform.control.teacher import TEACHERS, Teacher, get_teacher

__all__ = ["TEACHERS", "Expert", "Teacher", "expert_into", "get_teacher"]
