"""What decides the shapes of a network's weights and how it reads its inputs."""

from __future__ import annotations

from typing import Annotated, Literal, get_args

from pydantic import Field

from hybridvo.errors import InputError
from hybridvo.options import option_group

Kind = Literal["pwvo", "vonet", "vonet-attention"]
KINDS = get_args(Kind)


@option_group
class NetworkOptions:
    """What decides the shapes of a network's weights.

    Args:
        kind: ``pwvo`` (also PWVO naive and the pixel-wise network: same shapes, other losses),
            ``vonet`` or ``vonet-attention``.
        width: factor on all channel counts; 0.5 has about a quarter of the parameters.
        decoders: 1 = one decoder shared by both heads (published code), 2 = one for the pose and
            one for the uncertainty (the paper's text).
        head_stride: 1 = predictions at the resolution of the input, 2 = at half of it, without the
            decoder's last stage: the same pose at about half the time on a CPU.
        uncertainty: whether the pixel-wise network has an uncertainty head.
        scale_free: divide the inputs by the pair's own scales and multiply the outputs by them, see
            :mod:`hybridvo.network.normalization`. Off as published.
        passes: how often a scale-free network is used: each later pass looks at what the motion
            that the trusted pixels of the one before agree on leaves unexplained.
        input_stride: the network reads every n-th pixel of its inputs.
        later_quantile: quantile of the lengths of the unexplained flow that scales the inputs of a
            later pass; 0.4 in the first one. After a good start what is left of the static scene
            is short and the flow of moving objects long, whatever their share.

    Raises:
        InputError: a value out of bounds, or two that exclude each other.
    """

    kind: Kind = "pwvo"
    width: Annotated[float, Field(gt=0, le=4)] = 1.0
    decoders: Literal[1, 2] = 1
    head_stride: Literal[1, 2] = 1
    uncertainty: bool = True
    scale_free: bool = False
    passes: Annotated[int, Field(ge=1, le=8)] = 1
    input_stride: Literal[1, 2, 4] = 1
    later_quantile: Annotated[float, Field(gt=0, le=0.5)] = 0.4

    def __post_init__(self) -> None:
        if self.passes > 1 and not (self.scale_free and self.kind == "pwvo" and self.uncertainty):
            raise InputError(
                "passes above 1 need scale_free=True and the uncertainty of kind='pwvo'"
            )
        if self.decoders == 2 and not self.uncertainty:
            raise InputError(
                "decoders=2 gives the uncertainty its own decoder; without it set decoders=1"
            )
