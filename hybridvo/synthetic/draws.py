"""What every generator of scenes draws and builds with."""

from __future__ import annotations

from typing import Annotated

import cv2
import numpy as np
from numpy.typing import ArrayLike
from pydantic import AfterValidator
from scipy.spatial.transform import Rotation

from hybridvo.errors import InputError
from hybridvo.geometry import make_transform


def _ordered(limits: tuple[float, float]) -> tuple[float, float]:
    if not 0 < limits[0] <= limits[1]:
        raise ValueError("expected 0 < low <= high")
    return limits


Range = Annotated[tuple[float, float], AfterValidator(_ordered)]
"""Two positive limits of an option."""


HELD_OUT, TRAINING, STORED = range(3)
"""What samples are drawn for; none of one kind is one of another, whatever the seeds."""


def sample_generator(seed: int, index: int, use: int = HELD_OUT) -> np.random.Generator:
    """Generator of sample ``index`` of a seed, the same on every machine and in every process.

    Raises:
        InputError: a seed or an index that is negative or does not fit.
    """
    if not (0 <= seed < 1 << 32 and 0 <= index < 1 << 63):
        raise InputError(
            f"sample_generator: expected 0 <= seed < 2^32 and 0 <= index < 2^63, got seed {seed} "
            f"and index {index}."
        )
    key = np.array([seed + (use << 32), index], dtype=np.uint64)
    return np.random.Generator(np.random.Philox(key=key))


def log_uniform(rng: np.random.Generator, limits: Range) -> float:
    """One draw, uniform in the logarithm between two positive limits."""
    return float(np.exp(rng.uniform(np.log(limits[0]), np.log(limits[1]))))


def direction(rng: np.random.Generator) -> np.ndarray:
    """(3,) unit vector, uniform on the sphere."""
    v = rng.standard_normal(3)
    return v / np.linalg.norm(v)


def turn(rng: np.random.Generator, angle_deg: float) -> np.ndarray:
    """(3, 3) rotation by an angle about a drawn axis."""
    return Rotation.from_rotvec(np.radians(angle_deg) * direction(rng)).as_matrix()


def any_turn(rng: np.random.Generator) -> np.ndarray:
    """(3, 3) rotation, uniform over all."""
    return Rotation.random(random_state=rng).as_matrix()


def about(R: np.ndarray, point: np.ndarray, t: ArrayLike = 0.0) -> np.ndarray:
    """(4, 4) rotation about a point, then translation."""
    return make_transform(R, point - R @ point + t)


def affine(half: ArrayLike, centre: ArrayLike, R: np.ndarray | None = None) -> np.ndarray:
    """(3, 4) map of a unit shape to half axes ``half`` along the columns of R."""
    axes = (np.eye(3) if R is None else R) * np.broadcast_to(np.asarray(half, float), 3)
    return np.column_stack([axes, np.asarray(centre, float)])


def smooth_field(
    rng: np.random.Generator, height: int, width: int, cells: int, channels: int = 1
) -> np.ndarray:
    """(H, W[, C]) float32 Gaussian field of about unit spread with ``cells`` knots per height."""
    rows = max(cells, 2)
    columns = max(round(cells * width / max(height, 1)), 2)
    coarse = rng.standard_normal((rows, columns, channels), dtype=np.float32)
    field = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    return field.reshape(height, width, channels) if channels > 1 else field.reshape(height, width)
