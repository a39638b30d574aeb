"""Photometric refinement of images that are wrong in a systematic way."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from hybridvo.api import refine
from hybridvo.core.geometry import ego_flow_error, invert
from hybridvo.core.types import Frame, FramePair
from hybridvo.flow.providers import dis_flow
from hybridvo.solver.refine_images import refine_photometric
from hybridvo_lab.synthetic.render import SyntheticSequence
from hybridvo_lab.synthetic.scenes import make_scene

HEIGHT, WIDTH = 160, 256


@pytest.fixture(scope="module")
def made():
    """(previous frame, current frame, true T_curr_prev, true flow) of a static scene."""
    sequence = SyntheticSequence(
        make_scene("static", 404, height=HEIGHT, width=WIDTH, frames=2)
    )
    T = invert(sequence.poses[1]) @ sequence.poses[0]
    return sequence.frame(0), sequence.frame(1), T, sequence.flow(0)[0]


def refined(prev: Frame, curr: Frame):
    """(flow's motion, refined motion) with the flow of these very images."""
    field = dis_flow()(prev, curr)
    pair = FramePair(prev, curr, field.flow, field.variance, field.valid, "dis")
    motion = refine(pair)
    return motion, refine_photometric(pair, motion)


def error_px(prev: Frame, T: np.ndarray, T_true: np.ndarray) -> float:
    return ego_flow_error(T, T_true, prev.depth, prev.camera, prev.camera)


def vignette(rgb: np.ndarray) -> np.ndarray:
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    r2 = ((u - WIDTH / 2) ** 2 + (v - HEIGHT / 2) ** 2) / (WIDTH**2 + HEIGHT**2) * 4
    return np.rint(rgb / (1 + 0.5 * r2)[..., None] ** 2).astype(np.uint8)


def lamp(rgb: np.ndarray) -> np.ndarray:
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    glow = 60 * np.exp(-((u - 80) ** 2 + (v - 80) ** 2) / (2 * 60.0**2))
    return np.clip(np.rint(rgb + glow[..., None]), 0, 255).astype(np.uint8)


def test_even_light_is_left_alone(made):
    prev, curr, T, _ = made
    motion, done = refined(prev, curr)
    assert done.photometric.taken
    assert done.status.message == motion.status.message
    assert error_px(prev, done.T_curr_prev, T) < 0.3 * error_px(
        prev, motion.T_curr_prev, T
    )


@pytest.mark.parametrize("both", [True, False], ids=["vignette", "lamp"])
def test_uneven_light_leaves_little(both, made):
    prev, curr, T, _ = made
    if both:
        prev, curr = (replace(f, rgb=vignette(f.rgb)) for f in (prev, curr))
    else:
        curr = replace(curr, rgb=lamp(curr.rgb))
    motion, done = refined(prev, curr)
    assert done.photometric.taken
    assert error_px(prev, done.T_curr_prev, T) < 0.7 * error_px(
        prev, motion.T_curr_prev, T
    )


def test_rows_taken_one_after_the_other_lower_the_weight(made):
    prev, curr, _, flow = made
    base = np.stack(np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT)), -1).astype(
        np.float32
    )
    late = (np.arange(HEIGHT, dtype=np.float32) / HEIGHT - 0.5)[:, None, None]
    place = base - 0.8 * late * np.nan_to_num(flow)
    # the flow's motion is that of the upright images: only these contradict each other
    field = dis_flow()(prev, curr)
    pair = FramePair(prev, curr, field.flow, field.variance, field.valid, "dis")
    motion = refine(pair)
    rolled = cv2.remap(curr.rgb, place[..., 0], place[..., 1], cv2.INTER_CUBIC)
    plain = refine_photometric(pair, motion).photometric
    done = refine_photometric(replace(pair, curr=replace(curr, rgb=rolled)), motion)
    assert plain.agreement > 0.9
    assert done.photometric.agreement < 0.7  # four scenes: 0.07 to 0.65
