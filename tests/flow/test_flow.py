from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from hybridvo.core.errors import FormatError, InputError
from hybridvo.core.types import Camera, Frame, FramePair
from hybridvo.flow.calibration import DIS_NOISE
from hybridvo.flow.providers import (
    FlowField,
    contradiction,
    dis_flow,
    file_flow,
    forward_backward_check,
    with_flow,
)
from hybridvo_lab.synthetic.render import SyntheticSequence
from hybridvo_lab.synthetic.scenes import make_scene

HEIGHT, WIDTH = 96, 128
BASE, FACTOR = DIS_NOISE
CAMERA = Camera(100, 100, 63.5, 47.5, height=HEIGHT, width=WIDTH)


def frame(rgb: np.ndarray | None, index: int = 0) -> Frame:
    return Frame(rgb, None, CAMERA, index=index)


@pytest.fixture(scope="module")
def texture() -> np.ndarray:
    noise = np.random.default_rng(3).integers(
        0, 256, (HEIGHT, WIDTH + 8), dtype=np.uint8
    )
    grey = cv2.GaussianBlur(noise, (0, 0), 2.0)
    grey = cv2.normalize(grey, None, 0, 255, cv2.NORM_MINMAX)
    return np.repeat(grey[..., None], 3, axis=2)


def test_dis_finds_a_shift_and_knows_what_leaves_the_image(
    texture: np.ndarray,
) -> None:
    prev, curr = (
        frame(texture[:, 4:-4]),
        frame(np.ascontiguousarray(texture[:, 8:]), 1),
    )
    field = dis_flow()(prev, curr)
    assert field.flow.shape == (HEIGHT, WIDTH, 2) and field.flow.dtype == np.float32
    assert (field.source, field.is_true) == ("dis", False)
    # the second image shows what lay four pixels to the right: everything moves by (-4, 0)
    inner = field.flow[8:-8, 16:-16]
    assert np.median(np.abs(inner - (-4.0, 0.0))) < 0.1
    assert not field.valid[:, :3].any()
    assert field.valid[8:-8, 16:-16].mean() > 0.95
    assert field.variance.min() == pytest.approx((BASE / 2) ** 2)  # a small image


@pytest.mark.parametrize("rgb", [None, np.zeros((HEIGHT, WIDTH, 3), np.uint8)])
def test_a_missing_image_has_no_flow(rgb: np.ndarray | None) -> None:
    assert dis_flow()(frame(rgb), frame(None)).flow is None
    assert dis_flow()(frame(None), frame(rgb)).flow is None


def test_images_smaller_than_a_patch_do_not_raise() -> None:
    camera = Camera(5, 5, 1.5, 1.5, height=4, width=4)
    small = Frame(np.zeros((4, 4, 3), np.uint8), None, camera)
    field = dis_flow()(small, small)
    assert field.flow is None or np.isfinite(field.flow).all()


def test_forward_backward_by_hand() -> None:
    forward = np.zeros((5, 7, 2), np.float32)
    backward = np.zeros((5, 7, 2), np.float32)
    forward[2, 3] = (1.0, 0.0)
    backward[2, 4] = (-1.0, 0.0)  # consistent: error 0
    forward[0, 0] = (2.0, 0.0)  # the way back stands still: error 2, above 1.5
    forward[1, 1] = (0.0, 1.0)  # error 1: valid, with a variance
    forward[4, 6] = (1.0, 0.0)  # leaves the image
    forward[3, 0] = np.nan
    variance, valid = forward_backward_check(forward, backward)
    assert valid[2, 3] and variance[2, 3] == pytest.approx(BASE**2)
    assert not valid[0, 0] and variance[0, 0] == pytest.approx(
        BASE**2 + 4 * FACTOR**2
    )
    assert valid[1, 1] and variance[1, 1] == pytest.approx(BASE**2 + FACTOR**2)
    assert not valid[4, 6]
    assert not valid[3, 0] and variance[3, 0] == pytest.approx(25.0)
    assert np.isfinite(variance).all()


def test_variance_tells_good_from_bad_flow_on_the_synthetic_world() -> None:
    """Pixels that the check calls bad are worse, and the claimed noise has the right size."""
    sequence = SyntheticSequence(make_scene("light", 0, frames=2))
    prev, curr = sequence.frame(0), sequence.frame(1)
    field = dis_flow()(prev, curr)
    true = sequence.flow(0)[0]
    error = np.linalg.norm(field.flow - true, axis=2)
    target = field.flow + np.stack(
        np.meshgrid(np.arange(512), np.arange(218)), axis=-1
    )
    inside = ((target > 0) & (target < (511, 217))).all(axis=2) & np.isfinite(error)
    good, bad = error[inside & field.valid], error[inside & ~field.valid]
    assert len(bad) > 100 and np.median(bad) > 10 * np.median(good)
    # divided by its own claim, the error is that of a unit Gaussian (median of a Rayleigh variable:
    # 1.18), within the factor 1.5 by which the eighteen measured pairs differ
    ratio = np.median(good / np.sqrt(field.variance[inside & field.valid]))
    assert 1 / 1.5 < ratio / 1.18 < 1.5


class Files:
    """The part of a sequence that flow files need."""

    flow_is_true = True

    def flow(self, index: int) -> tuple[np.ndarray, np.ndarray | None]:
        if index == 1:
            raise FileNotFoundError("no such file")
        if index == 2:
            raise FormatError("broken.flo: expected 'PIEH'")
        return np.full((HEIGHT, WIDTH, 2), index, np.float32), np.ones(
            (HEIGHT, WIDTH), bool
        )


def test_file_flow_leads_to_the_next_frame_only() -> None:
    provide = file_flow(Files())
    field = provide(frame(None, 0), frame(None, 1))
    assert field.is_true and field.source == "file" and field.valid.all()
    assert (field.flow == 0).all()
    assert provide(frame(None, 0), frame(None, 2)).flow is None
    assert provide(frame(None, 1), frame(None, 2)).flow is None
    with pytest.raises(FormatError, match=r"broken\.flo"):
        provide(frame(None, 2), frame(None, 3))
    assert (
        file_flow(Files(), strict=False)(frame(None, 2), frame(None, 3)).flow
        is None
    )


def test_fallback_names_the_source_that_answered() -> None:
    flow = np.ones((HEIGHT, WIDTH, 2), np.float32)
    second = lambda prev, curr: FlowField(flow, source="second")  # noqa: E731
    provide = file_flow(Files(), otherwise=second)
    rgb = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    assert provide(frame(rgb, 0), frame(rgb, 1)).source == "file"
    assert provide(frame(rgb, 1), frame(rgb, 2)).source == "second"


def given(result: object) -> FramePair:
    bare = FramePair(frame(None), frame(None), None)
    return with_flow(bare, lambda *_: result, "network")


def test_what_a_users_function_returns_is_a_flow() -> None:
    flow = np.zeros((HEIGHT, WIDTH, 2))
    pair = given(flow)
    assert pair.flow_source == "network" and pair.flow.dtype == np.float32


@pytest.mark.parametrize(
    ("result", "message"),
    [
        (np.zeros((HEIGHT, WIDTH)), r"got \(96, 128\)"),
        (np.zeros((2, HEIGHT, WIDTH)), r"got \(2, 96, 128\)"),
        (np.zeros((HEIGHT // 2, WIDTH, 2)), r"\(48, 128, 2\)"),
        (np.full((HEIGHT, WIDTH, 2), "x"), "expected a floating-point array"),
    ],
)
def test_wrong_results_are_refused_at_the_door(
    result: np.ndarray, message: str
) -> None:
    with pytest.raises(InputError, match=message):
        given(result)


def test_none_means_no_flow_and_fields_pass() -> None:
    assert given(None).flow is None
    field = FlowField(
        np.zeros((HEIGHT, WIDTH, 2), np.float32), source="own", is_true=True
    )
    assert given(field).flow is field.flow and given(field).flow_is_true


# -- a given flow against its images ------------------------------------------------------------


def shifted_pair(
    texture: np.ndarray, change=lambda flow: flow, **more
) -> FramePair:
    """Images shifted by (-4, 0) px beside their true flow, or a wrong one made of it."""
    prev, curr = (
        frame(texture[:, 4:-4]),
        frame(np.ascontiguousarray(texture[:, 8:]), 1),
    )
    flow = np.broadcast_to(np.float32([-4.0, 0.0]), (HEIGHT, WIDTH, 2))
    return FramePair(prev, curr, np.array(change(flow), np.float32), **more)


WRONG = {
    "negated": lambda flow: -flow,
    "zero": lambda flow: 0 * flow,
    "normalised": lambda flow: flow / [WIDTH, HEIGHT],
    "(v, u)": lambda flow: flow[..., ::-1],
}


@pytest.mark.parametrize("kind", WRONG)
def test_a_flow_that_the_images_contradict(kind: str, texture: np.ndarray) -> None:
    message = contradiction(shifted_pair(texture, WRONG[kind]))
    assert message is not None and "sign" in message and "unit" in message
    # a flow that was computed from the images cannot be another pair's
    assert (
        contradiction(shifted_pair(texture, WRONG[kind], flow_source="dis")) is None
    )


def test_a_right_flow_passes_with_noise_holes_and_outliers(
    texture: np.ndarray,
) -> None:
    rng = np.random.default_rng(0)
    hidden = rng.random((HEIGHT, WIDTH, 1))
    for change in (
        lambda flow: flow,
        lambda flow: flow + rng.normal(0, 1, flow.shape),
        lambda flow: np.where(hidden < 0.4, np.nan, flow),
        lambda flow: np.where(hidden < 0.3, 40.0, flow),
    ):
        assert contradiction(shifted_pair(texture, change)) is None


def test_images_without_texture_contradict_nothing(texture: np.ndarray) -> None:
    pair = shifted_pair(texture, WRONG["negated"])
    black = np.zeros_like(pair.prev.rgb)
    other = np.random.default_rng(9).integers(0, 255, black.shape, dtype=np.uint8)
    for rgb in (black, other, pair.prev.rgb, None):
        assert (
            contradiction(replace(pair, curr=replace(pair.curr, rgb=rgb))) is None
        )
    tiny = Frame(
        np.zeros((3, 4, 3), np.uint8),
        None,
        Camera(4, 4, 1.5, 1.0, height=3, width=4),
    )
    assert (
        contradiction(FramePair(tiny, tiny, np.zeros((3, 4, 2), np.float32)))
        is None
    )
