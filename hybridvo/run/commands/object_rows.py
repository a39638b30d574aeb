"""The objects of a step as rows of ``objects.csv``."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hybridvo.core.files import atomic_write
from hybridvo.core.geometry import se3_log
from hybridvo.core.results import MovingObject, Step, stated_stds

OBJECTS = "objects.csv"
"""One line for each object of each frame."""
COLUMNS = (
    "index",
    "timestamp",
    "id",
    "state",
    "status",
    "reason",
    "confidence",
    "age",
    "hidden",
    "fraction",
    "inlier_ratio",
    "tx",
    "ty",
    "tz",
    "rx",
    "ry",
    "rz",
    "sigma_trans",
    "sigma_rot_rad",
    "x",
    "y",
    "z",
    "size_x",
    "size_y",
    "size_z",
)
"""The columns of :data:`OBJECTS`."""


def motion_columns(T: np.ndarray) -> dict[str, float]:
    """Return the columns of a motion (4, 4): translation, metres, and rotation vector, rad.

    >>> motion_columns(np.eye(4))["tx"]
    0.0
    """
    numbers = [*T[:3, 3].tolist(), *se3_log(T)[3:].tolist()]
    return dict(zip(("tx", "ty", "tz", "rx", "ry", "rz"), numbers, strict=True))


def object_rows(step: Step) -> list[dict[str, Any]]:
    """Return a row for each object of a step, JSON-ready.

    Args:
        step: The step.
    """
    return [_row(step, each) for each in step.objects]


def _row(step: Step, thing: MovingObject) -> dict[str, Any]:
    """Return the row of one object."""
    std_m, std_rad = stated_stds(thing.covariance)
    x, y, z = thing.centre.tolist()
    size_x, size_y, size_z = thing.size.tolist()
    return {
        "index": step.index,
        "timestamp": step.timestamp,
        "id": thing.id,
        "state": "seen" if thing.is_seen else "hidden",
        "status": thing.status.state.value,
        "reason": thing.status.reason.value,
        "confidence": thing.confidence,
        "age": thing.age,
        "hidden": thing.hidden,
        "fraction": thing.fraction,
        "inlier_ratio": thing.inlier_ratio,
        **motion_columns(thing.T_curr_prev),
        "sigma_trans": std_m,
        "sigma_rot_rad": std_rad,
        "x": x,
        "y": y,
        "z": z,
        "size_x": size_x,
        "size_y": size_y,
        "size_z": size_z,
    }


def write_objects(path: Path, rows: Iterable[Mapping[str, Any]]) -> None:
    """Write the objects of a run.

    Args:
        path: The file.
        rows: What :func:`object_rows` returned, of all frames.

    Raises:
        OutputError: It cannot be written.
    """
    with atomic_write(path) as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
