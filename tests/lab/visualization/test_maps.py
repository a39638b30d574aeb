from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from hybridvo.api import estimate
from hybridvo.core.errors import InputError
from hybridvo.core.results import PixelwisePrediction
from hybridvo.core.types import FramePair
from hybridvo.flow.colours import flow_colours
from hybridvo.flow.providers import dis_flow, with_flow
from hybridvo.io.data.open import open_sequence
from hybridvo.lab.synthetic.render import SyntheticSequence, write_sintel
from hybridvo.lab.synthetic.scenes import make_scene
from hybridvo.lab.visualization.pair import (
    coherent,
    moving_pixels,
    pair_panels,
    prediction_panels,
)
from hybridvo.lab.visualization.panels import (
    Panel,
    flow_panel,
    write_panels,
)
from hybridvo.lab.visualization.saliency import (
    integrated_gradients,
    network_saliencies,
)
from hybridvo.network.inputs import assemble_inputs
from hybridvo.network.paper.networks import NetworkOptions, build_network
from hybridvo.network.pwvo import PWVO, PWVOOptions
from hybridvo.network.weights import save_weights
from hybridvo.run.cli import main
from hybridvo.run.commands.show import draw_pair


@pytest.fixture(scope="module")
def known() -> FramePair:
    """A rendered pair with movers, and its true flow."""
    sequence = SyntheticSequence(
        make_scene("light", 1, height=64, width=128, frames=4)
    )
    prev, curr = sequence.frame(1), sequence.frame(2)
    return FramePair(prev, curr, sequence.flow(1)[0], flow_is_true=True)


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


def test_colours_of_lengths() -> None:
    flow = np.array(
        [[[0.5, 0.0], [1.0, 0.0], [2.0, 0.0], [np.nan, 0.0], [np.inf, 1.0]]]
    )
    half, full, longer, nan, inf = (
        list(map(int, c)) for c in flow_colours(flow, 1.0)[0]
    )
    assert half == [255, 128, 128] and full == [255, 0, 0] and longer == [191, 0, 0]
    assert nan == inf == [0, 0, 0]
    assert flow_colours(np.full((3, 4, 2), np.nan)).max() == 0


# -- networks -------------------------------------------------------------------------------------


def test_uncertainty_and_error_maps_by_hand() -> None:
    maps = torch.zeros(2, 6, 4, 5)
    maps[:, 3:] += 2.0
    maps[1] += 7.0  # the second pair is not looked at
    s = torch.tensor([0.0, 1.0, 2.0, -1.0, 0.0, 1.0])[None, :, None, None].expand(
        2, 6, 4, 5
    )
    prediction = PixelwisePrediction(maps, s)
    true = np.array([1.0, 2.0, 3.0]), np.array([2.0, 2.0, 0.5])
    panels = prediction_panels(prediction, true, np.ones((4, 5), bool))
    # uncertainty and error of the rotation, of the translation
    expected = (np.e, 2.0, 1.0, 0.5)
    for panel, value in zip(panels, expected, strict=True):
        np.testing.assert_allclose(panel.values, np.full((4, 5), value), rtol=1e-6)
    assert prediction_panels(PixelwisePrediction(maps), None, true[0]) == []
    uncertain = [panel for panel in panels if "uncertainty" in panel.title]
    assert all(panel.log for panel in uncertain) and not any(
        p.log for p in panels[1::2]
    )
    seen = np.ones((4, 5), bool)
    seen[0] = False  # without depth nothing is known: no colour for it
    unseen = prediction_panels(prediction, true, np.ones((4, 5), bool), seen)[
        0
    ].values
    assert np.isnan(unseen[0]).all() and np.isfinite(unseen[1:]).all()


def test_a_scale_over_decades_shows_every_decade(tmp_path: Path) -> None:
    """Stripes of 1e-4 to 1e0: all have colours of their own, on a linear scale all but one none."""
    stripes = np.repeat(10.0 ** np.arange(-4, 1), 8)[None].repeat(20, axis=0)
    counts = {}
    for log in (False, True):
        path = tmp_path / f"{log}.png"
        write_panels(path, [Panel("U", stripes, "deg", log=log)], "", 2.0)
        picture = cv2.imread(str(path))
        row = picture[picture.shape[0] // 2, : picture.shape[1] // 3].astype(int)
        steps = np.abs(np.diff(row, axis=0)).sum(axis=1)
        counts[log] = int((steps > 30).sum())
    assert (counts[False], counts[True]) == (3, 5)  # of the edges of the panel too


def test_only_coherent_regions_are_outlined() -> None:
    """Noise of single pixels and thin edges are no movers; a body is, and the whole of it."""
    rng = np.random.default_rng(0)
    noise = rng.uniform(size=(120, 160)) < 0.05
    noise[:, 40] = True
    assert not coherent(noise).any()
    body = noise.copy()
    body[30:70, 90:140] = True
    found = coherent(body)
    inside = np.zeros_like(body)
    inside[30:70, 90:140] = True
    assert found[35:65, 95:135].all() and (found & ~inside).mean() < 0.005


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


OPTIONS = (
    NetworkOptions(width=0.25, head_stride=2),
    NetworkOptions(width=0.25, head_stride=2, uncertainty=False),
    NetworkOptions(kind="vonet", width=0.25),
    NetworkOptions(kind="vonet-attention", width=0.25),
    NetworkOptions(width=0.25, head_stride=2, scale_free=True),
)


@pytest.mark.long
@pytest.mark.parametrize(
    "options",
    OPTIONS,
    ids=["paper", "pixelwise", "vonet", "attention", "scale-free"],
)
def test_the_saliency_is_of_what_the_network_reads(
    known, options: NetworkOptions
) -> None:
    torch.manual_seed(0)
    network = build_network(options).eval()
    inputs = assemble_inputs(known, (64, 128))
    found = network_saliencies(network, inputs, 4)
    assert list(found) == ["rotation", "translation"]
    for saliency in found.values():
        assert saliency.shape == (64, 128)
        assert np.isfinite(saliency).all() and saliency.max() > 0
        # what is as in the baseline cannot matter
        read = (
            inputs.flow
            if options.scale_free
            else torch.cat([inputs.flow, inputs.inverse_depth], 1)
        )
        unseen = (read[0] == 0).all(0).numpy()
        assert saliency[unseen].sum() == 0


# -- the picture and the tool ---------------------------------------------------------------------


def test_the_picture_has_all_panels(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    flow = rng.standard_normal((20, 40, 2))
    mask = np.zeros((20, 40), bool)
    mask[5:9, 5:9] = True
    panels = [
        Panel("image", np.full((20, 40, 3), 200, np.uint8)),
        flow_panel("flow", flow, 2.0),
        Panel("weights", rng.uniform(size=(10, 20)), "", 1.0, mask),
        Panel("nothing known", np.full((5, 10), np.nan), "px"),
        Panel("zeros", np.zeros((5, 10)), "px"),
    ]
    write_panels(tmp_path / "all.png", panels, "heading", 2.0)
    write_panels(tmp_path / "few.png", panels[:2], "h", 2.0)
    picture, few = (
        cv2.imread(str(tmp_path / f"{name}.png")) for name in ("all", "few")
    )
    assert picture.shape[1] == few.shape[1] > 1000
    assert picture.shape[0] > 2.4 * few.shape[0]


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
    arguments = [
        "--sequence",
        sequence,
        "--pair",
        "1",
        "--flow",
        "dis",
        "--method",
        "classical",
    ]
    arguments += ["--weights", f"pwvo={folder / 'pwvo.safetensors'}"]
    few = tmp_path / "few.png"
    assert main(["show", *arguments, "--out", str(few)]) == 0
    # two rows: image, depth, flow; what the motion leaves, weights
    assert cv2.imread(str(few)).shape[0] < 800
    capsys.readouterr()
    arguments.append("--all")
    assert main(["show", *arguments, "--out", str(out)]) == 0
    assert capsys.readouterr().out.split() == [str(out)]
    # images, depth, three flows, error, weights; four maps and two saliencies of the network
    picture = cv2.imread(str(out))
    assert picture.shape[0] > 800 and picture.shape[1] > 1000
    assert (picture == 255).all(axis=2).mean() < 0.35  # little of it is empty
    before = out.read_bytes()
    assert main(["show", *arguments, "--out", str(out)]) == 2
    assert "pass --overwrite" in capsys.readouterr().err
    assert out.read_bytes() == before


@pytest.mark.parametrize(
    ("options", "field"),
    [
        (["--pair", "3"], "got 3"),
        (["--pair", "-1"], "got -1"),
        (["--pair", "0", "--weights", "pwvo=none.safetensors"], "none.safetensors"),
        (["--pair", "0", "--method", "refin"], "classical"),
    ],
)
def test_bad_options(folder: Path, tmp_path: Path, options, field, capsys) -> None:
    sequence = str(folder / "training" / "clean" / "tiny")
    out = tmp_path / "out.png"
    assert main(["show", "--sequence", sequence, "--out", str(out), *options]) == 2
    assert field in capsys.readouterr().err
    assert not out.exists()


def test_bad_targets(folder: Path, tmp_path: Path) -> None:
    sequence = open_sequence(folder / "training" / "clean" / "tiny")
    with pytest.raises(InputError, match=r"a\.jpg: expected .*png"):
        draw_pair(sequence, 0, tmp_path / "a.jpg")
