"""Adds compiled kernels to the wheel, for ``tools/build_wheel.py``.

Hatchling calls it in every build. Without the variable ``HYBRIDVO_COMPILED`` the wheel has
only Python files, for every system.
"""

from __future__ import annotations

import os
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

FOLDER_VARIABLE = "HYBRIDVO_COMPILED"
"""Names the folder of the compiled kernels."""
TAG_VARIABLE = "HYBRIDVO_WHEEL_TAG"
"""Python, ABI and system of the wheel, such as ``cp311-cp311-manylinux_2_28_x86_64``."""


class CompiledKernels(BuildHookInterface):
    """Puts the folder into the wheel, and its tag into the wheel's name."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Change what is built."""
        folder = os.environ.get(FOLDER_VARIABLE)
        if not folder:
            return
        build_data["pure_python"] = False
        build_data["tag"] = os.environ[TAG_VARIABLE]
        build_data["force_include"][folder] = "hybridvo/compiled/kernels"
