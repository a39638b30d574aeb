"""The join of the learned and the classical half: a pair in, its camera motion out.

The only place where network and pose meet. The classical half finds every strong motion of the
picture and fits it exactly; the learned judge says which of them is the world and where the world
is, and the motion is fitted there.
"""

from __future__ import annotations

import difflib
import functools
import hashlib
import time
from pathlib import Path
from typing import Any

import numpy as np

from hybridvo.checks import as_number, as_rigid, as_seed
from hybridvo.compilation import compile_once
from hybridvo.errors import CheckpointError, InputError
from hybridvo.flow import contradiction
from hybridvo.hypotheses.cues import default_judge
from hybridvo.hypotheses.selector import PictureJudge
from hybridvo.learned import (
    LEARNED,
    LEAST_PIXELS,
    estimate_learned,
    shipped_network,
)
from hybridvo.learned_judge import LearnedJudge
from hybridvo.refinement.photometric import PhotometricOptions, polish_photometric
from hybridvo.refinement.readiness import compile_refinement, run_kernels
from hybridvo.refinement.refine import RefinementOptions, refine
from hybridvo.types import FramePair, Reason, RelativePose

__all__ = [
    "DEFAULT_METHOD",
    "JUDGED",
    "METHODS",
    "POLISH",
    "check_method",
    "compile_kernels",
    "estimate",
    "shipped_judge",
    "warm_up",
]

DEFAULT_METHOD = "hybrid"

_BASELINES = (
    "pnp-ransac",
    "pnp-ransac-tuned",
    "usac-magsac",
    "poselib",
    "opencv-rgbd",
    "open3d-rgbd",
    "identity",
)
JUDGED = ("hybrid", "hybrid-flow")
"""Methods that ask a learned judge which motion is the world."""
METHODS = (*JUDGED, "refine", *LEARNED, *_BASELINES)
"""Every method name, in the order of the results' tables."""


POLISH = ("auto", "on", "off")
"""Whether the pictures sharpen the flow's motion: ``auto`` where the method is ``hybrid``, ``on``
with every refinement, ``off`` never."""


def check_polish(polish: str) -> None:
    """Refuse a word that is not in :data:`POLISH`.

    Raises:
        InputError: an unknown word.
    """
    if polish not in POLISH:
        raise InputError(f"polish: expected {', '.join(POLISH)}, got {polish!r}.")


def check_method(method: str) -> None:
    """Refuse a method that cannot run here.

    Raises:
        InputError: an unknown name (the nearest known one is named), a method whose network has no
            weights yet, or a baseline whose package is missing (with the command that installs it).
    """
    if method not in METHODS:
        near = difflib.get_close_matches(str(method), METHODS, n=1, cutoff=0.4)
        hint = f" (did you mean '{near[0]}'?)" if near else ""
        raise InputError(f"method: '{method}' is unknown{hint}; known: {', '.join(METHODS)}.")
    needed = "judge" if method in JUDGED else method
    if method in JUDGED or method in LEARNED:
        from hybridvo.network.weights import pretrained_names

        if needed not in pretrained_names():
            raise InputError(
                f"method '{method}' needs network weights, which this version does not ship yet; "
                f"use --method refine (the classical refinement)."
            )
    if method in _BASELINES:
        from hybridvo.baselines.pnp import missing

        absent = missing()
        if method in absent:
            raise InputError(f"method '{method}' cannot run here: {absent[method]}.")


def estimate(
    pair: FramePair,
    *,
    T_last: np.ndarray | None = None,
    T_last_covariance: np.ndarray | None = None,
    method: str = DEFAULT_METHOD,
    options: RefinementOptions | None = None,
    judge: PictureJudge | None = None,
    polish: str = "auto",
    photometric: PhotometricOptions | None = None,
    trust: float = 1.0,
    seed: int = 0,
) -> RelativePose:
    """Camera motion of one pair.

    Args:
        pair: two frames and the flow between them.
        T_last: (4, 4) motion of the pair before: a start among others and a cue for the judge, for
            the methods that can use one.
        T_last_covariance: (6, 6) of ``Exp(delta) T_last``, translation first, m^2 and rad^2, where
            ``T_last`` is a prediction that knows its own worth.
        method: one of :data:`METHODS` that can run here.
        options: of the refinement.
        judge: for the methods that ask one; by default the one whose weights are shipped.
        polish: one of :data:`POLISH`, see
            :func:`hybridvo.refinement.photometric.polish_photometric`.
        photometric: options of the polish.
        trust: in the pictures, 0 to 1, see
            :class:`hybridvo.refinement.photometric_monitor.PhotometricMonitor`.
        seed: of everything that is drawn at random; the same seed gives the same bytes.

    Returns:
        ``T_curr_prev`` with covariance and status. Bad data give a failed status, never an
        exception and never a value that is not finite.

    Raises:
        InputError: an unknown method, or one that cannot run here; another word for ``polish``;
            an argument of another kind.

    Example:
        >>> import numpy as np
        >>> frame = Frame(None, np.ones((24, 32)), Camera(30, 30, 15.5, 11.5, 24, 32))
        >>> estimate(FramePair(frame, frame, None)).status.reason.value
        'no_flow'
    """
    if not isinstance(pair, FramePair):
        raise InputError(f"estimate: expected a FramePair, got {type(pair).__name__}.")
    seed = as_seed(seed, "estimate.seed")
    if T_last is not None:
        T_last = as_rigid(T_last, "estimate.T_last")
    if not 0 <= as_number(trust) <= 1:
        raise InputError(f"estimate: expected trust in [0, 1], got {trust!r}.")
    for name, value, kind in (
        ("options", options, RefinementOptions),
        ("photometric", photometric, PhotometricOptions),
    ):
        if value is not None and not isinstance(value, kind):
            got = type(value).__name__
            raise InputError(f"estimate.{name}: expected {kind.__name__}, got {got}.")
    check_polish(polish)
    polished = polish == "on" or (polish == "auto" and method == "hybrid")
    if method == "refine" or method in JUDGED:
        wrong = contradiction(pair) if polished else None
        if wrong is not None:
            return RelativePose.failed(Reason.NO_FLOW, wrong, method)
        compile_kernels(method)
        chosen: Any = (judge or shipped_judge()) if method in JUDGED else default_judge
        found = refine(
            pair,
            T_last=T_last,
            T_last_covariance=T_last_covariance,
            options=options,
            judge=chosen,
            seed=seed,
        )
        if polished:
            found = polish_photometric(pair, found, photometric, trust=trust)
        return found.replace(method=method)
    check_method(method)
    if method in LEARNED:
        return _too_little(pair, method) or estimate_learned(pair, method)
    from hybridvo.baselines.pnp import baselines

    return baselines()[method](pair, seed=seed)


FARTHEST_M = 1e7
"""Depth that still says something: beyond, a picture's flow tells no network any translation."""


def _too_little(pair: FramePair, method: str) -> RelativePose | None:
    """A failure where the pair itself, and not only its enlargement, is too small for a network."""
    depth, flow = pair.prev.depth, pair.flow
    if depth is None or flow is None:
        return None
    usable = (depth > 0) & (depth < FARTHEST_M) & np.isfinite(flow).all(axis=2)
    for mask in (pair.prev.mask, pair.flow_valid):
        if mask is not None:
            usable &= mask
    seen = int(np.count_nonzero(usable))
    if seen >= LEAST_PIXELS:
        return None
    what = f"{seen} pixels have flow and depth below {FARTHEST_M:g} m, {LEAST_PIXELS} needed"
    return RelativePose.failed(Reason.NO_VALID_DEPTH, what, method)


@functools.cache
def shipped_judge(name: str = "judge") -> LearnedJudge:
    """A judge whose weights are part of the package; read once in a process.

    Args:
        name: of the weights.

    Raises:
        CheckpointError: no such weights, weights of another network, or damaged ones.
    """
    from hybridvo.network.judge import JudgeNetwork
    from hybridvo.network.weights import load_weights, pretrained

    path = pretrained(name)
    network, _ = load_weights(path)
    if not isinstance(network, JudgeNetwork):
        raise CheckpointError(f"{path}: expected the weights of a judge, got another network's.")
    return LearnedJudge(network, shipped_network("pwvo"))


def weights_hash(method: str) -> str | None:
    """SHA-256 over the shipped weights that a method uses; None for a method without a network."""
    from hybridvo.network.weights import pretrained

    names = ("judge", "pwvo") if method in JUDGED else (method,) if method in LEARNED else ()
    digest = hashlib.sha256()
    for name in names:
        digest.update(pretrained(name).read_bytes())
    return digest.hexdigest() if names else None


def warm_up(method: str = DEFAULT_METHOD, polish: str = "auto") -> float:
    """Pay for the compilation (or the reading of its cache) before the first real frame.

    Runs the refinement once on a made pair of each size class. Costs half a minute on the very
    first call after an installation, when another process compiles (:func:`compile_kernels`), half
    a second after that, and nothing in the same process.

    Returns:
        Seconds spent.
    """
    started = time.perf_counter()
    if method in _BASELINES:
        return 0.0
    if method in LEARNED:
        shipped_network(method)
    compile_kernels(method)
    judge = shipped_judge() if method in JUDGED else default_judge
    run_kernels(judge, polish=polish == "on" or method == "hybrid")
    return time.perf_counter() - started


@functools.cache
def compile_kernels(method: str = DEFAULT_METHOD) -> bool:
    """Have the kernels compiled by another process, so that this one reads what later ones read;
    asked once in a process.

    Code that is compiled in a process differs from the same code out of the cache in the last bits
    of its sums (:mod:`hybridvo.compilation`): without this, a first run's motions differ by some
    1e-7 m from those of every later one.

    Args:
        method: whose kernels; those of ``refine`` are compiled with every one, and before.

    Returns:
        Whether they are in the cache now; where they cannot be, this process compiles for itself.
    """
    done = compile_refinement()
    if method in JUDGED:
        code = (
            "from hybridvo.pipeline import shipped_judge; "
            "from hybridvo.refinement.readiness import run_kernels; run_kernels(shipped_judge())"
        )
        done = compile_once(code, Path(__file__).resolve().parent / "refinement", "judged") and done
    return done
