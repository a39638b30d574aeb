"""The two images of a pair as a factor of its motion, with gain, offset and noise.

The residual of a static pixel is ``I_curr(pi(T X)) - gain I_prev - offset``. Its
noise is estimated from the residuals; errors that neighbours share lower the
information.
"""

from __future__ import annotations

import numpy as np

from hybridvo.calibration import (
    EVEN_PARTS,
    GREY_NOISE_FLOOR,
    IMAGE_INFLATION,
    MAX_IMAGE_GAIN,
    MIN_IMAGE_GAIN,
    SHARED_SHIFT,
)
from hybridvo.frame_images import blurred
from hybridvo.options import RefineOptions
from hybridvo.photometric.align import (
    RELATIVE_RIDGE,
    RIDGE,
    ImageInputs,
    Prior,
    align,
)
from hybridvo.photometric.correlated_errors import (
    estimate_information,
    robust_std,
    view_of,
)
from hybridvo.photometric.image_kernels import linearize_images, weigh_pixels
from hybridvo.photometric.planes import PlaneFactor
from hybridvo.photometric.products import weighted_products
from hybridvo.photometric.rows import (
    IMAGE_ROWS,
    IMAGE_TERMS,
    PIXEL_ROWS,
    ImageRow,
    PixelRow,
)
from hybridvo.refinement.kernels import MAX_VALUE
from hybridvo.refinement.pixels import typical
from hybridvo.results import RelativePose
from hybridvo.types import Frame, FramePair

GAIN_OFFSET = np.s_[ImageRow.GAIN : IMAGE_TERMS]
# guards a division where no pixel has weight
TINY = 1e-12


class ImageFactor:
    """The differences of the two images of a pair at chosen pixels.

    Attributes:
        gain_offset: (2,) gain of the current image over the previous one, offset in
            grey levels.
        agreement: factor in (0, 1] by which parts of the image that disagree
            lowered the information.
        information: (6, 6) of the motion, where last estimated.
    """

    def __init__(
        self,
        pair: FramePair,
        pose: RelativePose,
        index: np.ndarray,
        options: RefineOptions,
    ) -> None:
        """Gather pixels, and estimate gain, offset and noise at a motion.

        Args:
            pair: two frames with images; the previous one has depth.
            pose: a motion with the weights (H, W) of its pixels.
            index: (N, 2) rows and columns of the pixels.
            options: cutoff of the robust kernel, and number of tiles.
        """
        prev = pair.prev.camera
        curr = pair.curr.camera
        self._pixels = gather_pixels(pair.prev, np.asarray(pose.weights), index)
        self._image = blurred(pair.curr)
        self._camera = np.array(
            [curr.fx, curr.fy, curr.cx, curr.cy, 1 / prev.fx, 1 / prev.fy],
            np.float32,
        )
        self._rows = np.empty((IMAGE_ROWS, len(index)), np.float32)
        self._weights = np.empty(len(index), np.float32)
        self._view = view_of(prev.shape, index, options.tiles)
        self._squared_cutoff = np.float32(options.cutoff**2)
        self.gain_offset = np.array([1.0, 0.0])
        # standard deviations: of the residual, grey levels; of the typical log
        # depth
        self._noise = np.array([GREY_NOISE_FLOOR, pose.depth_noise], np.float32)
        self._information_scale = 1.0 / IMAGE_INFLATION
        self.information = np.zeros((6, 6))
        self.agreement = 1.0
        # twice: the noise is that under the gain and offset of the first time
        self._linearize(pose.T_curr_prev)
        self._estimate_gain_and_noise()
        self.estimate(pose.T_curr_prev)

    @property
    def kernel_inputs(self) -> ImageInputs:
        """What :func:`hybridvo.photometric.align.align` needs of the images."""
        return ImageInputs(
            self._pixels,
            self._image,
            self._camera,
            self._noise,
            self._squared_cutoff,
            self._rows,
            self._weights,
            self._information_scale,
        )

    @property
    def noise(self) -> float:
        """Standard deviation of the residual, grey levels, where last estimated."""
        return float(self._noise[0])

    @property
    def in_view(self) -> float:
        """Fraction of the weight that falls inside the current image."""
        weight = self._pixels[PixelRow.WEIGHT]
        weight_in_view = weight[self._weights > 0].sum()
        return float(weight_in_view / max(weight.sum(), TINY))

    @property
    def correlation(self) -> float:
        """Weighted correlation of the images where visible; 0 if one is constant."""
        seen = self._weights > 0
        gain, offset = self.gain_offset
        weight = self._pixels[PixelRow.WEIGHT][seen]
        grey_prev = self._pixels[PixelRow.GREY][seen]
        residual = self._rows[ImageRow.RESIDUAL][seen]
        grey_curr = residual + gain * grey_prev + offset
        a = _centred(grey_prev, weight)
        b = _centred(grey_curr, weight)
        power = float(np.sum(weight * a * a)) * float(np.sum(weight * b * b))
        if power <= 0:
            return 0.0
        return float(np.sum(weight * a * b)) / np.sqrt(power)

    def estimate(self, T_curr_prev: np.ndarray) -> None:
        """Estimate gain, offset, noise and information at a motion (4, 4)."""
        self._linearize(T_curr_prev)
        products = self._estimate_gain_and_noise()
        self._estimate_information(products)

    def follow(
        self, planes: PlaneFactor, prior: Prior, T_curr_prev: np.ndarray, steps: int
    ) -> np.ndarray:
        """Return the motion (4, 4) after some Newton steps; update gain and offset.

        Args:
            planes: the depth maps of the pair.
            prior: what is known of the motion.
            T_curr_prev: (4, 4) to start from.
            steps: largest number of steps.
        """
        T, self.gain_offset = align(
            self.kernel_inputs,
            planes.kernel_inputs,
            prior,
            T_curr_prev,
            self.gain_offset,
            steps,
        )
        return T

    def _linearize(self, T_curr_prev: np.ndarray) -> None:
        linearize_images(
            self._pixels,
            self._image,
            self._camera,
            T_curr_prev,
            self.gain_offset,
            self._rows,
        )

    def _estimate_gain_and_noise(self) -> np.ndarray:
        """Estimate the noise where last linearized, then gain and offset under it.

        Returns:
            (9, 9) normal equations at the new gain and offset.
        """
        lengths = np.abs(self._rows[ImageRow.RESIDUAL][self._rows[ImageRow.U] > 0])
        if len(lengths):
            self._noise[0] = max(robust_std(lengths), GREY_NOISE_FLOOR)
        weigh_pixels(
            self._pixels,
            self._noise,
            self._squared_cutoff,
            self._rows,
            self._weights,
        )
        products = weighted_products(self._rows[:IMAGE_TERMS], self._weights)
        # without texture the gain stays as it is
        diagonal = np.diag(products)[GAIN_OFFSET]
        ridge = np.diag(RELATIVE_RIDGE * diagonal + RIDGE)
        step = np.linalg.solve(
            products[GAIN_OFFSET, GAIN_OFFSET] + ridge,
            products[GAIN_OFFSET, ImageRow.RESIDUAL],
        )
        before = self.gain_offset
        after = before - step
        after[0] = np.clip(after[0], MIN_IMAGE_GAIN, MAX_IMAGE_GAIN)
        self.gain_offset = after
        self._shift_residuals(products, after - before)
        return products

    def _shift_residuals(self, products: np.ndarray, change: np.ndarray) -> None:
        """Update residuals and normal equations by a change (2,) of gain, offset."""
        by_gain, by_offset = change.astype(np.float32)
        residual = self._rows[ImageRow.RESIDUAL]
        residual += by_gain * self._rows[ImageRow.GAIN]
        residual += by_offset * self._rows[ImageRow.OFFSET]
        products[:, ImageRow.RESIDUAL] += products[:, GAIN_OFFSET] @ change
        products[ImageRow.RESIDUAL] += change @ products[GAIN_OFFSET]

    def _estimate_information(self, products: np.ndarray) -> None:
        """Lower the information of the products (9, 9) by what pixels share."""
        gradient = self._pixels[PixelRow.GRADIENT_X : PixelRow.GRADIENT_Y + 1]
        strength = np.sqrt(np.mean(gradient**2)) + TINY
        # px along each axis of the image
        shift = np.float32(SHARED_SHIFT * self._noise[0] / strength)
        found = estimate_information(
            self._rows[:IMAGE_TERMS],
            self._weights,
            shift * gradient,
            products,
            self._view,
            EVEN_PARTS,
        )
        self.information = found.matrix
        self.agreement = found.agreement
        self._information_scale = found.scale


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
    grey = blurred(frame)
    v, u = index.T
    pixels = np.ones((PIXEL_ROWS, len(index)), np.float32)
    pixels[PixelRow.RAY_X] = (u - camera.cx) / camera.fx
    pixels[PixelRow.RAY_Y] = (v - camera.cy) / camera.fy
    pixels[PixelRow.DEPTH] = np.asarray(frame.depth)[v, u]
    pixels[PixelRow.GREY] = grey[v, u]
    pixels[PixelRow.GRADIENT_X] = 0.5 * (grey[v, u + 1] - grey[v, u - 1])
    pixels[PixelRow.GRADIENT_Y] = 0.5 * (grey[v + 1, u] - grey[v - 1, u])
    pixels[PixelRow.WEIGHT] = np.minimum(weights[v, u], 1.0)
    if frame.depth_variance is not None:
        variance = frame.depth_variance[v, u]
        usable = (variance >= 0) & (variance < MAX_VALUE)
        relative = variance[usable] / typical(frame.depth_variance)
        pixels[PixelRow.DEPTH_VARIANCE, usable] = relative
        pixels[PixelRow.WEIGHT, ~usable] = 0.0
    return pixels


def _centred(values: np.ndarray, weight: np.ndarray) -> np.ndarray:
    return values - np.sum(weight * values) / max(weight.sum(), TINY)
