from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from hybridvo_lab.synthetic.render import write_sintel
from hybridvo_lab.synthetic.scenes import make_scene

FRAMES = 6


@pytest.fixture(scope="session")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six rendered frames of a static scene in Sintel's layout."""
    root = tmp_path_factory.mktemp("sintel")
    write_sintel(
        make_scene("static", 3, height=96, width=160, frames=FRAMES), root, "static"
    )
    return root / "training" / "clean" / "static"


@pytest.fixture
def own(dataset: Path, tmp_path: Path) -> Path:
    """A copy of it that a test may damage."""
    root = tmp_path / "own"
    shutil.copytree(dataset.parents[2], root)
    return root / "training" / "clean" / "static"
