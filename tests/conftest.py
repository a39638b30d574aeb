from __future__ import annotations

import os
import signal
from pathlib import Path

import numpy as np
import pytest
from hypothesis import settings

from tests.walks import write_walk

SHARED_DATA = Path(
    os.environ.get(
        "HYBRIDVO_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"
    )
)

# no deadline: a busy machine is no failure. HYPOTHESIS_PROFILE=dev draws other examples each time
settings.register_profile("ci", deadline=None, derandomize=True)
settings.register_profile("dev", deadline=None)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "ci"))


def pytest_configure() -> None:
    """Let signals stop what the tests start, also where a shell or nohup ignores them."""
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if (
        hasattr(signal, "SIGHUP")
        and signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    ):
        signal.signal(signal.SIGHUP, signal.SIG_DFL)


@pytest.fixture
def shared_data() -> Path:
    """Real sequences with ground truth; tests that need them are skipped where they are absent."""
    if not SHARED_DATA.is_dir():
        pytest.skip(
            f"real sequences not found at {SHARED_DATA} (set HYBRIDVO_DATA)"
        )
    return SHARED_DATA


@pytest.fixture
def read_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Recordings are read in this process, as where no child can be limited."""
    monkeypatch.setattr(
        "hybridvo.io.data.confined.limits.is_available", lambda: False
    )


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)


@pytest.fixture(scope="session")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sequence of six frames of 32x48 with flow files and true poses; read it, change nothing."""
    return write_walk(tmp_path_factory.mktemp("session") / "walk", 6)


@pytest.fixture(scope="session")
def image_walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sequence of five frames of 64x96 with images; read it, change nothing."""
    root = tmp_path_factory.mktemp("session") / "image_walk"
    return write_walk(root, 5, height=64, width=96, pictures=True)
