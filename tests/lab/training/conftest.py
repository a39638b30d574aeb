from __future__ import annotations

from pathlib import Path

import pytest

from hybridvo_lab.synthetic.dataset import Mixture
from hybridvo_lab.synthetic.paper_samples import PaperOptions
from hybridvo_lab.synthetic.training_scenes import DiverseOptions

SIZE = {"height": 32, "width": 64}


@pytest.fixture
def mixture() -> Mixture:
    return Mixture((PaperOptions(**SIZE), DiverseOptions(**SIZE)), (0.5, 0.5))


@pytest.fixture(scope="session")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A few of PWVO's training samples."""
    from hybridvo_lab.training.hypothesis_samples import Makers, write_shard

    folder = tmp_path_factory.mktemp("shards")
    assert write_shard(folder, 0, Makers(), seeds=12) > 4
    return folder
