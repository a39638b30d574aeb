"""Figures of a camera whose true position never changes, and the moving picture."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from tests.scripts import ROOT, load_script

people = load_script("tools/bench/moving_people.py")
teaser = load_script("tools/make_figure.py")


def moved(x_m: float, yaw_deg: float = 0.0) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("y", yaw_deg, degrees=True).as_matrix()
    T[0, 3] = x_m
    return T


def test_every_distance_from_the_start_is_an_error() -> None:
    """0, 3 and 4 cm: the root of 25 / 3; 0, 1 and 1 degree beside the true turn."""
    poses = np.stack([moved(0.0), moved(0.03, 3.0), moved(-0.04, 5.0)])
    R_true = np.stack(
        [moved(0, 0)[:3, :3], moved(0, 2)[:3, :3], moved(0, 4)[:3, :3]]
    )
    row = people.figures(people.Path6(poses, "1 px"), R_true)
    assert row["rmse_cm"] == pytest.approx(np.sqrt(25 / 3), rel=1e-3)
    assert row["worst_cm"] == pytest.approx(4.0)
    assert row["rmse_deg"] == pytest.approx(np.sqrt(2 / 3), rel=1e-3)
    assert row["chosen"] == "1 px"


def test_the_readme_shows_ten_seconds_below_three_megabytes() -> None:
    path = ROOT / "docs" / "teaser.gif"
    assert path.stat().st_size < 3_000_000
    times = []
    with Image.open(path) as made:
        for index in range(made.n_frames):
            made.seek(index)
            times.append(made.info["duration"])
    assert sum(times) == pytest.approx(10_000, rel=0.03)
