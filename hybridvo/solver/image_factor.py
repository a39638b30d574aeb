"""The two images of a pair as a factor of its motion, with gain, offset and noise.

The residual of a static pixel is ``I_curr(pi(T X)) - gain I_prev - offset``. Its
noise is estimated from the residuals; errors that neighbours share lower the
information.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hybridvo.core.options import RefineOptions
from hybridvo.core.types import Frame, FramePair
from hybridvo.flow.frame_images import blurred
from hybridvo.solver.correlated_errors import view_of
from hybridvo.solver.image_kernels import (
    GREY_NOISE_FLOOR,
    ComparedImages,
    ImagesAt,
    compare_images,
    fill_pixels,
    sum_images,
    weigh_images,
)
from hybridvo.solver.kernels import MAX_VALUE
from hybridvo.solver.newton import (
    UNCHANGED_LIGHT,
    Factor,
    FactorSum,
    Linearization,
    MotionState,
    newton,
    robust_linearization,
)
from hybridvo.solver.pixels import typical
from hybridvo.solver.rows import (
    PIXEL_ROWS,
    ImageRow,
    PixelRow,
)

# Length of the last step on images and depth maps, in standard deviations.
IMAGE_TOLERANCE = 0.1

# guards a division where no pixel has weight
TINY = 1e-12


class ImageFactor:
    """The differences of the two images of a pair at chosen pixels."""

    def __init__(
        self,
        pair: FramePair,
        weights: np.ndarray,
        index: np.ndarray,
        options: RefineOptions,
        depth_noise: float = 0.0,
    ) -> None:
        """Gather pixels.

        Args:
            pair: two frames with images; the previous one has depth.
            weights: (H, W) static weights.
            index: (N, 2) rows and columns of the pixels.
            options: cutoff of the robust kernel, and number of tiles.
            depth_noise: standard deviation of log depth at a typical pixel.
        """
        prev = pair.prev.camera
        curr = pair.curr.camera
        camera = [curr.fx, curr.fy, curr.cx, curr.cy, 1 / prev.fx, 1 / prev.fy]
        pixels = gather_pixels(pair.prev, weights, index)
        gradient = pixels[PixelRow.GRADIENT_X : PixelRow.GRADIENT_Y + 1]
        self._images = ComparedImages(
            pixels,
            blurred(pair.curr),
            np.array(camera, np.float32),
            np.float32(options.cutoff**2),
            float(np.sqrt(np.mean(gradient**2))) + TINY,
            view_of(prev.shape, index, options.tiles),
        )
        self._depth_noise = depth_noise

    def under(self, at: ImagesAt) -> NoisyImages:
        """Return the factor under the noise that was found at a motion."""
        return NoisyImages(
            self._images,
            at.noise,
            np.empty_like(at.rows),
            np.empty_like(at.weights),
            at.information.scale,
        )

    def first(self, T_curr_prev: np.ndarray) -> ImagesAt:
        """Return what the images show at a first motion (4, 4), where no gain is known yet."""
        grey_noise = np.array([GREY_NOISE_FLOOR, self._depth_noise], np.float32)
        # twice: the noise is that under the gain and offset of the first time
        _, _, gain_offset, noise, _ = weigh_images(
            self._images, T_curr_prev, UNCHANGED_LIGHT, grey_noise
        )
        return self.at(T_curr_prev, gain_offset, noise)

    def at(
        self, T_curr_prev: np.ndarray, gain_offset: np.ndarray, noise: np.ndarray
    ) -> ImagesAt:
        """Return differences, gain, noise and information at a motion.

        Args:
            T_curr_prev: (4, 4) the motion.
            gain_offset: (2,) gain and offset so far.
            noise: (2,) standard deviations so far.
        """
        found: ImagesAt = compare_images(
            self._images, T_curr_prev, gain_offset, noise
        )
        return found

    def in_view(self, at: ImagesAt) -> float:
        """Fraction of the weight that falls inside the current image."""
        weight = self._images.pixels[PixelRow.WEIGHT]
        weight_in_view = weight[at.weights > 0].sum()
        return float(weight_in_view / max(weight.sum(), TINY))

    def correlation(self, at: ImagesAt) -> float:
        """Weighted correlation of the images where visible; 0 if one is constant."""
        seen = at.weights > 0
        gain, offset = at.gain_offset
        weight = self._images.pixels[PixelRow.WEIGHT][seen]
        grey_prev = self._images.pixels[PixelRow.GREY][seen]
        residual = at.rows[ImageRow.RESIDUAL][seen]
        grey_curr = residual + gain * grey_prev + offset
        a = _centred(grey_prev, weight)
        b = _centred(grey_curr, weight)
        power = float(np.sum(weight * a * a)) * float(np.sum(weight * b * b))
        if power <= 0:
            return 0.0
        return float(np.sum(weight * a * b)) / np.sqrt(power)

    def follow(
        self,
        at: ImagesAt,
        others: Sequence[Factor[Linearization]],
        T_curr_prev: np.ndarray,
        steps: int,
    ) -> MotionState:
        """Return the motion after some Newton steps, with the gain and offset there.

        Args:
            at: noise, gain and offset to start with.
            others: what else is known of the motion.
            T_curr_prev: (4, 4) to start from.
            steps: most of them.
        """
        start = MotionState(np.array(T_curr_prev), at.gain_offset)
        factor = FactorSum([self.under(at), *others])
        return newton(factor, start, steps, IMAGE_TOLERANCE).state


class NoisyImages(NamedTuple):
    """The images as a factor, under a known noise."""

    images: ComparedImages
    noise: np.ndarray  # (2,) float32 standard deviations, see weigh_pixels
    rows: np.ndarray  # (12, N) float32 to work in, see ImageRow
    weights: np.ndarray  # (N,) float32 to work in
    information_scale: float  # factor on the information of these residuals

    def linearize(self, state: MotionState) -> Linearization:
        """Return the normal equations of motion, gain and offset."""
        return robust_linearization(*sum_images(self, *state))


def gather_pixels(
    frame: Frame, weights: np.ndarray, index: np.ndarray
) -> np.ndarray:
    """Return what is known of some pixels of the previous frame.

    Args:
        frame: with image and depth.
        weights: (H, W) static weights; more than 1 counts as 1.
        index: (N, 2) rows and columns, none at the border.

    Returns:
        (8, N) float32, see :class:`PixelRow`.
    """
    camera = frame.camera
    pixels = np.ones((PIXEL_ROWS, len(index)), np.float32)
    fill_pixels(
        index,
        blurred(frame),
        np.asarray(frame.depth),
        np.asarray(weights),
        np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float64),
        pixels,
    )
    if frame.depth_variance is not None:
        v, u = index.T
        variance = frame.depth_variance[v, u]
        usable = (variance >= 0) & (variance < MAX_VALUE)
        relative = variance[usable] / typical(frame.depth_variance)
        pixels[PixelRow.DEPTH_VARIANCE, usable] = relative
        pixels[PixelRow.WEIGHT, ~usable] = 0.0
    return pixels


def _centred(values: np.ndarray, weight: np.ndarray) -> np.ndarray:
    return values - np.sum(weight * values) / max(weight.sum(), TINY)
