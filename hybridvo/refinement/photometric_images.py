"""Grey images for the photometric term: conversion, blur, and blur made alike."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

MID_GREY = 128.0
"""Taken off every grey value, so that gain and offset are nearly independent."""
STRIPS = 4
STRIP_ROWS = 28
"""Sharpness is measured on so many strips of so many rows."""
UNLIKE = 1.1
"""Ratio of two sharpnesses from which on an image is blurred to match the other."""
MAX_BLUR_PX = 4.0
HALVINGS = 5


@dataclass(frozen=True, eq=False)
class Level:
    """The two grey images, (H, W) float32, under one blur."""

    prev: np.ndarray
    curr: np.ndarray


def grey_image(rgb: np.ndarray) -> np.ndarray:
    """(H, W) float32 grey values less :data:`MID_GREY`, from (H, W, 3) uint8 in RGB order.

    Not rounded: 8 bits of grey would add as much noise as the camera's own rounding.
    """
    weights = np.array([[0.299, 0.587, 0.114, -MID_GREY]])
    return cv2.transform(np.ascontiguousarray(rgb).astype(np.float32), weights)


def blurred(images: Level, blur_px: float) -> Level:
    """Both images under a Gaussian blur of this standard deviation."""
    prev, curr = (cv2.GaussianBlur(image, (0, 0), blur_px) for image in (images.prev, images.curr))
    return Level(prev, curr)


def match_blur(images: Level) -> Level:
    """The sharper of two images blurred until both are about equally sharp.

    Motion blur and focus change from frame to frame; the difference of a sharp and a blurred edge
    is no motion, but it pulls at one.
    """
    strips = _strips(images.prev), _strips(images.curr)
    sharpness = [_sharpness(strip) for strip in strips]
    low, high = min(sharpness), max(sharpness)
    if not (low > 0 and high > UNLIKE * low):
        return images
    first = sharpness[0] == high
    strip = strips[0] if first else strips[1]
    least, most = 0.0, MAX_BLUR_PX
    for _ in range(HALVINGS):
        middle = 0.5 * (least + most)
        if _sharpness(cv2.GaussianBlur(strip, (0, 0), middle)) > low:
            least = middle
        else:
            most = middle
    sharp = images.prev if first else images.curr
    alike = cv2.GaussianBlur(sharp, (0, 0), 0.5 * (least + most))
    return Level(alike, images.curr) if first else Level(images.prev, alike)


def _strips(image: np.ndarray) -> np.ndarray:
    """Some rows of the image, at most a strip at each of ``STRIPS`` heights."""
    height = image.shape[0]
    if height <= STRIPS * STRIP_ROWS:
        return image
    starts = [(2 * k + 1) * height // (2 * STRIPS) - STRIP_ROWS // 2 for k in range(STRIPS)]
    return np.concatenate([image[v : v + STRIP_ROWS] for v in starts])


def _sharpness(image: np.ndarray) -> float:
    """Power of the gradient under a fine blur over that under a coarse one: free of the gain."""
    fine = _gradient_power(cv2.GaussianBlur(image, (0, 0), 1.0))
    coarse = _gradient_power(cv2.GaussianBlur(image, (0, 0), 2.0))
    return fine / coarse if coarse > 1e-6 else 0.0


def _gradient_power(image: np.ndarray) -> float:
    gx = image[:, 2:] - image[:, :-2]
    gy = image[2:] - image[:-2]
    return float(np.vdot(gx, gx)) / max(gx.size, 1) + float(np.vdot(gy, gy)) / max(gy.size, 1)
