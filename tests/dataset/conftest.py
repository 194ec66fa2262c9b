from __future__ import annotations

from pathlib import Path

import pytest

from triform.dataset import CollectionConfig, Demonstrations, collect
from triform.engines import LocalEngine

#: Nine shards: five of roll-outs (one shared), the rest of placements; the last row groups and blocks are not full.
SMALL = CollectionConfig(
    robots=5,
    runs=9,
    steps=30,
    placements=235,
    seed=3,
    validation_share=0.25,
    block_placements=30,
    shard_runs=2,
    group_records=13,
)


def contents(folder: Path) -> dict[str, bytes]:
    """Every file of a data set."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.fixture(scope="session")
def small_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A complete small data set; do not change it."""
    folder = tmp_path_factory.mktemp("small")
    collect(folder, SMALL, engine=LocalEngine(1))
    return folder


@pytest.fixture
def small(small_folder: Path) -> Demonstrations:
    return Demonstrations.open(small_folder)
