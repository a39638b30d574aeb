"""The public names: what ``import hybridvo as hvo`` offers, and what each says of itself."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import pickle
import re
from pathlib import Path

import mypy.api
import numpy as np
import pytest
import torch

import hybridvo
from hybridvo.core import results
from hybridvo.core.options import Options
from hybridvo.network.selection import PoseSeed
from tests.project import source_tree as source

NAMES = set(
    """
BatchedPose Camera Edge FlowField Frame FramePair Gravity ImuSamples
InputError MotionPrior MovingObject Odometry Options PWVO PairBatch PoseSeed Reason
RelativePose Rival State Status Step Trajectory chain_covariance dis_flow estimate
evaluate example_frames gyro_prior iter_pairs open_sequence refine resize_frame select
to_g2o_information to_gtsam_covariance to_ros_covariance track_in_passes write_g2o
""".split()
)


def test_the_public_names() -> None:
    assert {name for name in hybridvo.__all__ if name != "__version__"} == NAMES
    assert set(dir(hybridvo)) >= NAMES


def test_type_checkers_see_every_public_name_at_its_home() -> None:
    tree = source.files()["__init__.py"]
    seen = {
        alias.asname: f"{node.module}.{alias.name}"
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom)
        and (node.module or "").startswith("hybridvo.")
        for alias in node.names
    }
    assert seen == {
        name: f"hybridvo.{module}.{name}" for name, module in hybridvo._HOME.items()
    }


def documented(value: type) -> set[str]:
    """Names in the Attributes section of a docstring."""
    section = re.search(
        r"^Attributes:\n((?:    .*\n?|\n)*)", inspect.getdoc(value) or "", re.M
    )
    return set(re.findall(r"^    (\w+): ", section[1], re.M)) if section else set()


GROUPS = [field.default.__class__ for field in dataclasses.fields(Options)]
INSIDE = [
    results.Hypothesis,
    results.PixelwisePrediction,
    PoseSeed,
]


def classes() -> list[type]:
    """Public classes of named values, and those that they are made of."""
    public = [getattr(hybridvo, name) for name in sorted(NAMES)]
    return [c for c in [*public, *GROUPS, *INSIDE] if fields_of(c)]


def fields_of(value: object) -> set[str]:
    if not inspect.isclass(value):
        return set()
    if dataclasses.is_dataclass(value):
        return {field.name for field in dataclasses.fields(value)}
    return set(getattr(value, "_fields", ()))


@pytest.mark.parametrize("value", classes(), ids=lambda c: c.__name__)
def test_the_fields_are_documented_where_help_shows_them(value: type) -> None:
    assert documented(value) == fields_of(value)


SCRIPT = """
import numpy as np
import hybridvo as hvo

camera = hvo.Camera(525.0, 525.0, 319.5, 239.5, height=480, width=640)
frame = hvo.Frame(None, np.ones((480, 640), np.float32), camera)
pair = hvo.FramePair(frame, frame, None)
reveal_type(camera)
reveal_type(pair)
reveal_type(hvo.estimate(frame, frame))
reveal_type(hvo.estimate(pair).probability)
reveal_type(hvo.refine(pair).status)
batch = hvo.PairBatch.from_pairs([pair])
reveal_type(batch.flow)
network = hvo.PWVO.from_pretrained()
reveal_type(network)
maps = network(batch)
reveal_type(maps)
seed = hvo.select(maps)
reveal_type(seed.weights)
motion = hvo.refine(batch, seed.T_curr_prev, seed.weights, noise=(0.3, 0.02), kernel="cauchy")
reveal_type(motion)
reveal_type(motion.probability)
vo = hvo.Odometry(options=hvo.Options())
step = vo.track(frame)
reveal_type(step)
reveal_type(step.ok)
reveal_type(step.T_prev_curr)
reveal_type(step.status.reason is hvo.Reason.NONE)
reveal_type(hvo.State.OK)
reveal_type(hvo.InputError("x"))
reveal_type(hvo.FlowField(None))
reveal_type(hvo.resize_frame(frame, 240, 320))
reveal_type(hvo.MotionPrior(np.eye(4), np.eye(6)))
"""


@pytest.mark.long
def test_mypy_sees_real_types(tmp_path: Path) -> None:
    script = tmp_path / "user.py"
    script.write_text(SCRIPT)
    plain = ["--config-file=", f"--cache-dir={tmp_path / 'cache'}", str(script)]
    strict = ["--strict", "--ignore-missing-imports", "--follow-imports=silent"]
    out, errors, code = mypy.api.run([*strict, *plain])
    assert code == 0, out + errors
    revealed = re.findall(r'Revealed type is "(.*)"', out)
    assert len(revealed) == SCRIPT.count("reveal_type(")
    # numpy's own arrays have any shape and type
    assert not [
        text for text in revealed if "Any" in text and "numpy.ndarray" not in text
    ]
    script.write_text("import hybridvo as hvo\nhvo.Odometer\n")
    out, _, code = mypy.api.run([*strict, *plain])
    assert code == 1 and "Odometer" in out


def test_what_users_print_is_one_short_line() -> None:
    camera = hybridvo.Camera(fx=80, fy=80, cx=39.5, cy=29.5, height=60, width=80)
    rgb = np.random.default_rng(0).integers(0, 255, (60, 80, 3), np.uint8)
    depth = np.full((60, 80), 1.5, np.float32)
    depth[:, :40] = 0
    frames = [hybridvo.Frame(rgb, depth, camera, 0.1 * i, i) for i in range(3)]
    vo = hybridvo.Odometry(network=None)
    steps = [vo.track(frame) for frame in frames]
    pair = hybridvo.FramePair(frames[0], frames[1], np.zeros((60, 80, 2)))
    path = hybridvo.Trajectory(np.arange(3.0), np.tile(np.eye(4), (3, 1, 1)))
    batch = hybridvo.PairBatch.from_pairs([pair, pair])
    for value in (*frames, vo, *steps, pair, path, batch, steps[1].motion):
        text = repr(value)
        assert "\n" not in text and len(text) < 250, text
        assert text.startswith((type(value).__name__, "RelativePose"))
    assert "depth on 50 %, median 1.5 m" in repr(frames[0])
    assert "first" in repr(steps[0]) and "Step(2 from " in repr(steps[2])
    assert "3 frames" in repr(vo)


def test_parts_of_a_batch(tmp_path: Path) -> None:
    camera = hybridvo.Camera(fx=8, fy=8, cx=3.5, cy=2.5, height=6, width=8)
    made = [
        hybridvo.FramePair(
            hybridvo.Frame(
                np.full((6, 8, 3), k, np.uint8), np.ones((6, 8)), camera
            ),
            hybridvo.Frame(
                np.full((6, 8, 3), k, np.uint8), np.ones((6, 8)), camera
            ),
            np.full((6, 8, 2), float(k)),
        )
        for k in range(4)
    ]
    batch = hybridvo.PairBatch.from_pairs(made)
    assert len(batch) == 4
    mask = torch.tensor([True, False, False, True])
    for part, expected in ((slice(1, 3), [1, 2]), ([3, 0], [3, 0]), (mask, [0, 3])):
        some = batch[part]
        assert some.flow[:, 0, 0, 0].tolist() == expected
        assert some.rgb_prev[:, 0, 0, 0].tolist() == expected
        assert some.has_images.tolist() == [True] * len(expected)
    double = batch.to("cpu", torch.float64)
    assert double.flow.dtype == double.K_prev.dtype == torch.float64
    assert double.rgb_prev.dtype == torch.uint8
    assert batch.to("cpu").flow.dtype == torch.float32
    flow = batch.flow.clone().requires_grad_()
    dataclasses.replace(batch, flow=flow)[1:].to(
        dtype=torch.float64
    ).flow.sum().backward()
    assert flow.grad[:, 0, 0, 0].tolist() == [0, 1, 1, 1]
    for wrong in (1, slice(4, 9), [7], "a"):
        with pytest.raises(hybridvo.InputError, match="PairBatch"):
            batch[wrong]


def test_a_path_is_loaded_as_it_was_saved(tmp_path: Path) -> None:
    T = np.tile(np.eye(4), (3, 1, 1))
    T[:, 0, 3] = (0.0, 0.25, 0.5)
    path = hybridvo.Trajectory(np.array([0.0, 0.1, 0.2]), T)
    for name in ("a.tum", "a.kitti"):
        path.save(tmp_path / name)
        again = hybridvo.Trajectory.load(tmp_path / name)
        np.testing.assert_allclose(again.T_world_cam, T)
        assert again.has_timestamps == name.endswith(".tum")


def test_a_step_keeps_a_byte_for_each_weight() -> None:
    frames = hybridvo.example_frames()
    vo = hybridvo.Odometry()
    steps = [vo.track(frame) for frame in frames]
    motion = steps[1].motion
    assert motion.weights.shape == frames[0].camera.shape
    assert motion.weights.dtype == np.float32
    assert 0 <= motion.weights.min() and 0.5 < motion.weights.max() <= 1
    pixels = motion.weights.size
    for step in (steps[1], pickle.loads(pickle.dumps(steps[1]))):
        plain = step.motion.replace(hypotheses=())
        assert len(pickle.dumps(plain)) < 1.2 * pixels
        np.testing.assert_array_equal(step.motion.weights, motion.weights)
    estimated = hybridvo.estimate(frames[0], frames[1])
    kept = results.StepMotion.of(estimated)
    np.testing.assert_allclose(
        kept.weights, estimated.weights, atol=0.5 / 255 + 1e-6
    )
    assert kept.replace(weights=None).weights is None
    again = results.StepMotion.of(kept.replace(probability=0.5))
    assert again.probability == 0.5
    np.testing.assert_array_equal(again.weights, kept.weights)
    with pytest.raises(dataclasses.FrozenInstanceError):
        kept.weights = None


def test_nobody_has_to_remember_whether_height_or_width_comes_first() -> None:
    with pytest.raises(TypeError, match="positional"):
        hybridvo.Camera(500, 500, 319.5, 239.5, 640, 480)
    camera = hybridvo.Camera(500, 500, 319.5, 239.5, width=640, height=480)
    assert camera.shape == (480, 640)
