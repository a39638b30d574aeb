from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from hybridvo.core.errors import OutputError
from hybridvo.core.geometry import se3_exp
from hybridvo.core.trajectory import Trajectory
from hybridvo_lab.visualization.trajectory import plot_trajectory
from tests.walks import chained


def random_trajectory(rng: np.random.Generator, frames: int = 30) -> Trajectory:
    relative = [se3_exp(0.1 * rng.standard_normal(6)) for _ in range(frames - 1)]
    return chained(relative, 1e9 + np.arange(frames) / 30)


def coloured(path: Path, rgb: tuple[int, int, int]) -> int:
    """Pixels of exactly this colour."""
    image = cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB)
    return int((image == rgb).all(axis=-1).sum())


def test_picture_shows_the_path_beside_the_truth(tmp_path, rng):
    truth = random_trajectory(rng)
    path = tmp_path / "trajectory.png"
    T = truth.T_world_cam.copy()
    T[:, :3, 3] *= 1.2
    plot_trajectory(
        "hybrid", Trajectory(truth.timestamps, T), path, truth=truth, title="x"
    )
    image = cv2.imread(str(path))
    assert image.shape[0] > 600 and image.shape[1] > 1000
    assert coloured(path, (0x00, 0x72, 0xB2)) > 500
    assert os.listdir(tmp_path) == ["trajectory.png"]
    with pytest.raises(OutputError, match=r"p\.png: cannot be written"):
        plot_trajectory("a", truth, tmp_path / "no" / "p.png")


@pytest.mark.parametrize(
    "case", ["static", "straight", "one", "two", "unmatched", "no truth"]
)
def test_degenerate_paths_are_drawn(tmp_path, rng, case):
    frames = {"one": 1, "two": 2}.get(case, 10)
    T = np.tile(np.eye(4), (frames, 1, 1))
    if case != "static":
        T[:, 2, 3] = np.arange(frames)
    trajectory = Trajectory(np.arange(frames) / 10, T)
    truth = None if case == "no truth" else trajectory
    if case == "unmatched":
        truth = Trajectory(np.arange(frames) / 10 + 1e5, T)
    plot_trajectory("a", trajectory, tmp_path / "p.png", truth=truth)
    assert cv2.imread(str(tmp_path / "p.png")) is not None
