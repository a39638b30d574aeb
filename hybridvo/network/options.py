"""What decides the shapes of a network's weights and how it reads its inputs."""

from __future__ import annotations

from dataclasses import dataclass

from hybridvo.errors import InputError

KINDS = ("pwvo", "vonet", "vonet-attention")


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
        scale_free: divide the inputs by the pair's own scales and multiply the outputs by them, see
            :mod:`hybridvo.network.normalization`. Off as published.
        passes: 1 to 8, how often a scale-free network is used: each later pass looks at what the
            motion that the trusted pixels of the one before agree on leaves unexplained.
        input_stride: 1, 2 or 4; the network reads every n-th pixel of its inputs.
        later_quantile: quantile of the lengths of the unexplained flow that scales the inputs of a
            later pass, in (0, 0.5]; 0.4 in the first one. After a good start what is left of the
            world is short and the flow of movers long, whatever their share.

    Raises:
        InputError: a value outside of what is listed, or two that exclude each other.
    """

    kind: str = "pwvo"
    width: float = 1.0
    decoders: int = 1
    head_stride: int = 1
    uncertainty: bool = True
    scale_free: bool = False
    passes: int = 1
    input_stride: int = 1
    later_quantile: float = 0.4

    def __post_init__(self) -> None:
        allowed = {
            "kind": KINDS,
            "decoders": (1, 2),
            "head_stride": (1, 2),
            "uncertainty": (False, True),
            "scale_free": (False, True),
            "passes": tuple(range(1, 9)),
            "input_stride": (1, 2, 4),
        }
        for name, values in allowed.items():
            value = getattr(self, name)
            # by type as well: True equals 1
            if (type(value), value) not in [(type(v), v) for v in values]:
                listed = ", ".join(map(str, values))
                raise InputError(f"NetworkOptions.{name}: expected one of {listed}, got {value!r}.")
        for name, most in (("width", 4), ("later_quantile", 0.5)):
            value = getattr(self, name)
            if type(value) not in (int, float) or not 0 < value <= most:
                raise InputError(
                    f"NetworkOptions.{name}: expected a number in (0, {most}], got {value!r}."
                )
        if self.passes > 1 and not (self.scale_free and self.kind == "pwvo" and self.uncertainty):
            raise InputError(
                "NetworkOptions: passes above 1 need scale_free=True and the uncertainty of "
                "kind='pwvo'."
            )
        if self.decoders == 2 and not self.uncertainty:
            raise InputError(
                "NetworkOptions: decoders=2 gives the uncertainty its own decoder, but "
                "uncertainty=False. Set decoders=1."
            )
