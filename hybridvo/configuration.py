"""Options of a run: frozen dataclasses, filled from YAML and from ``--set key=value``.

``configs/odometry.yaml`` repeats every default with its unit and reason; a test holds both equal.
An unknown key is an error that names the nearest known one.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from hybridvo.data.presets import build_options, read_yaml
from hybridvo.errors import FormatError, InputError
from hybridvo.files import parse_yaml
from hybridvo.flow import DIS_PRESETS
from hybridvo.options import Options, PhotometricOptions, RefineOptions, TrackOptions
from hybridvo.pipeline import DEFAULT_METHOD

__all__ = ["DisOptions", "RunOptions", "load_options"]

FLOWS = ("auto", "file", "dis")
DEVICES = ("auto", "cpu", "cuda")
LARGEST_SEED = 2**31 - 1
"""Every generator that is seeded takes as much."""


@dataclass(frozen=True)
class DisOptions:
    """Options of the DIS flow, see :func:`hybridvo.flow.dis_flow`.

    Args:
        preset: ultrafast, fast or medium.
        forward_backward: compute both directions; gives variance and validity.
    """

    preset: str = "medium"
    forward_backward: bool = True

    def __post_init__(self) -> None:
        _one_of("dis.preset", self.preset, tuple(DIS_PRESETS))


@dataclass(frozen=True)
class RunOptions:
    """Options of ``hybridvo run``; the command line's own options win over a file's.

    Args:
        method: see :data:`hybridvo.pipeline.METHODS`.
        flow: ``file``, ``dis``, or ``auto``: files where the sequence has them, else DIS.
        polish: sharpen the flow's motion by the pictures: ``auto``, ``on`` or ``off``.
        window: most key frames that frames are registered to, 1 for none; None for the default of
            :class:`hybridvo.odometry.Odometry`.
        history: the predicted motion is one start among others, and a cue.
        policy: pose after a failed motion: ``hold`` or ``constant_velocity``.
        start: first frame. stop: the one after the last, None for all. stride: step.
        device: ``auto``, ``cpu`` or ``cuda``.
        seed: of everything drawn at random.
        max_failed: share of the frames that may fail before the exit code is 3.
        strict: a broken frame ends the run (exit code 2).
        alignment: of the absolute trajectory error.
        dis: of the DIS flow. refinement: of the refinement. photometric: of the polish.
        key_frames: of the window.
    """

    method: str = DEFAULT_METHOD
    flow: str = "auto"
    polish: str = "auto"
    window: int | None = None
    history: bool = True
    policy: str = "hold"
    start: int = 0
    stop: int | None = None
    stride: int = 1
    device: str = "auto"
    seed: int = 0
    max_failed: float = 0.2
    strict: bool = False
    alignment: str = "se3"
    dis: DisOptions = field(default_factory=DisOptions)
    refinement: RefineOptions = field(default_factory=RefineOptions)
    photometric: PhotometricOptions = field(default_factory=PhotometricOptions)
    key_frames: TrackOptions = field(default_factory=TrackOptions)

    def __post_init__(self) -> None:
        _one_of("flow", self.flow, FLOWS)
        _one_of("polish", self.polish, ("auto", "on", "off"))
        _one_of("policy", self.policy, ("hold", "constant_velocity"))
        _one_of("device", self.device, DEVICES)
        _one_of("alignment", self.alignment, ("se3", "sim3", "origin", "none"))
        if self.start < 0 or self.stride < 1:
            raise InputError(
                f"expected start >= 0 and stride >= 1, got {self.start} and {self.stride}."
            )
        if self.stop is not None and self.stop <= self.start:
            raise InputError(f"expected stop > start, got {self.stop} and {self.start}.")
        if not 0 <= self.seed <= LARGEST_SEED:
            raise InputError(f"seed: expected 0 to {LARGEST_SEED}, got {self.seed}.")
        if not 0 <= self.max_failed <= 1:
            raise InputError(f"max_failed: expected a share in [0, 1], got {self.max_failed}.")


def option_tree(flat: RunOptions) -> Options:
    """The tree of :mod:`hybridvo.options` with these values."""
    return Options(
        refine=flat.refinement,
        photometric=dataclasses.replace(flat.photometric, mode=flat.polish),
        track=dataclasses.replace(
            flat.key_frames,
            window=flat.window,
            motion_prior=flat.history,
            on_failure=flat.policy,  # type: ignore[arg-type]
        ),
    )


def _one_of(name: str, value: str, known: tuple[str, ...]) -> None:
    if value not in known:
        raise InputError(f"{name}: expected {', '.join(known)}, got {value!r}.")


def load_options(
    path: str | None = None,
    assignments: Iterable[str] = (),
    overrides: Mapping[str, Any] | None = None,
) -> RunOptions:
    """Options of a run from a file, from ``key=value`` texts and from the command line.

    Args:
        path: YAML file, or None for the defaults.
        assignments: ``refinement.cutoff=2.5`` and the like; values are YAML scalars.
        overrides: values of named options; those that are None are left out.

    Raises:
        InputError: no such file, an unknown key, a value that cannot be meant.
        FormatError: the file is no YAML mapping.

    Example:
        >>> load_options(assignments=["refinement.cutoff=2.5"]).refinement.cutoff
        2.5
    """
    mapping = {} if path is None else copy.deepcopy(read_yaml(path))
    where = str(path) if path is not None else "options"
    # the file alone first, so that its own mistakes carry its name
    build_options(RunOptions, mapping, where)
    for text in assignments:
        key, sign, value = text.partition("=")
        parts = key.strip().split(".")
        if not sign or not all(parts):
            raise InputError(f"--set: expected key=value, as in refinement.cutoff=3, got {text!r}.")
        try:
            parsed = parse_yaml(value, key)
        except FormatError:
            message = f"--set {key[:80]}: {value[:80]!r} is no value that YAML can read."
            raise InputError(message) from None
        node = mapping
        for part in parts[:-1]:
            inner = node.setdefault(part, {})
            if not isinstance(inner, dict):
                raise InputError(f"--set {key}: '{part}' holds a value, not further keys.")
            node = inner
        node[parts[-1]] = parsed
        build_options(RunOptions, mapping, "--set")
    mapping.update({k: v for k, v in (overrides or {}).items() if v is not None})
    return build_options(RunOptions, mapping, where)
