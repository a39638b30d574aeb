from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from hybridvo.api import estimate
from hybridvo.core.types import FramePair
from hybridvo.flow.colours import flow_colours
from hybridvo.flow.providers import dis_flow, with_flow
from hybridvo.network.pwvo import PWVO, PWVOOptions
from hybridvo.network.weights import save_weights
from hybridvo.run.cli import main
from hybridvo_lab.synthetic.render import SyntheticSequence, write_sintel
from hybridvo_lab.synthetic.scenes import make_scene
from hybridvo_lab.visualization.pair import (
    moving_pixels,
    pair_panels,
)
from hybridvo_lab.visualization.saliency import (
    integrated_gradients,
)

# -- flow in colours ------------------------------------------------------------------------------


def test_colours_of_directions_by_hand() -> None:
    flow = np.array(
        [[[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]]]
    )
    white, right, down, left, up = (
        list(map(int, c)) for c in flow_colours(flow, 1.0)[0]
    )
    assert white == [255, 255, 255]
    assert right == [255, 0, 0] and left == [0, 255, 255]
    # a hue between two colours may be rounded to either side
    assert down in ([127, 255, 0], [128, 255, 0])
    assert up in ([127, 0, 255], [128, 0, 255])


# -- networks -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("kind", "moves"), [("static", False), ("light", True)])
def test_what_moves_is_outlined_and_a_static_scene_is_not(
    kind: str, moves: bool
) -> None:
    """Flow is DIS, whose errors in smooth parts are longer than a pixel, and no truth is told."""
    sequence = SyntheticSequence(
        make_scene(kind, 1, height=120, width=160, frames=4)
    )
    prev, curr = sequence.frame(1), sequence.frame(2)
    pair = with_flow(FramePair(prev, curr, None), dis_flow())
    noisy = pair.flow.copy()
    # as in a smooth part; the estimator sees that it is uncertain
    noisy[20:40, 20:120] += 1.5
    variance = np.full(pair.flow.shape[:2], 0.01, np.float32)
    variance[20:40, 20:120] = 4.0
    given = replace(pair, flow=noisy, flow_variance=variance)
    motion = estimate(given, method="classical")
    moving = moving_pixels(given, motion, None, None)
    panels = pair_panels(given, motion, None, moving)
    titles = [panel.title for panel in panels]
    assert titles[:3] == ["previous image", "current image", "depth"]
    assert moving.any() == moves
    assert any("outline: moving" in title for title in titles) == moves
    if moves:
        true = sequence.scene.object_id(1) > 0
        assert (moving & true).sum() > 0.7 * moving.sum()


def test_gradients_of_a_linear_answer_are_its_terms() -> None:
    generator = torch.Generator().manual_seed(0)
    x, w = (torch.randn(1, 2, 3, 4, generator=generator) for _ in range(2))
    y = torch.randn(1, 1, 3, 4, generator=generator)
    found = integrated_gradients(
        lambda a, b: (w * a).sum() + 0.0 * b.sum(), (x, y), steps=1
    )
    torch.testing.assert_close(found[0], w * x)
    assert not found[1].any()


def test_the_quadrature_is_exact_for_polynomials() -> None:
    # n Gauss nodes integrate degree 2 n - 1: the gradient of x^6 with three of them
    x = torch.full((1, 1, 2, 2), 1.3, dtype=torch.float64)
    for steps, is_exact in ((3, True), (2, False)):
        (found,) = integrated_gradients(lambda a: (a**6).sum(), (x,), steps)
        assert (
            float(found.sum()) == pytest.approx(4 * 1.3**6, rel=1e-12)
        ) == is_exact


# -- the picture and the tool ---------------------------------------------------------------------


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("sintel")
    write_sintel(
        make_scene("light", 1, height=64, width=128, frames=4), root, "tiny"
    )
    torch.manual_seed(0)
    network = PWVO(PWVOOptions(width=0.25))
    # heads that say something: the saliency of a constant is nothing
    torch.nn.init.normal_(network.head_motion.weight, std=0.1)
    save_weights(root / "pwvo.safetensors", network, {})
    return root


@pytest.mark.slow
def test_the_tool_draws_a_pair(folder: Path, tmp_path: Path, capsys) -> None:
    sequence = str(folder / "training" / "clean" / "tiny")
    out = tmp_path / "new" / "pair.png"
    arguments = ["--sequence", sequence, "--pair", "1", "--flow", "dis"]
    arguments += ["--method", "classical"]
    arguments += ["--weights", f"pwvo={folder / 'pwvo.safetensors'}"]
    arguments.append("--all")
    assert main(["show", *arguments, "--out", str(out)]) == 0
    assert capsys.readouterr().out.split() == [str(out)]
    # images, depth, three flows, error, weights; four maps and two saliencies of the network
    picture = cv2.imread(str(out))
    assert picture.shape[0] > 800 and picture.shape[1] > 1000
    before = out.read_bytes()
    assert main(["show", *arguments, "--out", str(out)]) == 2
    assert "pass another name as --out" in capsys.readouterr().err
    assert out.read_bytes() == before


@pytest.mark.parametrize(
    ("pair", "out", "named"),
    [("3", "a.png", "got 3"), ("-1", "a.png", "got -1"), ("0", "a.jpg", "a.jpg")],
)
def test_what_cannot_be_drawn_is_refused(
    folder: Path, tmp_path: Path, pair: str, out: str, named: str, capsys
) -> None:
    sequence = str(folder / "training" / "clean" / "tiny")
    words = ["--sequence", sequence, "--pair", pair, "--out", str(tmp_path / out)]
    assert main(["show", *words]) == 2
    assert named in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
