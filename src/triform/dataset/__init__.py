"""Demonstrations: collecting, storing and reading them."""

from __future__ import annotations

from triform.dataset.collect import Progress, collect
from triform.dataset.configuration import PRESETS, CollectionConfig
from triform.dataset.fresh import FreshBatch, StateConfig, draw_fresh
from triform.dataset.inputs import fresh_inputs
from triform.dataset.manifest import MANIFEST, Manifest, Shard, load_manifest
from triform.dataset.neighbours import COLUMNS, neighbours
from triform.dataset.reader import Demonstrations, Split
from triform.dataset.records import Records
from triform.dataset.scenes import SceneConfig, Views, draw_views
from triform.dataset.state_buffer import StateBuffer, joined
from triform.dataset.teams import TeamLabels, TeamStates, draw_states, label_states

__all__ = [
    "COLUMNS",
    "MANIFEST",
    "PRESETS",
    "CollectionConfig",
    "Demonstrations",
    "FreshBatch",
    "Manifest",
    "Progress",
    "Records",
    "SceneConfig",
    "Shard",
    "Split",
    "StateBuffer",
    "StateConfig",
    "TeamLabels",
    "TeamStates",
    "Views",
    "collect",
    "draw_fresh",
    "draw_states",
    "draw_views",
    "fresh_inputs",
    "joined",
    "label_states",
    "load_manifest",
    "neighbours",
]
