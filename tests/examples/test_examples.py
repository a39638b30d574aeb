"""The examples run, and find what they promise."""

from __future__ import annotations

import functools
import re
import runpy
import subprocess
import sys
import textwrap
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType, SimpleNamespace

import cv2
import numpy as np
import pytest

import hybridvo
from hybridvo.core.geometry import invert, se3_exp, se3_log
from hybridvo.core.results import Reason, RelativePose, Status
from hybridvo.io.cameras.folder import FolderCamera
from hybridvo.io.live import Patience
from hybridvo_lab.synthetic.render import SyntheticSequence
from hybridvo_lab.synthetic.scenes import make_scene
from tests.scripts import ROOT, load_script

EXAMPLES = ROOT / "examples"
MAX_LINES = 60
LONGER = {"px4_odometry.py": 64, "web_page.py": 85}
"""Examples of which many lines are fields: of a message, of a page."""


def load(name: str) -> ModuleType:
    return load_script(f"examples/{name}.py")


def test_examples_fit_on_a_screen_and_are_listed() -> None:
    listed = (EXAMPLES / "README.md").read_text(encoding="utf-8")
    for path in EXAMPLES.glob("*.py"):
        lines = len(path.read_text(encoding="utf-8").splitlines())
        assert lines < LONGER.get(path.name, MAX_LINES), path
    for path in EXAMPLES.iterdir():
        assert path.suffix in (".py", ".ipynb", ".md", "") and (
            path.suffix not in (".py", ".ipynb") or f"]({path.name})" in listed
        ), path


def scene(kind: str = "static", frames: int = 4):
    return make_scene(kind, 3, height=96, width=160, frames=frames)


def path_of(scene) -> np.ndarray:
    """The true poses, from the first camera."""
    return np.array([invert(scene.T_world_cam[0]) @ T for T in scene.T_world_cam])


# --- a page in the browser ------------------------------------------------------------------------


def test_the_page_answers_for_two_images_and_their_depth(tmp_path: Path) -> None:
    page = load("web_page")
    *files, focal_px, unit_m = page.rendered(tmp_path)
    images = [cv2.imread(name)[..., ::-1] for name in files[:2]]
    shown, text = page.motion_of(*images, *files[2:], focal_px, unit_m)
    changed = (shown != images[0]).any(axis=2)
    assert 0.2 < changed.mean() < 0.5
    assert text.startswith("ok, probability 1.00\nmoves: 29 %")
    truth = make_scene("light", 0, height=218, width=512, frames=2).T_world_cam
    motion = invert(truth[1]) @ truth[0]
    numbers = np.array(
        re.findall(r"-?\d+\.\d*", text.partition("metres:")[2]), float
    )
    np.testing.assert_allclose(numbers.reshape(4, 4), motion, atol=2e-3)


def test_the_page_says_what_is_missing() -> None:
    with pytest.raises(hybridvo.InputError, match="two images and a depth file"):
        load("web_page").motion_of(None, None, None, None, 525, 0.001)


# --- live, recording, own flow --------------------------------------------------------------------


def test_a_live_camera_is_followed() -> None:
    """Frames may be dropped where the machine is slow; each pose belongs to its own frame."""
    rendered = scene()
    camera = FolderCamera(SyntheticSequence(rendered))
    truth = path_of(rendered)
    # however slow the machine is, a frame is tracked at last
    patience = Patience(max_age_s=np.inf, silence_s=np.inf, absence_s=np.inf)
    found = list(load("live_camera").follow(camera, patience))
    assert found
    stamps = SyntheticSequence(rendered).timestamps
    first = int(np.argmin(np.abs(stamps - found[0].step.timestamp)))
    for live in found:
        index = int(np.argmin(np.abs(stamps - live.step.timestamp)))
        expected = invert(truth[first]) @ truth[index]
        # a walk of 10 cm a frame, at a size where a pair is good to a few tenths of a millimetre
        np.testing.assert_allclose(
            live.step.T_world_cam[:3, 3], expected[:3, 3], atol=0.005
        )


@pytest.mark.slow
def test_a_bag_becomes_a_trajectory(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("rosbags")
    from hybridvo.run.commands.convert import convert

    rendered = scene()
    bag = tmp_path / "walk.bag"
    convert(SyntheticSequence(rendered), bag, quiet=True)
    out = tmp_path / "path.tum"
    assert load("bag_to_trajectory").main([str(bag), str(out)]) == 0
    assert "4 of 4 frames" in capsys.readouterr().out
    rows = np.loadtxt(out)
    # depth in the bag is in millimetres, which is the rounding of the positions
    np.testing.assert_allclose(
        rows[:, 1:4], path_of(rendered)[:, :3, 3], atol=0.005
    )


def test_a_recording_that_is_not_there_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    missing = str(tmp_path / "nosuch.bag")
    assert load("bag_to_trajectory").main([missing, "path.tum"]) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.count("\n") == 1 and "nosuch" in printed.err


def test_the_own_flow_is_flow() -> None:
    rendered = scene()
    frames = [rendered.render(index) for index in range(2)]
    found = load("own_flow").my_flow(*frames)
    true_flow, _ = rendered.flow(0)
    error = np.linalg.norm(found.flow - true_flow, axis=2)
    length = np.linalg.norm(true_flow, axis=2)
    # shifts of whole pixels, softly averaged: well below a pixel, where flow is several pixels
    assert np.median(error) < 0.25 * np.median(length)
    tracker = hybridvo.Odometry(flow=load("own_flow").my_flow)
    steps = [tracker.track(frame) for frame in frames]
    assert steps[1].usable


# --- graphs ---------------------------------------------------------------------------------------


class Scripted:
    """A tracker whose steps are written down: states of the frames 1, 2, ..., each 0.1 m ahead.

    As in ``hvo.Odometry`` a frame whose motion failed is passed over, and after two failures in a
    row the next motion starts from the second of these frames.
    """

    def __init__(self, states: list[str]) -> None:
        self.states = states
        self.index = 0
        self.reference = 0
        self.failed = 0

    def track(self, frame: object) -> hybridvo.Step:
        prev_index = None if self.index == 0 else self.reference
        motion = RelativePose(covariance=1e-6 * np.eye(6))
        if prev_index is not None:
            ahead = 0.1 * (self.index - prev_index)
            motion = motion.replace(
                T_curr_prev=se3_exp(np.array([0, 0, -ahead, 0, 0, 0]))
            )
            state = self.states[self.index - 1]
            if state == "degraded":
                status = Status.degraded(Reason.AMBIGUOUS_MOTION, "")
                motion = motion.replace(status=status, covariance=1e-2 * np.eye(6))
            if state == "failed":
                motion = RelativePose.failed(Reason.NO_FLOW, "")
        self.failed = 0 if motion.usable else self.failed + 1
        if motion.usable or self.failed == 2:
            self.reference = self.index
        pose = se3_exp(np.array([0, 0, 0.1 * self.index, 0, 0, 0]))
        step = hybridvo.Step(self.index, 0.1 * self.index, pose, motion, prev_index)
        self.index += 1
        return step

    def loops(self, step: hybridvo.Step, apart: int) -> tuple[hybridvo.Edge, ...]:
        return ()


@pytest.mark.parametrize(
    ("states", "nodes"),
    [
        (["ok", "degraded", "ok"], [0, 1, 2, 3]),
        (["ok", "failed", "ok"], [0, 1, 3]),
        (["ok", "failed", "failed", "ok"], [0, 1]),
    ],
)
def test_the_graph_is_in_one_piece(states: list[str], nodes: list[int]) -> None:
    pytest.importorskip("gtsam")
    frames = range(len(states) + 1)
    graph, values = load("pose_graph_gtsam").build(frames, Scripted(states))
    assert list(values.keys()) == nodes
    ends = [list(graph.at(k).keys())[-1] for k in range(graph.size())]
    assert sorted(ends) == nodes


def test_a_loop_moves_the_path_to_where_it_was() -> None:
    """Of a walk there and back, all of whose motions err to one side."""
    gtsam = pytest.importorskip("gtsam")
    rendered = scene()
    walk = [
        replace(rendered.render(k), index=i, timestamp=i / 24)
        for i, k in enumerate((0, 1, 2, 3, 2, 1, 0))
    ]
    aside = se3_exp(np.array([0.03, 0, 0, 0, 0, 0]))

    class Drifting(hybridvo.Odometry):
        """Each motion ends three centimetres aside, of five that it states."""

        def track(self, *arguments: object, **named: object) -> hybridvo.Step:
            step = super().track(*arguments, **named)
            if step.prev_index is None:
                return step
            motion = step.motion.replace(
                T_curr_prev=aside @ step.T_curr_prev,
                covariance=0.05**2 * np.eye(6),
            )
            drift = np.linalg.matrix_power(invert(aside), step.index)
            pose = step.T_world_cam @ drift
            return replace(step, T_world_cam=pose, motion=motion, measured=None)

    graph, values = load("pose_graph_gtsam").build(walk, Drifting(), apart=5)
    assert graph.size() > values.size()
    found = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    before, after = (
        np.linalg.norm(poses.atPose3(6).translation()) for poses in (values, found)
    )
    assert before > 0.15
    assert after < 0.01


def test_the_back_end_on_the_page_of_the_library_closes_its_loop(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("gtsam")
    # the walk is short
    loops = functools.partialmethod(hybridvo.Odometry.loops, apart=4)
    monkeypatch.setattr(hybridvo.Odometry, "loops", loops)
    page = (ROOT / "docs/library.md").read_text(encoding="utf-8")
    part = page.split("\n## A SLAM back end\n")[1]
    script = tmp_path / "back_end.py"
    script.write_text(
        part.split("```python\n")[1].split("```")[0], encoding="utf-8"
    )
    world = scene()
    # there and back, so that the last frame shows the place of the first
    walk = [
        replace(world.render(k), index=i) for i, k in enumerate((0, 1, 2, 1, 0))
    ]
    found = runpy.run_path(str(script), {"frames": walk})
    # a prior, a factor for each motion, and the loop
    assert found["graph"].size() == 1 + 4 + 1
    truth = path_of(world)
    for index, k in enumerate((0, 1, 2, 1, 0)):
        pose = found["poses"].atPose3(index).matrix()
        np.testing.assert_allclose(pose, truth[k], atol=5e-3)


def loop() -> tuple[list[np.ndarray], list[tuple[int, hybridvo.Edge]]]:
    """A square whose last motion contradicts the others, with uneven covariances."""
    side = se3_exp(np.array([0.0, 0.0, 1.0, 0.0, 0.5 * np.pi, 0.0]))
    poses = [np.linalg.matrix_power(side, k) for k in range(4)]
    rng = np.random.default_rng(1)
    factors = []
    for k in range(4):
        A = rng.standard_normal((6, 6))
        covariance = 1e-2 * (A @ A.T + 0.1 * np.eye(6))
        drawn = se3_exp(0.01 * rng.standard_normal(6))
        edge = hybridvo.Edge(k, drawn @ invert(side), covariance)
        factors.append(((k + 1) % 4, edge))
    return poses, factors


def test_gtsam_and_scipy_find_the_same_poses() -> None:
    gtsam = pytest.importorskip("gtsam")
    poses, factors = loop()
    by_gtsam = load("pose_graph_gtsam")
    by_scipy = load("smooth_scipy")
    graph = gtsam.NonlinearFactorGraph()
    values = gtsam.Values()
    held = gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)
    graph.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(poses[0]), held))
    for k, pose in enumerate(poses):
        values.insert(k, gtsam.Pose3(pose))
    for index, edge in factors:
        graph.add(by_gtsam.between(edge, index))
    answer = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    smoothed = by_scipy.smooth(poses, factors)
    moved = max(np.abs(a - b).max() for a, b in zip(smoothed, poses, strict=True))
    assert moved > 1e-3
    # small residuals, where the robust cost is the square; a covariance in the wrong order or on
    # the wrong side moves the poses by millimetres
    for k, pose in enumerate(smoothed):
        np.testing.assert_allclose(pose, answer.atPose3(k).matrix(), atol=2e-4)


def test_one_factor_is_fulfilled() -> None:
    module = load("smooth_scipy")
    poses, factors = loop()
    found = module.smooth(poses[:2], factors[:1])
    expected = poses[0] @ factors[0][1].T_start_curr
    np.testing.assert_allclose(found[1], expected, atol=1e-6)


def test_wheels_bridge_the_dark() -> None:
    module = load("ekf_wheels")
    rendered = scene(frames=7)
    truth = path_of(rendered)
    motions = [invert(truth[k + 1]) @ truth[k] for k in range(6)]
    wheels = [module.WHEELS @ se3_log(T) for T in motions]
    tracker = hybridvo.Odometry()
    frames = [rendered.render(k) for k in range(7)]
    for k in (3, 4):
        frame = frames[k]
        frames[k] = replace(frame, rgb=0 * frame.rgb, depth=0 * frame.depth)
    steps = [tracker.track(frame) for frame in frames]
    assert [step.usable for step in steps][3:5] == [False, False]
    poses = module.fuse(steps, wheels)
    assert np.linalg.norm(poses[2][:3, 3] - truth[2][:3, 3]) < 0.005
    # wheels do not see sideways motion, about which the filter knows the last one alone
    fused = np.linalg.norm(poses[-1][:3, 3] - truth[-1][:3, 3])
    alone = module.fuse(
        [step if step.ok else replace(step, prev_index=None) for step in steps],
        [np.zeros(2) for _ in wheels],
    )
    assert fused < 0.5 * np.linalg.norm(alone[-1][:3, 3] - truth[-1][:3, 3])


# --- masks, learning, notebook --------------------------------------------------------------------


@pytest.mark.long
def test_masks_cover_what_moves(tmp_path: Path) -> None:
    module = load("splat_masks")
    folder = module.export(module.rendered(tmp_path, frames=3), tmp_path / "run")
    assert (folder / "transforms.json").is_file()
    rendered = make_scene("light", 0, height=109, width=256, frames=3)
    moving = rendered.object_id(0) > 0
    path = sorted((folder / "masks").iterdir())[0]
    masked = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) == 0
    # windows of a few pixels: the outline of an object is not exact
    assert masked[moving].mean() > 0.6
    assert masked[~moving].mean() < 0.15


@pytest.mark.long
def test_weights_are_learned_through_the_refinement() -> None:
    pytest.importorskip("pypose")
    before, after = load("learn_weights").learn()
    assert after < 0.7 * before


@pytest.mark.long
def test_scales_are_learned_through_a_window() -> None:
    pytest.importorskip("pypose")
    before, after = load("learn_depth_scale").learn()
    assert after < 0.3 * before


@pytest.mark.long
def test_the_notebook_runs(tmp_path: Path) -> None:
    pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    code = """
import sys, nbformat
from nbclient import NotebookClient
book = nbformat.read(sys.argv[1], as_version=4)
NotebookClient(book, timeout=240, kernel_name="python3").execute()
nbformat.write(book, sys.argv[2])
"""
    out = tmp_path / "out.ipynb"
    arguments = [str(EXAMPLES / "demo.ipynb"), str(out)]
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments],
        capture_output=True,
        text=True,
        cwd=ROOT,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    text = out.read_text(encoding="utf-8")
    errors = re.findall(r"ATE ([\d.]+) cm", text)
    # a path of 70 cm in rendered images
    assert errors and float(errors[-1]) < 1.0
    assert text.count("image/png") == 3


# --- robots ---------------------------------------------------------------------------------------


def test_velocities_for_px4_have_its_axes_and_covariance_order() -> None:
    # 20 cm ahead and 10 cm down in a tenth of a second, as the optical frame has it
    motion = np.eye(4)
    motion[:3, 3] = [0.0, -0.1, -0.2]
    covariance = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    answer = RelativePose(motion, covariance, probability=0.97)
    step = hybridvo.Step(1, 5.0, np.eye(4), answer, prev_index=0)
    fields = load("px4_odometry").odometry(step, 0.1)
    speeds = [fields[name] for name in ("vx", "vy", "vz", "rollspeed")]
    np.testing.assert_allclose(speeds, [2, 0, 1, 0], atol=1e-12)
    # variances of ahead, right, down and about them, over the time squared
    variances = [fields["velocity_covariance"][k] for k in (0, 6, 11, 15, 18, 20)]
    np.testing.assert_allclose(variances, 100 * np.array([3, 1, 2, 6, 4, 5]))
    assert (fields["quality"], fields["time_usec"]) == (97, 5_000_000)
    failed = replace(step, motion=RelativePose.failed(Reason.LOW_INLIERS, "dark"))
    assert load("px4_odometry").odometry(failed, 0.1)["quality"] == -1


def test_fields_for_px4_are_those_of_mavlink() -> None:
    mavlink = pytest.importorskip("pymavlink.dialects.v20.common")
    step = hybridvo.Step(1, 5.0, np.eye(4), RelativePose(), prev_index=0)
    fields = load("px4_odometry").odometry(step, 0.1)
    sender = mavlink.MAVLink(None)
    assert sender.odometry_encode(**fields).pack(sender)


def test_poses_of_a_run_become_columns_and_those_of_umi(tmp_path: Path) -> None:
    (tmp_path / "trajectory.tum").write_text(
        "".join(f"{5 + i / 10} {i} 0 0 0 0 0 1\n" for i in range(3))
    )
    rows = ["index,timestamp,status,probability", "0,5.0,ok,1.0"]
    rows += ["1,5.1,failed,0.0", "2,5.2,degraded,0.7"]
    (tmp_path / "steps.csv").write_text("\n".join(rows) + "\n")
    example = load("robot_learning")
    table = example.columns(tmp_path)
    assert table["pose_ok"].tolist() == [True, False, False]
    assert table["pose_lost"].tolist() == [False, True, False]
    np.testing.assert_allclose(table["camera_pose"][2], [2, 0, 0, 0, 0, 0, 1])
    example.main(tmp_path)
    lines = (tmp_path / "camera_trajectory.csv").read_text().splitlines()
    assert lines[0] == (
        "frame_idx,timestamp,state,is_lost,is_keyframe,x,y,z,q_x,q_y,q_z,q_w"
    )
    assert lines[2].startswith("1,0.1,1,true,false,1.0,0.0")


# --- the pages ------------------------------------------------------------------------------------


def blocks(page: str) -> list[str]:
    """The Python code of a page, in its order."""
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    found = re.findall(
        r"^( *)```python\n(.*?)^ *```$", text, re.DOTALL | re.MULTILINE
    )
    return [textwrap.dedent(code) for _, code in found]


@pytest.mark.slow
def test_the_code_of_the_librarys_page_runs(
    image_walk: Path, tmp_path: Path
) -> None:
    sequence = hybridvo.open_sequence(image_walk)
    frames = [sequence[i] for i in range(3)]
    factors: list[tuple] = []
    names = {
        "sensor": [(frame.rgb, frame.depth, frame.timestamp) for frame in frames],
        "camera": frames[0].camera,
        "graph": SimpleNamespace(
            add_between=lambda *factor: factors.append(factor)
        ),
        "map_": SimpleNamespace(insert=lambda *_: None),
        "frames": frames,
        "follow": lambda *_: None,
        "frame": frames[2],
        "frame0": frames[0],
        "frame1": frames[1],
        "flow": hybridvo.dis_flow()(frames[0], frames[1]).flow,
        "pairs": list(hybridvo.iter_pairs(sequence, flow=hybridvo.dis_flow()))[:1],
        "stamps": np.array([0.0, 0.01]),
        "rates": np.zeros((2, 3)),
        "R_cam_imu": np.eye(3),
        "accelerations": np.array([[0.0, -9.81, 0.0]] * 2),
    }
    for code in blocks("library.md"):
        if "import gtsam" in code and find_spec("gtsam") is None:
            continue
        code = code.replace("path/to/sequence", str(image_walk))
        exec(code.replace("path.tum", str(tmp_path / "path.tum")), names)
    # a motion starts from the frame before, or from an earlier one that is surer
    assert [curr for _, curr, *_ in factors] == [1, 2]
    assert all(prev < curr for prev, curr, *_ in factors)
    assert len((tmp_path / "path.tum").read_text().splitlines()) == len(sequence)
