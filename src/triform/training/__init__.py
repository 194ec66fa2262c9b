"""Learning: one loop, its presets and its logs."""

from triform.training.checkpoints import Progress
from triform.training.loop import train
from triform.training.presets import PRESETS, Precision, TrainConfig

__all__ = ["PRESETS", "Precision", "Progress", "TrainConfig", "train"]
