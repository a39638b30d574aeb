"""Networks in ONNX files: what goes in, what comes out, and what is refused."""

from __future__ import annotations

import importlib
import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hybridvo import Camera, Frame, InputError, Odometry
from hybridvo.core.errors import FormatError
from hybridvo.core.results import Reason, State
from hybridvo.io.onnx import session as sessions
from hybridvo.io.onnx.depth import DepthNetwork
from hybridvo.io.onnx.description import description_names, read_description
from hybridvo.io.onnx.flow import FlowNetwork
from hybridvo.io.onnx.images import place
from hybridvo.io.onnx.mask import MaskNetwork
from tests.io.onnx.graphs import (
    constant_network,
    depth_network,
    describe,
    flow_network,
    mask_network,
)

HEIGHT = 12
WIDTH = 16
CAMERA = Camera(20.0, 20.0, 7.5, 5.5, height=HEIGHT, width=WIDTH)
DEPTH = "task: depth\n"
FLOW = "task: flow\n"


def grey(level: int) -> np.ndarray:
    return np.full((HEIGHT, WIDTH, 3), level, np.uint8)


def colours(seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.integers(1, 255, (HEIGHT, WIDTH, 3), np.uint8)


def predicted(model: Path, text: str, rgb: np.ndarray) -> np.ndarray:
    return DepthNetwork(describe(model, text)).predict(rgb, CAMERA)


# -- units -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", 40.0),
        ("unit: millimetres\n", 0.04),
        ("unit: inverse\n", 1 / 40),
        # a camera of 20 px sees what one of 10 px sees twice as near
        ("canonical_focal: 10\n", 80.0),
        ("std: [4, 4, 4]\nmean: [20, 20, 20]\n", 5.0),
        ("max_depth_m: 30\n", 0.0),
    ],
)
def test_depth_is_in_metres(text: str, expected: float, tmp_path: Path) -> None:
    depth = predicted(depth_network(tmp_path / "a.onnx"), DEPTH + text, grey(40))
    assert depth.shape == (HEIGHT, WIDTH)
    assert depth.dtype == np.float32
    np.testing.assert_allclose(depth, expected, rtol=1e-6)


def _written(folder: Path, text: str) -> Path:
    path = folder / "what.yaml"
    path.write_text(text)
    return path


# -- sizes -------------------------------------------------------------------------------


def test_padding_is_cut_off_again(tmp_path: Path) -> None:
    # 12x16 in 40x32: twice as large, with eight rows above and below
    model = depth_network(tmp_path / "a.onnx", size=(40, 32))
    text = f"{DEPTH}fit: pad\npadding: [250, 250, 250]\n"
    ramp = np.broadcast_to(10 * np.arange(WIDTH)[:, None] + 20, (HEIGHT, WIDTH, 3))
    depth = predicted(model, text, ramp.astype(np.uint8))
    # enlarged and made smaller again, a ramp stays what it was inside
    np.testing.assert_allclose(depth[:, 1:-1], ramp[:, 1:-1, 0], rtol=1e-5)
    assert depth.max() < 200


def test_the_camera_of_a_resized_image_sees_the_same_rays(tmp_path: Path) -> None:
    what = read_description(
        _written(tmp_path, f"{DEPTH}size: [40, 32]\nfit: pad\n"), "depth"
    )
    seen = place((HEIGHT, WIDTH), what, None).camera(CAMERA)
    # the centre of pixel (3, 2), at (2 * 3.5 - 0.5, 2 * 2.5 - 0.5 + 8) there
    assert (6.5 - seen.cx) / seen.fx == pytest.approx((3 - 7.5) / 20)
    assert (12.5 - seen.cy) / seen.fy == pytest.approx((2 - 5.5) / 20)


# -- point maps and validity -------------------------------------------------------------


def test_a_point_map_is_shifted_onto_its_rays(tmp_path: Path) -> None:
    v, u = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    z = 2.0 + 0.1 * u + 0.05 * v
    points = np.stack([(u - 7.5) / 20 * z, (v - 5.5) / 20 * z, z - 0.7], axis=-1)
    seen = np.ones((1, HEIGHT, WIDTH))
    seen[0, 0] = 0.0
    outputs = {"points": points[None], "mask": seen, "scale": np.array([3.0])}
    inputs = {"image": (1, 3, HEIGHT, WIDTH), "num_tokens": ()}
    model = constant_network(tmp_path / "a.onnx", outputs, inputs)
    ready = read_description(_ready("moge2_small"), "depth")
    assert ready.recover_shift
    depth = DepthNetwork(f"onnx:{model}@{_fixed_moge(tmp_path)}").predict(
        colours(), CAMERA
    )
    assert (depth[0] == 0).all()
    np.testing.assert_allclose(depth[1:], 3 * z[1:], rtol=1e-5)


def _ready(name: str) -> Path:
    return Path(__file__).parents[3] / "configs" / "onnx" / f"{name}.yaml"


def _fixed_moge(folder: Path) -> Path:
    """The ready description with a size of its own, as the image is smaller than a patch."""
    text = _ready("moge2_small").read_text(encoding="utf-8")
    path = folder / "moge.yaml"
    path.write_text(text + f"size: [{HEIGHT}, {WIDTH}]\n")
    return path


def test_every_ready_description_can_be_read() -> None:
    names = description_names()
    assert set(names) >= {
        *("metric3d_small", "moge2_small", "da3_metric", "unidepth_v2"),
        *("neuflow_v2", "sea_raft", "pphumanseg"),
    }
    tasks = {"neuflow_v2": "flow", "sea_raft": "flow", "pphumanseg": "mask"}
    for name in names:
        what = read_description(_ready(name), tasks.get(name, "depth"))
        assert what.file and what.licence
        assert "ot tried with the real" in what.note


# -- flow --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("size", "text", "expected"),
    [
        (("h", "w"), "", (3.0, -2.0)),
        # twice as wide, three times as high
        ((36, 32), "", (1.5, -2 / 3)),
        (("h", "w"), "flow_scale: 2\n", (6.0, -4.0)),
        # twice as large with padding
        ((40, 32), "fit: pad\n", (1.5, -1.0)),
    ],
)
def test_flow_is_in_the_pixels_of_the_camera(
    size: tuple, text: str, expected: tuple[float, float], tmp_path: Path
) -> None:
    model = flow_network(tmp_path / "a.onnx", 3.0, -2.0, size)
    network = FlowNetwork(describe(model, f"{FLOW}{text}both_directions: false\n"))
    prev = Frame(colours(0), None, CAMERA)
    field = network(prev, Frame(colours(1), None, CAMERA))
    assert field.flow.shape == (HEIGHT, WIDTH, 2)
    np.testing.assert_allclose(
        field.flow, np.broadcast_to(expected, field.flow.shape)
    )
    assert field.source == "onnx a.onnx"
    assert field.variance is None


def test_flow_that_differs_backward_is_not_valid(tmp_path: Path) -> None:
    prev = Frame(grey(40), None, CAMERA)
    curr = Frame(grey(41), None, CAMERA)
    # forward 2 px, backward -2 px
    exact = flow_network(tmp_path / "a.onnx", 0.0, 0.0, slope=2.0)
    field = FlowNetwork(describe(exact, FLOW))(prev, curr)
    np.testing.assert_allclose(field.flow, 2.0)
    assert field.valid[:-2, :-2].all()
    assert not field.valid[:, -1].any()
    # 9 px both ways
    wrong = flow_network(tmp_path / "b.onnx", 9.0, 0.0)
    assert not FlowNetwork(describe(wrong, FLOW))(prev, curr).valid.any()


# -- masks -------------------------------------------------------------------------------


def test_people_are_masked(tmp_path: Path) -> None:
    rgb = grey(10)
    rgb[3:7, 4:9, 0] = 200
    model = mask_network(tmp_path / "a.onnx")
    network = MaskNetwork(describe(model, "task: mask\nstd: [255, 255, 255]\n"))
    given = np.ones((HEIGHT, WIDTH), bool)
    given[0] = False
    frame = network(Frame(rgb, np.ones((HEIGHT, WIDTH)), CAMERA, mask=given))
    expected = given.copy()
    expected[3:7, 4:9] = False
    np.testing.assert_array_equal(frame.mask, expected)
    np.testing.assert_array_equal(np.isfinite(frame.depth), expected)


# -- what is wrong -----------------------------------------------------------------------


def test_depth_that_is_not_finite_is_a_status(tmp_path: Path) -> None:
    nothing = np.full((1, 1, HEIGHT, WIDTH), np.nan)
    inputs = {"image": (1, 3, HEIGHT, WIDTH)}
    model = constant_network(tmp_path / "a.onnx", {"depth": nothing}, inputs)
    network = DepthNetwork(describe(model, DEPTH))
    frames = [network(Frame(colours(i), None, CAMERA)) for i in range(2)]
    assert (frames[0].depth == 0).all()
    vo = Odometry(None)
    vo.track(frames[0])
    step = vo.track(frames[1])
    assert step.status.state is State.FAILED
    assert step.status.reason in (Reason.NO_VALID_DEPTH, Reason.NO_FLOW)
    assert np.isfinite(step.T_world_cam).all()


def test_holes_stay_holes(tmp_path: Path) -> None:
    depth = np.full((1, 1, HEIGHT, WIDTH), 2.0)
    depth[..., 4, 5] = np.nan
    depth[..., 6, 7] = -1.0
    depth[..., 8, 9] = np.inf
    inputs = {"image": (1, 3, HEIGHT, WIDTH)}
    model = constant_network(tmp_path / "a.onnx", {"depth": depth}, inputs)
    found = predicted(model, DEPTH, colours())
    rows, columns = np.nonzero(found != 2.0)
    assert list(zip(rows, columns, strict=True)) == [(4, 5), (6, 7), (8, 9)]
    assert (found[rows, columns] == 0).all()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("onnx:missing.onnx", "no such file"),
        ("onnx:{model}", "no description of the network"),
        ("onnx:{model}@no_such_name", "one of da3_metric, metric3d_small"),
        ("onnx:{model}@neuflow_v2", "a network for flow: expected one for depth"),
    ],
)
def test_files_that_are_missing(text: str, message: str, tmp_path: Path) -> None:
    model = depth_network(tmp_path / "a.onnx")
    with pytest.raises(InputError, match=message):
        DepthNetwork(text.format(model=model))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("output: metres\n", "no output 'metres'"),
        ("inputs: [rgb]\n", "no input 'rgb'"),
        ("size: [20, 20]\n", "does not take image"),
        ("layout: nhwc\nsize: [12, 16]\n", "'layout'"),
        ("channel: 2\n", "requests channel 2"),
        ("recover_shift: true\n", "3 channels"),
    ],
)
def test_a_description_that_does_not_fit(
    text: str, message: str, tmp_path: Path
) -> None:
    model = depth_network(tmp_path / "a.onnx", size=(HEIGHT, WIDTH))
    with pytest.raises(InputError, match=message):
        predicted(model, DEPTH + text, colours())


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("unit: feet\ntask: depth\n", "NetworkDescription.unit"),
        ("task: depth\nscale: 3\n", "NetworkDescription.scale"),
        ("- depth\n", "expected 'key: value' lines"),
        ("std: [0, 1, 1]\ntask: depth\n", "NetworkDescription.std.0"),
        ("size: [3]\n", "NetworkDescription"),
    ],
)
def test_a_damaged_description(text: str, message: str, tmp_path: Path) -> None:
    model = depth_network(tmp_path / "a.onnx")
    with pytest.raises(FormatError, match=message):
        DepthNetwork(describe(model, text))


@pytest.mark.parametrize(
    "text", ["size: [65536, 65536]", "longest: 100000", "multiple_of: 1000000"]
)
def test_images_of_a_network_have_a_limit(text: str, tmp_path: Path) -> None:
    model = depth_network(tmp_path / "a.onnx")
    describe(model, f"task: depth\n{text}\n")
    network = DepthNetwork(f"onnx:{model}")
    with pytest.raises(InputError, match="expected at most 8388608 pixels"):
        network.predict(grey(7), CAMERA)


@pytest.mark.parametrize("side", [65536, 2**40])
def test_sizes_that_a_file_states_have_a_limit(side: int, tmp_path: Path) -> None:
    model = depth_network(tmp_path / "a.onnx", size=(side, side))
    describe(model, "task: depth\n")
    with pytest.raises(FormatError, match="expected at most 268435456 elements"):
        DepthNetwork(f"onnx:{model}")


def test_a_damaged_file(tmp_path: Path) -> None:
    model = tmp_path / "a.onnx"
    model.write_bytes(b"no protocol buffer")
    with pytest.raises(FormatError, match=r"a\.onnx"):
        DepthNetwork(describe(model, DEPTH))


# -- without onnxruntime -----------------------------------------------------------------


@pytest.fixture
def without_runtime(monkeypatch: pytest.MonkeyPatch) -> None:
    real = importlib.import_module

    def load(name: str) -> object:
        if name == "onnxruntime":
            raise ModuleNotFoundError(name)
        return real(name)

    monkeypatch.setattr(sessions.importlib, "import_module", load)


@pytest.mark.usefixtures("without_runtime")
def test_opencv_stands_in(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    model = depth_network(tmp_path / "a.onnx", 0.5, (HEIGHT, WIDTH))
    rgb = colours()
    with caplog.at_level(logging.WARNING):
        depth = predicted(model, f"{DEPTH}size: [12, 16]\n", rgb)
    np.testing.assert_allclose(depth, 0.5 * rgb.mean(2), rtol=1e-5)
    assert "pip install 'hybridvo[onnx]'; OpenCV runs it" in caplog.text


def test_a_frame_states_that_its_depth_is_predicted(tmp_path: Path) -> None:
    model = depth_network(tmp_path / "a.onnx", 0.05)
    measured = Frame(grey(40), np.ones((HEIGHT, WIDTH)), CAMERA, index=3)
    frame = DepthNetwork(describe(model, DEPTH))(measured)
    assert (frame.depth_source, frame.index) == ("network", 3)
    np.testing.assert_allclose(frame.depth, 2.0)
    bare = replace(measured, rgb=None)
    assert DepthNetwork(describe(model, DEPTH))(bare).depth is None


def test_flow_of_another_number_of_channels(tmp_path: Path) -> None:
    size = (1, 3, HEIGHT, WIDTH)
    outputs = {"flow": np.zeros(size)}
    inputs = {"image": size, "second": size}
    model = constant_network(tmp_path / "a.onnx", outputs, inputs)
    with pytest.raises(InputError, match="flow has 3 channels: expected 2"):
        FlowNetwork(describe(model, FLOW)).predict(colours(), colours(), CAMERA)
