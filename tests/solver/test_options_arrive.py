"""``refine.cutoff`` and ``refine.tiles`` reach every robust kernel and every covariance."""

from __future__ import annotations

import ast
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import hybridvo
from hybridvo.core.options import (
    DirectOptions,
    Options,
    RefineOptions,
    SearchOptions,
)
from hybridvo.core.types import FramePair
from hybridvo.flow.providers import dis_flow, with_flow
from hybridvo.hypotheses import direct
from hybridvo.hypotheses.calibration import INLIER_REMOVAL_CUTOFF
from hybridvo.judge import consistency
from hybridvo.judge.findings import Question
from hybridvo.solver import (
    correlated_errors,
    image_factor,
    kernels,
    planes,
    status,
)
from hybridvo.solver import refine_flow as refinement
from hybridvo.solver import refine_images as photometric
from hybridvo.solver.torch import covariance as torch_covariance
from tests import worlds

CUTOFF = 2.5
TILES = 60
OPTIONS = Options(
    refine=RefineOptions(cutoff=CUTOFF, tiles=TILES),
    direct=DirectOptions(mode="off"),
    search=SearchOptions(matches="off"),
)
ESTIMATOR = ("flow", "hypotheses", "network", "photometric", "refinement")


class Seen:
    """What functions were called with."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.cutoffs: list[float] = []
        self.tiles: list[int] = []
        self._monkeypatch = monkeypatch
        self._watch(
            image_factor, "sum_images", lambda *a: self._images(a[0].images)
        )
        self._watch(
            planes,
            "sum_planes",
            lambda *a: self.cutoffs.append(a[0].surfaces.cutoff),
        )
        for name in ("compare_images", "weigh_images"):
            self._watch(image_factor, name, self._images)
        self._watch(
            planes, "compare_surfaces", lambda *a: self.cutoffs.append(a[0].cutoff)
        )
        self._watch(direct, "following", lambda *a: self.cutoffs.append(a[2]))
        self._watch(kernels, "residual_noise", lambda *a: self.cutoffs.append(a[2]))
        for module in (correlated_errors, refinement, status, torch_covariance):
            self._watch(module, "tile_size", lambda *a: self.tiles.append(a[1]))

    def _watch(self, module: Any, name: str, note: Any) -> None:
        original = getattr(module, name)

        def call(*args: Any, **named: Any) -> Any:
            note(*args)
            return original(*args, **named)

        self._monkeypatch.setattr(module, name, call)

    def _images(self, *args: Any) -> None:
        self.cutoffs.append(float(args[0].squared_cutoff) ** 0.5)


@pytest.fixture
def pair() -> FramePair:
    pair, _ = worlds.world((120, 160), movers=1)
    return with_flow(FramePair(pair.prev, pair.curr, None), dis_flow())


@pytest.mark.parametrize("method", ["hybrid", "pwvo-refine"])
def test_no_other_cutoff_and_number_of_tiles_is_used(
    method: str, pair: FramePair, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = Seen(monkeypatch)
    found = hybridvo.estimate(pair, method=method, options=OPTIONS)
    assert found.usable and "images" in found.terms
    # the search removes what follows a motion within a fraction of it
    allowed = {CUTOFF, INLIER_REMOVAL_CUTOFF * CUTOFF}
    assert set(np.round(seen.cutoffs, 5)) <= allowed
    assert set(seen.tiles) == {TILES}
    assert len(seen.cutoffs) > 10 and len(seen.tiles) > 3


def test_the_motion_by_images_alone_takes_them(
    pair: FramePair, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = Seen(monkeypatch)
    assert direct.direct_start(pair, min_probability=0.0, options=OPTIONS.refine)
    np.testing.assert_allclose(seen.cutoffs, CUTOFF, rtol=1e-6)
    assert set(seen.tiles) == {TILES}


def test_what_holds_an_answer_against_the_images_takes_them(
    pair: FramePair, monkeypatch: pytest.MonkeyPatch
) -> None:
    answer = hybridvo.estimate(pair, method="classical")
    seen = Seen(monkeypatch)
    question = Question(pair, answer, "given", options=OPTIONS.refine)
    consistency.against_images_and_depth(question)
    np.testing.assert_allclose(seen.cutoffs, CUTOFF, rtol=1e-6)
    assert set(seen.tiles) == {TILES}


def test_a_narrower_kernel_changes_what_the_images_state(pair: FramePair) -> None:
    answer = hybridvo.estimate(pair, method="hybrid-flow")
    wide, narrow = (
        photometric.refine_photometric(
            pair, answer, options=RefineOptions(cutoff=cutoff)
        )
        for cutoff in (3.0, 1.0)
    )
    change = np.linalg.norm(wide.covariance - narrow.covariance)
    assert change > 1e-3 * np.linalg.norm(wide.covariance)


def test_the_estimator_reads_these_options_from_no_class() -> None:
    """``RefineOptions.cutoff`` is the default, whatever a user has set."""
    root = Path(hybridvo.__file__).parent
    files = [root / "pipeline.py", root / "odometry.py"]
    for part in ESTIMATOR:
        files += sorted((root / part).glob("*.py"))
    for file in filter(Path.exists, files):
        tree = ast.parse(file.read_text(encoding="utf-8"))
        for node in ast.walk(tree):
            if isinstance(node, ast.Name):
                assert node.id != "KERNEL_CUTOFF", file
            if isinstance(node, ast.Attribute) and node.attr in ("cutoff", "tiles"):
                owner = node.value
                is_class = isinstance(owner, ast.Name) and owner.id[:1].isupper()
                assert not is_class, f"{file}:{node.lineno}"
