"""Arguments that are checked before heavy libraries are imported: a typo is answered at once."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from hybridvo.core import laboratory
from hybridvo.core.errors import InputError, did_you_mean
from hybridvo.io.viewer.address import parse_address

METHODS = (
    *("hybrid", "hybrid-flow", "classical", "pwvo-refine", "pwvo"),
    "identity",
)
"""The keys of ``pipeline.METHODS``, whose import loads the numerical libraries."""
EARLIER_METHODS = ("refine",)
"""Names of methods that still work."""
CAMERAS = ("realsense", "oak", "orbbec", "opencv", "own")
"""Cameras by name; anything else is a recording."""


def check_methods(names: Iterable[str]) -> None:
    """Refuse the name of a method that there is not; ``all`` stands for every method.

    >>> check_methods(["hybird"])
    Traceback (most recent call last):
    hybridvo.core.errors.InputError: method: 'hybird' is unknown (did you mean 'hybrid'?); \
known: hybrid, hybrid-flow, classical, pwvo-refine, pwvo, pwvo-paper, pwvo-uncertain, pwvo-naive, \
pixelwise, vonet, vonet-attention, pnp-ransac, pnp-ransac-tuned, usac-magsac, poselib, \
opencv-rgbd, open3d-rgbd, small-gicp, kiss-icp, sift-pnp, identity.
    """
    known = (*METHODS[:-1], *laboratory.names_of(laboratory.METHODS), METHODS[-1])
    for name in names:
        if name in (*known, *EARLIER_METHODS, "all"):
            continue
        hint = did_you_mean(name, known, similarity=0.4)
        raise InputError(
            f"method: '{name}' is unknown{hint}; known: {', '.join(known)}"
            f"{laboratory.more_with_it()}."
        )


def check_camera(name: str | None, preset: str | None) -> None:
    """Refuse a live camera that is neither a known one nor a recording, and a lack of both."""
    if name is None:
        if preset is None:
            raise InputError("live: expected --camera or --preset.")
        return
    is_known = name.partition(":")[0] in CAMERAS
    if not is_known and not os.path.exists(name):
        known = ", ".join(CAMERAS[:-1])
        raise InputError(
            f"--camera {name}: expected {known} or a folder or file of a recording."
        )


def check_view(text: str | None) -> None:
    """Refuse a place of a viewer that there is not."""
    if text is not None:
        parse_address(text)


def check_config(path: Path) -> None:
    """Refuse a configuration file that is not there."""
    if not path.exists():
        raise InputError(
            f"{path}: no such file. The project's own are in configs/ of hybridvo's source; an "
            "installed package has none."
        )
