"""Images that belong to a frame."""

from __future__ import annotations

import copy
import gc
import weakref

import cv2
import numpy as np

from hybridvo.core.types import Frame
from hybridvo.flow.frame_images import blurred, grey, grey_bytes, reduced
from tests import worlds

HEIGHT, WIDTH = 45, 62


def frame() -> Frame:
    rng = np.random.default_rng(4)
    rgb = rng.integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
    depth = rng.uniform(1, 5, (HEIGHT, WIDTH)).astype(np.float32)
    return Frame(rgb, depth, worlds.camera((HEIGHT, WIDTH)))


def test_grey_is_that_of_opencv_without_rounding():
    some = frame()
    np.testing.assert_allclose(
        grey(some) + 128, grey_bytes(some).astype(np.float32), atol=0.51
    )
    exact = cv2.cvtColor(some.rgb.astype(np.float32), cv2.COLOR_RGB2GRAY) - 128
    np.testing.assert_allclose(grey(some), exact, atol=1e-4)


def test_a_reduced_image_is_the_mean_of_its_blocks():
    some = frame()
    small = reduced(some, 4)
    blocks = grey(some)[:44, :60].reshape(11, 4, 15, 4)
    np.testing.assert_allclose(grey(small), blocks.mean(axis=(1, 3)), atol=1e-4)
    np.testing.assert_array_equal(small.depth, some.depth[:44, :60][2::4, 2::4])


def test_each_image_is_computed_once_and_goes_with_its_frame():
    some = frame()
    assert blurred(some) is blurred(some)
    assert reduced(some, 4) is reduced(some, 4)
    other = copy.copy(some)
    assert blurred(other) is not blurred(some)

    image = weakref.ref(blurred(some))
    del some
    gc.collect()
    assert image() is None
