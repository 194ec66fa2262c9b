"""Learning: one loop, its presets and its logs."""

from triform.training.checkpoints import Progress
from triform.training.loop import train
from triform.training.presets import PRESETS, Precision, TrainConfig, get_preset

__all__ = ["PRESETS", "Precision", "Progress", "TrainConfig", "get_preset", "train"]
