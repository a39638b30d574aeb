"""Figures of a camera whose true position never changes, and the moving picture."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

import hybridvo as hvo
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


def test_the_best_path_is_chosen_by_the_truth() -> None:
    near = people.chained([moved(0.01)])
    far = people.chained([moved(0.05), moved(0.05)])
    np.testing.assert_allclose(far[:, 0, 3], [0, 0.05, 0.1])
    assert people.best({"far": far, "near": near}).limits == "near"


def test_the_figure_is_drawn_from_the_figures(tmp_path: Path) -> None:
    stored = ROOT / "docs" / "results" / "moving_people.json"
    content = json.loads(stored.read_text(encoding="utf-8"))
    out = tmp_path / "drawn.png"
    people.draw(content, out)
    shown = ROOT / "docs" / "figures" / "moving_people.png"
    with Image.open(out) as drawn, Image.open(shown) as picture:
        assert drawn.size == picture.size


def test_weights_on_what_moves_are_red() -> None:
    weights = np.array([[0.0, 1.0, 0.0, 1.0]], np.float32)
    moving = np.array([[False, False, True, True]])
    colours = teaser.tinted(weights, moving)[0].tolist()
    assert colours == [[0, 0, 0], [255, 255, 255], [222, 143, 5], [255, 0, 0]]


def test_what_stands_nearer_covers_the_image() -> None:
    camera = hvo.Camera(60.0, 60.0, 39.5, 29.5, 60, 80)
    poses = np.stack([moved(5.0, 30.0), moved(5.2, 33.0)])
    scene = teaser.crossing_objects(camera, poses)
    rgb = np.zeros((60, 80, 3), np.uint8)
    shares = []
    for metres in (0.5, 50.0):
        wall = np.full((60, 80), metres, np.float32)
        shot = teaser.composed(hvo.Frame(rgb, wall, camera), scene, 1)
        shares.append(shot.moving.mean())
        assert (shot.frame.depth[~shot.moving] == metres).all()
        assert (shot.frame.depth <= metres).all()
    # nothing stands before a wall at half a metre
    assert shares[0] == 0
    assert 0.2 < shares[1] < 0.7


def test_the_moving_picture_has_its_times(tmp_path: Path) -> None:
    pictures = [Image.new("RGB", (8, 6), (k, 9, 200)) for k in (0, 90, 250)]
    out = tmp_path / "made.gif"
    teaser.write_gif(pictures, [100, 100, 250], out)
    with Image.open(out) as made:
        assert made.n_frames == 3
        made.seek(2)
        assert made.info["duration"] == 250


def test_the_readme_shows_ten_seconds_below_three_megabytes() -> None:
    path = ROOT / "docs" / "teaser.gif"
    assert path.stat().st_size < 3_000_000
    times = []
    with Image.open(path) as made:
        for index in range(made.n_frames):
            made.seek(index)
            times.append(made.info["duration"])
    assert sum(times) == pytest.approx(10_000, rel=0.03)
