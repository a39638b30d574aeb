"""The processes of one training, which torchrun starts: which part of a batch each has.

Every process ("rank") has the same network. Each computes the gradient of its part of a batch,
and torch's DistributedDataParallel averages them. Without torchrun there is one rank, and
nothing here changes anything.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Mapping

import torch
from torch import distributed, nn

from hybridvo.core.errors import InputError


def count() -> int:
    """Return the number of ranks."""
    return distributed.get_world_size() if _is_group() else 1


def own() -> int:
    """Return the number of this rank."""
    return distributed.get_rank() if _is_group() else 0


def is_first() -> bool:
    """Return whether this rank writes files and messages."""
    if _is_group():
        return own() == 0
    # before the ranks have found each other
    return not is_launched() or os.environ["RANK"] == "0"


def is_launched() -> bool:
    """Return whether torchrun has started this process."""
    return distributed.is_available() and distributed.is_torchelastic_launched()


def _is_group() -> bool:
    return distributed.is_available() and distributed.is_initialized()


def device_of(device: str) -> str:
    """Return this rank's own device: each has a GPU of its machine."""
    if device != "cuda" or not is_launched():
        return device
    number = int(os.environ["LOCAL_RANK"])
    gpus = torch.cuda.device_count()
    if number >= gpus:
        raise InputError(
            f"torchrun --nproc-per-node: expected at most {gpus}, one process a GPU of this "
            f"machine, got {number + 1} or more."
        )
    torch.cuda.set_device(number)
    return f"cuda:{number}"


@contextlib.contextmanager
def joined(device: str) -> Iterator[None]:
    """Let the ranks find each other within, if torchrun has started this process.

    Args:
        device: of the network: GPUs average gradients by NCCL, processors by gloo.
    """
    if not is_launched() or _is_group():
        yield
        return
    is_gpu = device.startswith("cuda")
    distributed.init_process_group("cpu:gloo,cuda:nccl" if is_gpu else "gloo")
    try:
        yield
        # a process that is gone would abort one that still has messages for it
        distributed.barrier()
    finally:
        distributed.destroy_process_group()


def part(whole: range) -> range:
    """Return this rank's part of some numbers; the parts differ by at most one in length.

    >>> part(range(3, 7))
    range(3, 7)
    """
    return whole[own() :: count()]


def parallel(module: nn.Module) -> nn.Module:
    """Return a module whose gradients are averaged over the ranks."""
    if count() == 1:
        return module
    return nn.parallel.DistributedDataParallel(module)


def mean(values: torch.Tensor) -> torch.Tensor:
    """Return the means over the ranks, without gradient.

    A loss that is a sum divided by the mean of the ranks' counts has, once the gradients are
    averaged, the gradient of the sum over the whole batch divided by the whole count.

    >>> mean(torch.tensor([2.0, 4.0]))
    tensor([2., 4.])
    """
    values = values.detach().float()
    if count() == 1:
        return values
    values = values.clone()
    distributed.all_reduce(values)
    return values / count()


def divisor(number: torch.Tensor) -> torch.Tensor:
    """Return the mean of a count over the ranks, to divide by: at least that of one in all.

    >>> divisor(torch.tensor(0))
    tensor(1.)
    """
    return mean(number).clamp(min=1 / count())


def mean_figures(figures: Mapping[str, float]) -> dict[str, float]:
    """Return the means of figures over the ranks, which all have the same."""
    names = sorted(figures)
    values = torch.tensor([figures[name] for name in names])
    if count() == 1:
        return dict(figures)
    return dict(zip(names, mean(values).tolist(), strict=True))


def of_first(value: float) -> float:
    """Return the value that the first rank has."""
    if count() == 1:
        return value
    shared = torch.tensor(value, dtype=torch.float64)
    distributed.broadcast(shared, 0)
    return float(shared)


def any_of(flag: bool) -> bool:
    """Return whether a flag is set in some rank."""
    return bool(mean(torch.tensor(float(flag))) > 0)
