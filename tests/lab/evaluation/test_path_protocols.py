"""Protocols of papers on small trees in the layouts of the data sets, by hand and against evo."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from evo.core.metrics import APE, RPE, PoseRelation, StatisticsType, Unit
from evo.core.trajectory import PoseTrajectory3D
from scipy.spatial.transform import Rotation

from hybridvo.core.errors import InputError
from hybridvo.core.geometry import make_transform
from hybridvo.core.options import FlowOptions, Options, RunOptions
from hybridvo.core.trajectory import Trajectory, read_trajectory
from hybridvo.io.data.open import open_sequence
from hybridvo.run.commands import arguments
from hybridvo_lab.commands.compare import compare
from hybridvo_lab.evaluation import protocols
from hybridvo_lab.evaluation.metrics import Match
from hybridvo_lab.evaluation.path_scores import (
    evaluate_path,
    inverse_rpe,
    score_path,
    total_rows,
)
from hybridvo_lab.synthetic.render import write_sintel
from hybridvo_lab.synthetic.scenes import make_scene

D = 0.1
"""Height of the corners of a square above or below its plane, metres."""
SQUARE = np.array([[1, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0]], float)
"""Two metres from one corner to the next, and from the last to the first."""
SADDLE = SQUARE + [[0, 0, D], [0, 0, -D], [0, 0, D], [0, 0, -D]]
"""No turn and no shift brings it nearer to the square."""


def rule(name: str, **changes) -> protocols.Protocol:
    return dataclasses.replace(protocols.check_protocol(name), **changes)


def path_of(positions: np.ndarray, rotations=None, step: float = 1.0) -> Trajectory:
    poses = np.tile(np.eye(4), (len(positions), 1, 1))
    poses[:, :3, 3] = positions
    if rotations is not None:
        poses[:, :3, :3] = rotations
    return Trajectory(step * np.arange(len(positions)), poses)


# --- numbers worked by hand -------------------------------------------------------------


def test_a_scale_is_given_away_in_all_three_figures() -> None:
    truth = path_of(SQUARE)
    half = path_of(0.5 * SQUARE + 7)
    found = score_path(rule("sintel14"), half, truth)
    assert [found[key] for key in ("ate", "rpe_t", "rpe_r")] == pytest.approx(
        [0, 0, 0], abs=1e-9
    )
    assert found["scale"] == pytest.approx(2)
    # without a scale each corner is half of sqrt(2) m off
    rigid = score_path(rule("bonn8"), half, truth)
    assert rigid["ate"] == pytest.approx(np.sqrt(2) / 2)
    assert rigid["rpe_t"] is None and "rpe_t" not in rigid["reasons"]


def test_a_saddle_beside_a_square() -> None:
    """Rigid: D. With a scale s = 2 / (2 + D^2), of which D sqrt(s) is left."""
    truth = path_of(SQUARE)
    saddle = path_of(SADDLE)
    s = 2 / (2 + D**2)
    ate = D * np.sqrt(s)
    # neighbours are 2 m apart, and 2 D in height
    step = np.hypot(2 * (1 - s), 2 * D * s)
    assert score_path(rule("tum-walking"), saddle, truth)["ate"] == pytest.approx(D)
    metres = score_path(rule("sintel14"), saddle, truth)
    assert (metres["ate"], metres["rpe_t"]) == pytest.approx((ate, step))
    # from start to end it is 2 m: shares are half of the metres
    shares = score_path(rule("sintel14-relative"), saddle, truth)
    assert (shares["ate"], shares["rpe_t"]) == pytest.approx((ate / 2, step / 2))
    added = score_path(rule("sintel18", added_length=2.0), saddle, truth)
    assert (added["ate"], added["rpe_t"]) == pytest.approx((ate / 4, step / 4))


def test_megasams_script_orders_motions_the_other_way() -> None:
    """A quarter turn that was not there: 0 in evo's order, sqrt(2) m in that of the script."""
    step = np.array([1.0, 0, 0])
    turn = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    est = np.stack([np.eye(4), make_transform(turn, step)])
    gt = np.stack([np.eye(4), make_transform(np.eye(3), step)])
    matched = Match(est, gt, np.arange(2.0), "time", "")
    errors = inverse_rpe(matched)
    assert errors.translation == pytest.approx([np.sqrt(2)])
    assert errors.rotation_deg == pytest.approx([90])


def test_relative_errors_over_a_second_are_of_the_nearest_stamps() -> None:
    """At 2 Hz, 10 cm a step too short: 20 cm in a second, whatever the single steps do."""
    x = np.arange(9.0)
    wiggle = 0.02 * (np.arange(9) % 2)
    side = 0.3 * x**2
    truth = path_of(np.column_stack([x, side, 0 * x]), step=0.5)
    est = path_of(np.column_stack([0.9 * x + wiggle, side, 0 * x]), step=0.5)
    found = score_path(rule("tum-walking"), est, truth)
    assert (found["rpe_t"], found["rpe_r"]) == pytest.approx((0.2, 0), abs=1e-9)
    short = score_path(rule("tum-walking"), path_of(SQUARE, step=0.1),
                       path_of(SQUARE, step=0.1))  # fmt: skip
    assert short["rpe_t"] is None and "1 s apart" in short["reasons"]["rpe_t"]


def test_a_path_that_stands_still_has_no_figure() -> None:
    still = path_of(np.zeros((4, 3)))
    for name in ("sintel14", "sintel18", "bonn8"):
        assert score_path(rule(name), path_of(SQUARE), still)["ate"] is None
    assert score_path(rule("sintel14"), still, path_of(SQUARE))["ate"] is None
    closed = path_of(np.vstack([SQUARE, SQUARE[:1]]))
    found = score_path(rule("sintel18"), closed, closed)
    assert "ends where it started" in found["reasons"]["ate"]
    assert score_path(rule("sintel14"), closed, closed)["ate"] is not None


# --- against evo ------------------------------------------------------------------------


def wandering(seed: int, count: int = 40) -> Trajectory:
    rng = np.random.default_rng(seed)
    positions = np.cumsum(rng.normal(0, 0.1, (count, 3)), axis=0)
    turns = np.cumsum(rng.normal(0, 0.05, (count, 3)), axis=0)
    return path_of(positions, Rotation.from_rotvec(turns).as_matrix(), 0.1)


def evo_path(T: np.ndarray) -> PoseTrajectory3D:
    return PoseTrajectory3D(
        poses_se3=[*T], timestamps=np.arange(len(T), dtype=float)
    )


def evo_figures(est: np.ndarray, gt: np.ndarray, scale: bool) -> list[float]:
    """What evo_ape and evo_rpe print with --align, and --correct_scale."""
    reference = evo_path(gt)
    aligned = evo_path(est)
    aligned.align(reference, correct_scale=scale)
    figures = []
    for metric in (
        APE(PoseRelation.translation_part),
        RPE(PoseRelation.translation_part, 1, Unit.frames, all_pairs=True),
        RPE(PoseRelation.rotation_angle_deg, 1, Unit.frames, all_pairs=True),
    ):
        metric.process_data((reference, aligned))
        figures.append(metric.get_statistic(StatisticsType.rmse))
    return figures


@pytest.mark.parametrize("name", ["sintel14", "tum-dynamics"])
def test_figures_are_those_of_evo(name: str) -> None:
    est = wandering(1)
    gt = wandering(2)
    found = score_path(rule(name), est, gt)
    expected = evo_figures(est.T_world_cam, gt.T_world_cam, scale=True)
    assert [found[key] for key in ("ate", "rpe_t", "rpe_r")] == pytest.approx(
        expected
    )


def test_rigid_figures_are_those_of_evo() -> None:
    est = wandering(3)
    gt = wandering(4)
    expected = evo_figures(est.T_world_cam, gt.T_world_cam, scale=False)
    assert score_path(rule("bonn9"), est, gt)["ate"] == pytest.approx(expected[0])
    # ten frames are a second
    metric = RPE(PoseRelation.translation_part, 10, Unit.frames, all_pairs=True)
    metric.process_data((evo_path(gt.T_world_cam), evo_path(est.T_world_cam)))
    second = metric.get_statistic(StatisticsType.rmse)
    assert score_path(rule("tum-walking"), est, gt)["rpe_t"] == pytest.approx(
        second
    )


# --- means over sequences ---------------------------------------------------------------


def row(
    sequence: str, ate: float | None, frames: int = 5, reason: str | None = None
) -> dict:
    figures = {"ate": ate, "rpe_t": ate, "rpe_r": ate}
    named = {"method": "a", "flow_source": "dis", "inputs": "images, true depth"}
    reasons = {} if reason is None else dict.fromkeys(figures, reason)
    return (
        {"sequence": sequence, "frames": frames, "reasons": reasons}
        | figures
        | named
    )


def test_a_mean_is_of_every_sequence_or_there_is_none() -> None:
    two = rule("sintel14", sequences={"alley_2": 5, "cave_2": 5})
    (line,) = total_rows(two, [row("alley_2", 1.0), row("cave_2", 3.0)])
    assert (line["ate"], line["reasons"], line["name"]) == (2.0, {}, "a")
    (line,) = total_rows(two, [row("alley_2", 1.0)])
    assert line["ate"] is None and "missing: cave_2" in line["reasons"]["ate"]
    (line,) = total_rows(two, [row("alley_2", 1.0), row("cave_2", 3.0, frames=4)])
    assert line["ate"] is None and "cave_2: 4 of 5" in line["reasons"]["ate"]
    still = row("cave_2", None, reason="stands still")
    (line,) = total_rows(two, [row("alley_2", 1.0), still])
    assert line["ate"] is None and "cave_2: stands still" in line["reasons"]["ate"]


# --- the lists themselves ---------------------------------------------------------------


def test_the_command_line_knows_every_protocol() -> None:
    assert set(arguments.PROTOCOLS) == set(protocols.protocols())


def test_sequences_are_those_of_the_papers() -> None:
    count = {
        name: len(each.sequences) for name, each in protocols.protocols().items()
    }
    assert count == {
        **{"paper": 23, "sintel14": 14, "sintel14-relative": 14, "sintel18": 18},
        **{"tum-dynamics": 8, "tum-walking": 4, "bonn8": 8, "bonn9": 9},
    }
    more = {*rule("sintel18").sequences} - {*rule("sintel14").sequences}
    assert more == {"alley_1", "bamboo_1", "bamboo_2", "mountain_1"}
    frames = rule("paper").sequences
    assert all(frames[n] == k for n, k in rule("sintel18").sequences.items())


# --- MPI Sintel -------------------------------------------------------------------------

HEIGHT, WIDTH, FRAMES = 36, 64, 5


def write_scene(root: Path, name: str, image_pass: str = "final") -> None:
    """A rendered scene of five frames, in a pass of Sintel's images."""
    scene = make_scene(
        "static", len(name), height=HEIGHT, width=WIDTH, frames=FRAMES
    )
    write_sintel(scene, root, name)
    target = root / "training" / image_pass / name
    target.parent.mkdir(exist_ok=True)
    (root / "training" / "clean" / name).rename(target)


@pytest.fixture(scope="module")
def sintel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("sintel")
    for name in ("alley_2", "cave_2", "shaman_2"):
        write_scene(root, name)
    return root


@pytest.fixture
def two_scenes(monkeypatch: pytest.MonkeyPatch) -> None:
    """The protocol of the tree: two scenes of five frames."""
    known = dict(protocols.protocols())
    for name in ("sintel14", "sintel18"):
        known[name] = rule(name, sequences={"alley_2": 5, "cave_2": 5})
    monkeypatch.setattr(protocols, "protocols", lambda: known)


FILES = Options(flow=FlowOptions(source="file"))


@pytest.mark.slow
def test_compare_scores_the_scenes_of_the_protocol(
    sintel, two_scenes, tmp_path
) -> None:
    compare((sintel,), tmp_path, methods=("pnp-ransac", "identity"), options=FILES,
            protocol="sintel14")  # fmt: skip
    result = json.loads((tmp_path / "results.json").read_text())["protocol"]
    assert "left out: shaman_2" in result["note"]
    by_method = {line["method"]: line for line in result["totals"]}
    assert by_method["identity"]["ate"] is None
    assert "all in one place" in by_method["identity"]["reasons"]["ate"]
    found = []
    for name in ("alley_2", "cave_2"):
        estimate = read_trajectory(
            tmp_path / "runs" / name / "pnp-ransac" / "trajectory.tum"
        )
        gt = open_sequence(sintel / "training" / "final" / name).poses
        found.append(evo_figures(estimate.T_world_cam, gt, scale=True))
    line = by_method["pnp-ransac"]
    assert [line[key] for key in ("ate", "rpe_t", "rpe_r")] == pytest.approx(
        np.mean(found, axis=0)
    )
    assert line["inputs"] == "images, true depth, intrinsics, file (true) flow"
    assert "D4RT" in (tmp_path / "report.md").read_text()


def test_sintel18_scales_images_and_cameras(sintel) -> None:
    scene = open_sequence(sintel / "training" / "final" / "alley_2")
    scaled = protocols.prepare(rule("sintel18"), scene)
    # sqrt(384 * 512 / (36 * 64)) = 9.2376
    assert (scaled.height, scaled.width) == (332, 591)
    frame = scaled.frame(3)
    assert frame.rgb.shape == (332, 591, 3) and frame.depth.shape == (332, 591)
    assert (
        scaled.camera(3).fx
        == frame.camera.fx
        == pytest.approx(scene.camera(3).fx * 591 / 64)
    )
    assert not scaled.has_flow and scene.has_flow
    np.testing.assert_array_equal(scaled.poses, scene.poses)
    assert scaled.opened_with()["size"] == [332, 591]


def test_what_does_not_belong_is_refused(
    sintel, two_scenes, walk, tmp_path
) -> None:
    final = sintel / "training" / "final"
    for paths, text in (
        ((walk,), "walk"),
        ((final / "alley_2", walk), "do not mix"),
        ((final / "shaman_2",), "shaman_2"),
        ((sintel, final / "cave_2"), "cave_2 twice"),
    ):
        with pytest.raises(InputError, match=text):
            compare(paths, tmp_path / "out", protocol="sintel14")
    strided = Options(run=RunOptions(stride=2))
    with pytest.raises(InputError, match="chooses the frames itself"):
        compare((sintel,), tmp_path / "out", options=strided, protocol="sintel14")
    write_scene(tmp_path / "other", "alley_2", "clean")
    with pytest.raises(InputError, match="final pass"):
        compare((tmp_path / "other",), tmp_path / "out", protocol="sintel14")
    with pytest.raises(InputError, match="tum-walking"):
        compare((sintel,), tmp_path / "out", protocol="sintel15")
    assert not (tmp_path / "out").exists()


# --- TUM and Bonn -----------------------------------------------------------------------


def write_tum(
    root: Path, images: list[float], depths: list[float], truth: np.ndarray
) -> Path:
    """A recording in TUM's layout; ``truth`` has rows of its groundtruth.txt."""
    root.mkdir(parents=True)
    rgb = cv2.imencode(".png", np.full((480, 640, 3), 99, np.uint8))[1].tobytes()
    depth = cv2.imencode(".png", np.full((480, 640), 10000, np.uint16))[1].tobytes()
    for kind, stamps, data in (("rgb", images, rgb), ("depth", depths, depth)):
        (root / kind).mkdir()
        lines = ["# timestamp filename"]
        for stamp in stamps:
            name = f"{kind}/{stamp:.6f}.png"
            (root / name).write_bytes(data)
            lines.append(f"{stamp:.6f} {name}")
        (root / f"{kind}.txt").write_text("\n".join(lines) + "\n")
    np.savetxt(root / "groundtruth.txt", truth, fmt="%.9f")
    return root


def rows_of(stamps: np.ndarray, T: np.ndarray) -> np.ndarray:
    quaternions = Rotation.from_matrix(T[:, :3, :3]).as_quat()
    return np.column_stack([stamps, T[:, :3, 3], quaternions])


def test_tum_dynamics_takes_every_third_of_the_matched_list(tmp_path) -> None:
    """Image 1 has no true pose, image 4 no depth: of 0 2 3 4 5 ... it is 0 4 7 10, without 4."""
    images = [10 + 0.1 * k for k in range(14)]
    depths = [stamp + 0.01 for k, stamp in enumerate(images) if k != 4]
    known = [k for k in range(14) if k != 1]
    stamps = np.array([images[k] + 0.005 for k in known])
    # a second pose that is nearer to image 0 than to any other, but not the nearest
    stamps = np.insert(stamps, 1, images[0] + 0.019)
    x = np.insert(np.array(known, float), 1, 99.0)
    T = np.tile(np.eye(4), (len(x), 1, 1))
    T[:, 0, 3] = x
    T[:, 1, 3] = x**2
    name = "rgbd_dataset_freiburg3_walking_xyz"
    root = write_tum(tmp_path / name, images, depths, rows_of(stamps, T))
    chosen = protocols.prepare(rule("tum-dynamics", first=4), open_sequence(root))
    np.testing.assert_allclose(chosen.timestamps, [10.0, 10.7, 11.0])
    np.testing.assert_allclose(chosen.poses[:, 0, 3], [0, 7, 10])
    assert "1 of 4 frames" in chosen.warnings[-1]
    with pytest.raises(
        InputError, match="without --depth, --mask onnx: or --readout"
    ):
        protocols.prepare(rule("tum-dynamics"), open_sequence(root, readout_ms=20))
    assert chosen.frame(1).index == 1
    assert chosen.frame(1).timestamp == pytest.approx(10.7)

    # the whole way, from the command line: a path that is the truth in another world
    estimate = Trajectory(
        chosen.timestamps, make_transform(np.eye(3), np.ones(3)) @ chosen.poses
    )
    estimate.save(tmp_path / "est.tum")
    report = evaluate_path("tum-dynamics", tmp_path / "est.tum", root)
    assert report["ate"] == pytest.approx(0, abs=1e-6)
    # of 90 there are images 0, 7, 10 and 13; three have a pose
    assert (report["matched"], report["total"]) == (3, 4)
    assert any("keyframes" in text for text in report["warnings"])


BONN_ROTATION = np.array(
    [
        [1.0157, 0.1828, -0.2389],
        [0.0009, -0.8431, -0.6413],
        [-0.3009, 0.6147, -0.8085],
    ]
)
LEVER = np.array([0.0113, -0.0098, 0.0111])


def test_bonns_markers_become_its_camera(tmp_path) -> None:
    """By hand: T_ROS takes (x, y, z) to (-x, z, y); T_m is turned and 1.9 cm away."""
    images = [5.0, 5.1, 5.2, 5.3]
    stamps = np.array([5.0, 5.15, 5.3])
    T = np.tile(np.eye(4), (3, 1, 1))
    T[:, :3, 3] = [[1, 2, 3], [1, 2, 4], [2, 2, 4]]
    # the markers turn about their z, which is the y of T_ROS
    T[2, :3, :3] = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    root = write_tum(
        tmp_path / "rgbd_bonn_balloon", images, images, rows_of(stamps, T)
    )
    found = protocols.prepare(rule("bonn8"), open_sequence(root))
    # 5.1 and 5.2 are both 0.05 s from the second pose: nearest, not one to one
    R = BONN_ROTATION / 1.0593
    expected = [[-1, 3, 2] + LEVER, [-1, 4, 2] + LEVER, [-1, 4, 2] + LEVER]
    np.testing.assert_allclose(found.poses[:3, :3, 3], expected, atol=1e-9)
    np.testing.assert_allclose(found.poses[:3, :3, :3], [R, R, R], atol=1e-4)
    # their quarter turn about z is one about y here, and takes the lever arm along
    turn = np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    axes = np.array([[-1, 0, 0], [0, 0, 1], [0, 1, 0]])
    np.testing.assert_allclose(axes.T @ T[2, :3, :3] @ axes, turn, atol=1e-9)
    np.testing.assert_allclose(
        found.poses[3, :3, 3], [-2, 4, 2] + turn @ LEVER, atol=1e-9
    )
    np.testing.assert_allclose(found.poses[3, :3, :3], turn @ R, atol=1e-4)


def test_one_protocol_is_not_that_of_another_data_set(tmp_path) -> None:
    stamps = [5.0, 5.1, 5.2]
    T = np.tile(np.eye(4), (3, 1, 1))
    T[:, 0, 3] = range(3)
    walking = write_tum(
        tmp_path / "rgbd_dataset_freiburg3_walking_rpy",
        stamps, stamps, rows_of(np.array(stamps), T),
    )  # fmt: skip
    Trajectory(np.array(stamps), T).save(tmp_path / "est.tum")
    with pytest.raises(InputError, match="bonn_balloon"):
        evaluate_path("bonn8", tmp_path / "est.tum", walking)
    with pytest.raises(InputError, match="scores pairs"):
        evaluate_path("paper", tmp_path / "est.tum", walking)
    report = evaluate_path("tum-walking", tmp_path / "est.tum", walking)
    # three poses on a line determine no rotation
    assert report["ate"] is None and "on a line" in report["reasons"]["ate"]
