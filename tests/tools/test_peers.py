"""The benchmark of peers: what it tracks, and the figures of a path that was worked by hand."""

from __future__ import annotations

import json

import numpy as np
import pytest

from hybridvo.core.geometry import invert, se3_exp
from hybridvo.core.types import Frame
from hybridvo_lab.baselines import missing
from tests.lab.baselines.test_peers import CAMERA, box_depth
from tests.scripts import load_script

peers = load_script("tools/bench/peers.py")


def test_figures_of_a_path_by_hand():
    """Five poses on a bent path; the fourth is 3 cm off, and so are two of four steps."""
    truth = np.tile(np.eye(4), (5, 1, 1))
    truth[:, :3, 3] = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [1, 1, 1], [0, 1, 1]]
    est = truth.copy()
    est[3, 1, 3] += 0.03
    states = ["ok", "degraded", "failed", "ok"]
    found = peers.figures(peers.Tracked(est, states, [1.0, 3.0, 2.0, 90.0]), truth)
    assert (found["step_cm"], found["worst_cm"], found["step_deg"]) == (
        1.5,
        3.0,
        0.0,
    )
    assert (found["failed"], found["degraded"], found["ms"]) == (1, 1, 2.5)
    # an alignment only helps: 3 cm over the root of five poses is an upper bound
    assert 0.3 < found["path_cm"] < 3 / np.sqrt(5)


@pytest.mark.skipif(bool(missing("kiss-icp")), reason=missing("kiss-icp"))
def test_kiss_icp_with_a_map_follows_a_camera_in_a_box():
    """Six steps of 2 cm and half a degree inside of a box; most of the motion is found."""
    step = se3_exp(np.array([0.012, -0.008, 0.015, 0.004, -0.006, 0.003]))
    T_cam_box = [se3_exp(np.array([0, 0, 0, 0.25, 0.5, 0.0]))]
    for _ in range(6):
        T_cam_box.append(step @ T_cam_box[-1])
    frames = [
        Frame(None, box_depth(T).astype(np.float32), CAMERA) for T in T_cam_box
    ]
    tracked = peers.track(frames, peers.KissMap())
    assert tracked.states == ["ok"] * 6
    whole = invert(tracked.T_world_cam[-1]) @ tracked.T_world_cam[0]
    true = T_cam_box[-1] @ invert(T_cam_box[0])
    error = np.linalg.norm((whole @ invert(true))[:3, 3])
    # a swapped direction errs by twice the way
    assert error < 0.3 * np.linalg.norm(true[:3, 3])


def test_the_whole_tool_on_a_small_tree(image_walk, tmp_path, monkeypatch):
    monkeypatch.setattr(peers, "STATIC", ("image_walk", "nowhere"))
    monkeypatch.setattr(peers, "TRIPOD", ())
    out = tmp_path / "peers.json"
    given = [
        "--data",
        str(image_walk.parent),
        "--parts",
        "static",
    ]
    given += ["--methods", "identity,sift-pnp,opencv-rgbd", "--out", str(out)]
    assert peers.main(given) == 0
    content = json.loads(out.read_text())
    (row,) = content["tracked"]
    assert content["absent"] == ["nowhere"] and row["frames"] == 5
    assert list(row["methods"]) == ["identity", "sift-pnp", "opencv-rgbd"]
    assert row["methods"]["identity"]["step_cm"] > 0
    assert str(tmp_path) not in out.read_text()
    assert peers.main(given) == 2  # the file is there
