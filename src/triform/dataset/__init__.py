"""Demonstrations: collecting, storing and reading them."""

from __future__ import annotations

from triform.dataset.collect import Progress, collect
from triform.dataset.configuration import PAPER, PRESETS, QUICK, CollectionConfig
from triform.dataset.fresh import FreshBatch, StateConfig, draw_fresh
from triform.dataset.manifest import MANIFEST, Manifest, Shard, load_manifest
from triform.dataset.neighbours import neighbours
from triform.dataset.reader import Demonstrations, Split
from triform.dataset.records import Records

__all__ = [
    "MANIFEST",
    "PAPER",
    "PRESETS",
    "QUICK",
    "CollectionConfig",
    "Demonstrations",
    "FreshBatch",
    "Manifest",
    "Progress",
    "Records",
    "Shard",
    "Split",
    "StateConfig",
    "collect",
    "draw_fresh",
    "load_manifest",
    "neighbours",
]
