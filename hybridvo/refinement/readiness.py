"""Every kernel of the refinement compiled before the first pair, by a process of its own."""

from __future__ import annotations

import functools
from dataclasses import replace
from pathlib import Path

import numpy as np

from hybridvo.compilation import compile_once
from hybridvo.geometry import ego_flow, se3_exp
from hybridvo.hypotheses.cues import Judge, default_judge
from hybridvo.hypotheses.selector import PictureJudge
from hybridvo.types import Camera, Frame, FramePair

__all__ = ["compile_refinement", "run_kernels"]

SIZES = ((48, 64), (320, 400))
"""Of the made pairs; the second takes the parallel kernels."""


@functools.cache
def compile_refinement() -> bool:
    """Have the kernels compiled by another process, once on this machine; asked once in a process.

    Returns:
        Whether they are in the cache now, see :func:`hybridvo.compilation.compile_once`.
    """
    code = "from hybridvo.refinement.readiness import run_kernels; run_kernels()"
    return compile_once(code, Path(__file__).resolve().parent, "refine")


def run_kernels(judge: Judge | PictureJudge = default_judge, polish: bool = True) -> None:
    """Call every kernel once, with every type of its arguments.

    Args:
        judge: of the refinement.
        polish: whether those of the photometric polish as well.
    """
    from hybridvo.refinement.photometric import polish_photometric
    from hybridvo.refinement.refine import refine

    for height, width in SIZES:
        camera = Camera(width, width, (width - 1) / 2, (height - 1) / 2, height, width)
        u = np.arange(width)
        v = np.arange(height)[:, None]
        depth = (4.0 + np.sin(u / 7.0) + np.cos(v / 5.0)).astype(np.float32)
        motion = se3_exp(np.array([0.02, -0.01, 0.05, 0.002, 0.004, -0.003]))
        flow = ego_flow(depth, motion, camera, camera).astype(np.float32)
        # a mask, a variance and a second motion: every branch is compiled
        flow[: height // 3, : width // 3] += 3.0
        valid = np.ones((height, width), np.bool_)
        variance = np.full((height, width), 0.01, np.float32)
        frame = Frame(None, depth, camera)
        refine(FramePair(frame, frame, flow, variance, valid), judge=judge)
        pair = FramePair(frame, frame, flow)
        found = refine(pair, judge=judge)
        if polish:
            rgb = (40 * (2 + np.sin(u / 3.0) + np.cos(v / 2.0)))[..., None].repeat(3, 2)
            seen = replace(frame, rgb=rgb.astype(np.uint8))
            polish_photometric(replace(pair, prev=seen, curr=seen), found)
