from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from matplotlib.figure import Figure

from hybridvo.core.errors import OutputError
from hybridvo.core.geometry import se3_exp
from hybridvo.core.trajectory import Trajectory
from hybridvo.lab.evaluation.metrics import evaluate
from hybridvo.lab.visualization.trajectory import plot_trajectory, trajectory_figure
from tests.walks import chained

ORANGE = (0xE6, 0x9F, 0x00)
RED = (0xD5, 0x5E, 0x00)


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


def test_doubtful_motions_and_the_end_are_marked(tmp_path, rng):
    truth = random_trajectory(rng)
    path = tmp_path / "p.png"
    states = ["ok"] * 30
    plot_trajectory("a", truth, path, truth=truth, states=states)
    assert coloured(path, ORANGE) == coloured(path, RED) == 0
    states[7] = "degraded"
    states[20] = "failed"
    plot_trajectory("a", truth, path, truth=truth, states=states)
    assert coloured(path, ORANGE) > 20 and coloured(path, RED) > 20
    figure = trajectory_figure("a", truth, truth=truth, states=states)
    names = [text.get_text() for text in figure.legends[0].get_texts()]
    assert names[0] == "ground truth" and names[1].startswith("a (ATE ")
    assert names[2:] == ["start", "end", "degraded (1)", "failed (1)"]
    above, _ = figure.axes
    by_name = {line.get_label(): line for line in above.lines}
    ours = truth.transformed(np.linalg.inv(truth.T_world_cam[0])).positions
    for name, k in (
        ("start", 0),
        ("end", 29),
        ("degraded (1)", 7),
        ("failed (1)", 20),
    ):
        np.testing.assert_allclose(
            by_name[name].get_xydata(), ours[[k]][:, [0, 2]], atol=1e-6
        )


def test_picture_and_text_agree_where_poses_are_too_few(rng):
    two = random_trajectory(rng, 2)
    figure = trajectory_figure("a", two, truth=two)
    (name,) = (
        t.get_text() for t in figure.legends[0].get_texts() if "ATE" in t.get_text()
    )
    assert evaluate(two, two)["ate_rmse"] is None
    assert "not enough poses" in name and "cm" not in name


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


def straight_with_band(sigma: float, unknown: int | None = None) -> Figure:
    """A path of nine metres ahead; its sigma grows from zero."""
    T = np.tile(np.eye(4), (10, 1, 1))
    T[:, 2, 3] = np.arange(10)
    truth = Trajectory(np.arange(10) / 10, T)
    variances = (sigma * np.arange(10) / 9) ** 2
    covariances = variances[:, None, None] * np.diag([1.0, 4.0, 9.0])
    if unknown is not None:
        covariances[unknown] = np.nan
    return trajectory_figure("a", truth, truth=truth, covariances=covariances)


def test_three_sigma_are_a_band_around_the_path():
    above, below = straight_with_band(0.1).axes
    (band,) = above.collections[-1].get_paths()
    # the path goes along z, whose own sigma does not widen it
    np.testing.assert_allclose(np.abs(band.vertices[:, 0]).max(), 0.3)
    (band,) = below.collections[-1].get_paths()
    total = 0.1 * np.sqrt(1 + 4 + 9)
    np.testing.assert_allclose(band.vertices[:, 1].max(), 100 * 3 * total)


def test_the_band_has_a_gap_where_nothing_is_known():
    above, _ = straight_with_band(0.1, unknown=5).axes
    first, second = above.collections[-1].get_paths()
    assert first.vertices[:, 1].max() == 4
    assert second.vertices[:, 1].min() == 6


def test_a_broad_band_does_not_hide_the_path():
    narrow, _ = straight_with_band(0.001).axes
    broad, _ = straight_with_band(100.0).axes
    assert broad.get_xlim() == narrow.get_xlim()
    assert broad.get_ylim() == narrow.get_ylim()
