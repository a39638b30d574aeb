"""What decides the shapes of a network's weights and how it reads its inputs."""

from __future__ import annotations

import math
from dataclasses import dataclass

from hybridvo.errors import InputError

__all__ = ["KINDS", "NetworkOptions"]

KINDS = ("pwvo", "vonet", "vonet-attention")
PASS_STARTS = ("selection", "fit")

PATCH = 32
"""Side of the paper's selection patches in pixels of the network's input."""


@dataclass(frozen=True)
class NetworkOptions:
    """What decides the shapes of a network's weights.

    Args:
        kind: ``pwvo`` (also PWVO naive and the pixel-wise network: same shapes, other losses),
            ``vonet`` or ``vonet-attention``.
        width: factor on all channel counts, in (0, 4]; 0.5 has about a quarter of the parameters.
        decoders: 1 = one decoder shared by both heads (published code), 2 = one for the pose and
            one for the uncertainty (the paper's text).
        head_stride: 1 = predictions at the resolution of the input, 2 = at half of it, without the
            decoder's last stage: the same pose at about half the time on a CPU.
        uncertainty: whether the pixel-wise network has an uncertainty head.
        flow_gain: factor in (0, 1000] on the normalised flow (px / 200) inside the network. 1 as
            published; with 10 a flow of a few pixels enters with the size of the other inputs,
            which short trainings need.
        scale_free: divide the inputs by the pair's own scales and multiply the outputs by them, see
            :mod:`hybridvo.network.scale_free`. Off as published.
        passes: how often a scale-free network is used, each time on what the motion found before
            leaves unexplained.
        pass_start: what a later pass starts from: ``selection`` = the pose that the selection
            makes of the pass before, ``fit`` = the motion that its trusted pixels agree on, see
            :func:`hybridvo.network.weighted_fit.weighted_fit`.
        later_quantile: quantile of the lengths of the unexplained flow that scales the inputs of a
            later pass, in (0, 0.5]; 0.4 in the first one. After a good start what is left of the
            world is short and the flow of movers long, whatever their share.
        input_stride: 1, 2 or 4; the network reads every n-th pixel of its inputs.

    Raises:
        InputError: a value outside of what is listed.
    """

    kind: str = "pwvo"
    width: float = 1.0
    decoders: int = 1
    head_stride: int = 1
    uncertainty: bool = True
    flow_gain: float = 1.0
    scale_free: bool = False
    passes: int = 1
    input_stride: int = 1
    pass_start: str = "selection"
    later_quantile: float = 0.4

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise InputError(
                f"NetworkOptions.kind: {self.kind!r} unknown; known: {', '.join(KINDS)}. "
                f"'pwvo-naive' and 'pixelwise' are kind='pwvo' with other losses and selection."
            )
        for name, most in (("width", 4), ("flow_gain", 1000)):
            value = getattr(self, name)
            number = isinstance(value, int | float) and not isinstance(value, bool)
            if not number or not math.isfinite(value) or not 0 < value <= most:
                raise InputError(
                    f"NetworkOptions.{name}: expected a number in (0, {most}], got {value!r}."
                )
        for name in ("decoders", "head_stride"):
            value = getattr(self, name)
            if isinstance(value, bool) or value not in (1, 2):
                raise InputError(f"NetworkOptions.{name}: expected 1 or 2, got {value!r}.")
        if isinstance(self.input_stride, bool) or self.input_stride not in (1, 2, 4):
            raise InputError(
                f"NetworkOptions.input_stride: expected 1, 2 or 4, got {self.input_stride!r}."
            )
        passes = self.passes
        if isinstance(passes, bool) or not isinstance(passes, int) or not 1 <= passes <= 8:
            raise InputError(f"NetworkOptions.passes: expected 1 to 8, got {passes!r}.")
        for name in ("uncertainty", "scale_free"):
            value = getattr(self, name)
            if not isinstance(value, bool):
                raise InputError(f"NetworkOptions.{name}: expected a bool, got {value!r}.")
        if self.pass_start not in PASS_STARTS:
            raise InputError(
                f"NetworkOptions.pass_start: expected {' or '.join(PASS_STARTS)}, got "
                f"{self.pass_start!r}."
            )
        quantile = self.later_quantile
        if not isinstance(quantile, int | float) or not 0 < quantile <= 0.5:
            raise InputError(
                f"NetworkOptions.later_quantile: expected a number in (0, 0.5], got {quantile!r}."
            )
        if self.pass_start == "fit" and (self.kind != "pwvo" or not self.uncertainty):
            raise InputError(
                "NetworkOptions: pass_start='fit' needs the uncertainty of kind='pwvo'."
            )
        if self.passes > 1 and not self.scale_free:
            raise InputError("NetworkOptions: passes above 1 need scale_free=True.")
        if self.decoders == 2 and not self.uncertainty:
            raise InputError(
                "NetworkOptions: decoders=2 gives the uncertainty its own decoder, but "
                "uncertainty=False. Set decoders=1."
            )

    @property
    def patch(self) -> int:
        """Side of the paper's 32-pixel selection patches, in cells of the prediction's grid."""
        return PATCH // (self.head_stride * self.input_stride)
