"""Learning: one loop, its presets and its logs."""

from triform.training.loop import Progress, train
from triform.training.presets import PRESETS, TrainConfig, get_preset

__all__ = ["PRESETS", "Progress", "TrainConfig", "get_preset", "train"]
