"""The tool that measures complete systems: its figures by hand, and what it says of absent ones."""

from __future__ import annotations

import json
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from hybridvo.core.geometry import se3_exp
from tests.scripts import load_script

slam = load_script("tools/bench/slam_peers.py")
systems = load_script("tools/bench/slam_systems.py")
vocabulary = load_script("tools/bench/orb_vocabulary.py")


def straight(way_m: float) -> np.ndarray:
    """Five poses along the x axis."""
    truth = np.tile(np.eye(4), (5, 1, 1))
    truth[:, 0, 3] = np.linspace(0, way_m, 5)
    return truth


def score(way_m: float, off_m: float, off_deg: float = 0.0, states=("ok",) * 4):
    """Figures of a path whose last pose is off."""
    truth = straight(way_m)
    est = truth.copy()
    est[-1] = est[-1] @ se3_exp(np.array([0, off_m, 0, 0, 0, np.radians(off_deg)]))
    return slam.scored(slam.Tracked(est, list(states), [1.0, 2, 3, 90]), truth)


def test_a_path_is_right_by_its_end():
    """Limits: 3 cm or a twentieth of the way; 10 cm or three twentieths; 1 and 3 degrees."""
    near = score(0.2, 0.029)
    assert (near["right"], near["far_off"], near["doubted"]) == (True, False, False)
    assert near["end_cm"] == pytest.approx(2.9)
    # a turn of 1.1 degrees adds less than a millimetre to a shift of none
    between = score(0.2, 0.0, 1.1)
    assert (between["right"], between["far_off"]) == (False, False)
    assert between["end_deg"] == pytest.approx(1.1)
    assert score(0.2, 0.11)["far_off"]
    # 11 cm of 3 m are less than a twentieth
    assert score(3.0, 0.11)["right"]


def test_a_wrong_path_counts_as_doubted_where_a_step_was_reported():
    silent = score(0.2, 0.2)
    told = score(0.2, 0.2, states=("ok", "degraded", "ok", "failed"))
    found = slam.summary([silent, told, score(0.2, 0.01)])
    assert (found["right"], found["wrong_all_ok"], found["far_off"]) == (1, 1, 2)
    assert told["states"] == {"ok": 2, "degraded": 1, "failed": 1}
    assert (found["clips"], found["end_cm"]) == (3, 20.0)
    assert found["processor_ms"]["median"] == 2.5


def test_a_system_that_is_not_installed_is_named(image_walk, tmp_path, monkeypatch):
    monkeypatch.setattr(slam, "SYSTEMS", {"RTAB-Map": "no_such_package"})
    monkeypatch.setattr(slam, "STATIC", ("image_walk", "nowhere"))
    out = tmp_path / "found.json"
    given = ["--data", str(image_walk.parent), "--methods", "no motion,RTAB-Map"]
    assert slam.main([*given, "--out", str(out)]) == 0
    content = json.loads(out.read_text("utf-8"))
    assert "pip install no_such_package" in content["missing"]["RTAB-Map"]
    (row,) = content["static"]
    assert list(row["methods"]) == ["no motion"] and content["clips"]["count"] == 0
    assert row["methods"]["no motion"]["end_cm"] > 0
    assert str(tmp_path) not in out.read_text("utf-8")


def test_a_system_that_breaks_down_has_no_figures(image_walk, tmp_path):
    built = slam.Built(tmp_path / "no_vocabulary.txt", tmp_path / "no_shim.so")
    assert slam.by_system("no_such_package", image_walk, built) is None


def message(qx: float, qy: float, qz: float, qw: float, x=0.0, y=0.0, z=0.0):
    """What RTAB-Map's node sends."""
    return SimpleNamespace(
        getQuaternion=lambda: SimpleNamespace(qx=qx, qy=qy, qz=qz, qw=qw),
        getTranslation=lambda: SimpleNamespace(x=x, y=y, z=z),
    )


def test_poses_of_rtabmap_are_in_the_axes_of_the_camera():
    """Its x is ahead (our z), its y left (our -x), its z up (our -y)."""
    moved = systems.pose_of(message(0, 0, 0, 1, 1.0, 2.0, 3.0))
    np.testing.assert_allclose(moved[:3, 3], [-2, -3, 1])
    half = np.sqrt(0.5)
    left = systems.pose_of(message(0, 0, half, half))
    # a turn to the left takes what is ahead to the left
    np.testing.assert_allclose(left[:3, :3] @ [0, 0, 1], [-1, 0, 0], atol=1e-12)
    assert systems.pose_of(message(0.5, 0.5, 0.5, 0.5)) is None


def test_a_vocabulary_is_a_tree_of_words(tmp_path):
    rng = np.random.default_rng(3)
    for number in range(4):
        noise = rng.integers(0, 255, (30, 40), np.uint8)
        image = cv2.resize(noise, (320, 240), interpolation=cv2.INTER_NEAREST)
        cv2.imwrite(str(tmp_path / f"{number}.png"), image)
        cv2.imwrite(str(tmp_path / f"{number}_depth.png"), image)
    out = tmp_path / "vocabulary.txt"
    assert len(vocabulary.images_below(tmp_path)) == 4
    vocabulary.write_vocabulary(tmp_path, out)
    head, *lines = out.read_text("utf-8").splitlines()
    assert head == "10 6 0 0"
    rows = np.array([line.split() for line in lines], float)
    parents, is_word = rows[:, 0].astype(int), rows[:, 1] > 0
    numbers = np.arange(1, len(rows) + 1)
    assert rows.shape[1] == 35 and (parents < numbers).all()
    # words are those without children, and no node has more than ten
    assert set(parents) == {0, *numbers[~is_word]}
    assert np.bincount(parents).max() <= 10
    assert rows[:, 2:34].min() >= 0 and rows[:, 2:34].max() <= 255


@pytest.mark.slow
@pytest.mark.parametrize("name", slam.SYSTEMS)
def test_a_system_follows_a_camera_where_nothing_moves(name, shared_data, tmp_path):
    """8 cm through a kitchen: the end is within 3 cm and a degree."""
    if why := slam.missing([name]):
        pytest.skip(why[name])
    folder = shared_data / "semi_real_clips" / "kitchen_static"
    args = SimpleNamespace(data=folder, vocabulary=tmp_path / "vocabulary.txt")
    tracked = slam.by_system(
        slam.SYSTEMS[name], folder, slam.build(tmp_path, [name], args)
    )
    truth = slam.open_sequence(folder).poses
    assert tracked is not None
    assert slam.scored(tracked, truth)["right"]
