"""Demonstrations: collecting, storing and reading them."""

from __future__ import annotations

from triform.dataset.collect import Progress, collect
from triform.dataset.configuration import PAPER, PRESETS, QUICK, CollectionConfig
from triform.dataset.manifest import Manifest, Shard, load_manifest
from triform.dataset.reader import Demonstrations, Split
from triform.dataset.records import Records
from triform.dataset.teachers import TEACHERS

__all__ = [
    "PAPER",
    "PRESETS",
    "QUICK",
    "TEACHERS",
    "CollectionConfig",
    "Demonstrations",
    "Manifest",
    "Progress",
    "Records",
    "Shard",
    "Split",
    "collect",
    "load_manifest",
]
