"""Pose graphs on disk, read back by hand and by GTSAM."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import hybridvo as hvo
from hybridvo.core.geometry import invert, se3_exp
from hybridvo.core.results import Edge


def graph() -> tuple[dict[int, np.ndarray], list[tuple[int, Edge]]]:
    """Three poses, two motions and a loop, each with a covariance of its own."""
    rng = np.random.default_rng(2)
    poses = {k: se3_exp(rng.normal(size=6)) for k in (4, 5, 8)}
    edges = []
    for start, end in ((4, 5), (5, 8), (4, 8)):
        A = rng.normal(size=(6, 6))
        T = invert(poses[end]) @ poses[start]
        edges.append((end, Edge(start, T, 1e-4 * (A @ A.T + np.eye(6)))))
    return poses, edges


def matrix(numbers: list[str]) -> np.ndarray:
    """(4, 4) of x y z qx qy qz qw."""
    values = np.array(numbers, float)
    T = np.eye(4)
    T[:3, 3] = values[:3]
    T[:3, :3] = Rotation.from_quat(values[3:]).as_matrix()
    return T


def read(path: Path) -> dict[str, list[list[str]]]:
    """Words of each line after the first, by the first."""
    found: dict[str, list[list[str]]] = {}
    for line in path.read_text().splitlines():
        kind, *words = line.split(" ")
        found.setdefault(kind, []).append(words)
    return found


def test_a_graph_by_hand(tmp_path: Path) -> None:
    poses, edges = graph()
    hvo.write_g2o(tmp_path / "graph.g2o", poses, edges)
    found = read(tmp_path / "graph.g2o")
    assert list(found) == ["VERTEX_SE3:QUAT", "FIX", "EDGE_SE3:QUAT"]
    assert found["FIX"] == [["4"]]
    for words, (index, pose) in zip(
        found["VERTEX_SE3:QUAT"], poses.items(), strict=True
    ):
        assert int(words[0]) == index
        np.testing.assert_allclose(matrix(words[1:]), pose, atol=1e-12)
    for words, (end, edge) in zip(found["EDGE_SE3:QUAT"], edges, strict=True):
        assert [int(word) for word in words[:2]] == [edge.start, end]
        # g2o: the pose of the end in the frame of the start
        T_start_end = invert(poses[edge.start]) @ poses[end]
        np.testing.assert_allclose(matrix(words[2:9]), T_start_end, atol=1e-12)
        upper = np.zeros((6, 6))
        upper[np.triu_indices(6)] = np.array(words[9:], float)
        information = upper + np.triu(upper, 1).T
        # x y z, then halves of the angles
        C = edge.covariance * np.outer(
            [1, 1, 1, 0.5, 0.5, 0.5], [1, 1, 1, 0.5, 0.5, 0.5]
        )
        np.testing.assert_allclose(information @ C, np.eye(6), atol=1e-9)


def test_gtsam_reads_a_graph(tmp_path: Path) -> None:
    """It takes the information of half angles for that of angles, as its own files have it."""
    gtsam = pytest.importorskip("gtsam")
    poses, edges = graph()
    path = tmp_path / "graph.g2o"
    hvo.write_g2o(path, poses, edges)
    factors, values = gtsam.readG2o(str(path), True)
    for index, pose in poses.items():
        np.testing.assert_allclose(values.atPose3(index).matrix(), pose, atol=1e-9)
    assert factors.size() == len(edges)
    for k, (end, edge) in enumerate(edges):
        factor = factors.at(k)
        assert list(factor.keys()) == [edge.start, end]
        measured = factor.measured().matrix()
        np.testing.assert_allclose(measured, edge.T_start_curr, atol=1e-9)
        covariance = factor.noiseModel().covariance()
        halved = np.repeat([0.5, 1.0], 3)
        expected = hvo.to_gtsam_covariance(edge.covariance) * np.outer(
            halved, halved
        )
        np.testing.assert_allclose(covariance, expected, rtol=1e-6, atol=1e-12)


def test_what_is_no_graph(tmp_path: Path) -> None:
    poses, edges = graph()
    path = tmp_path / "graph.g2o"
    with pytest.raises(hvo.InputError, match="at least one pose"):
        hvo.write_g2o(path, {}, [])
    with pytest.raises(hvo.InputError, match="edge 5 8: expected two frames"):
        hvo.write_g2o(path, {4: poses[4], 5: poses[5]}, edges)
    with pytest.raises(hvo.InputError, match="pose 4: expected"):
        hvo.write_g2o(path, {4: np.eye(3)}, [])
    with pytest.raises(hvo.InputError, match="positive definite"):
        hvo.write_g2o(path, poses, [(5, Edge(4, np.eye(4), np.zeros((6, 6))))])
    assert not path.exists()
