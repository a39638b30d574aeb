"""The public names: what ``import hybridvo as hvo`` offers, and what each says of itself."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import re
from pathlib import Path

import mypy.api
import pytest

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
to_g2o_information to_gtsam_covariance to_ros_covariance track_in_passes
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

camera = hvo.Camera(525.0, 525.0, 319.5, 239.5, 480, 640)
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
