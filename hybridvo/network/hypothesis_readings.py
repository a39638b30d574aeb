"""How flow, images and depth maps agree with motion hypotheses, pixel by pixel."""

from __future__ import annotations

from dataclasses import fields
from typing import TYPE_CHECKING

import numpy as np
import torch
import torch.nn.functional as F

from hybridvo.compiled.numba_tools import as_contiguous, in_two_threads
from hybridvo.network.grid_maps import GridMaps
from hybridvo.network.hypothesis_kernels import (
    ALL_KNOWN,
    FAR_RESIDUAL,
    HALF_TEXTURE_VARIANCE,
    MIN_FLOW_NOISE,
    MIN_PATCH_COVER,
    MIN_Z,
    PATCH,
    SUPPORT_CUTOFF_SQUARED,
    HypothesisReadings,
    PairMaps,
    compare_images_of_hypothesis,
    read_flow_of_hypothesis,
)

if TYPE_CHECKING:
    from hybridvo.network.hypothesis_inputs import HypothesisInputs


MAPS_OF_FLAGS = ("in_front", "known")
"""Readings of type bool."""


def read_hypotheses(inputs: HypothesisInputs) -> HypothesisReadings:
    """Read what every hypothesis leaves unexplained.

    Args:
        inputs: pairs and hypotheses.

    Returns:
        Tensors. On a CPU, without gradients, compiled kernels compute them.
    """
    if inputs.depth.device.type == "cpu" and not torch.is_grad_enabled():
        return _read_compiled(inputs)
    maps = GridMaps(
        **{f.name: getattr(inputs, f.name)[inputs.owner] for f in fields(GridMaps)}
    )
    return _compare_images(maps, _read_flow(inputs, maps))


def _read_compiled(inputs: HypothesisInputs) -> HypothesisReadings:
    shape = (len(inputs.owner), *inputs.depth.shape[1:])
    arrays = HypothesisReadings(
        **{
            name: np.empty(shape, bool if name in MAPS_OF_FLAGS else np.float32)
            for name in HypothesisReadings._fields
        }
    )
    poses = inputs.pose.numpy()
    flow_noise = inputs.flow_noise.clamp(min=MIN_FLOW_NOISE).numpy()
    noise = np.stack([flow_noise, inputs.depth_noise.numpy()], axis=1)
    owners = inputs.owner.tolist()
    pairs = {owner: _maps_of_pair(inputs, owner) for owner in set(owners)}

    def read(first: int, last: int) -> None:
        for n in range(first, last):
            maps = pairs[owners[n]]
            read_flow_of_hypothesis(maps, poses[n], noise[n], n, arrays)
            compare_images_of_hypothesis(maps, n, arrays)

    in_two_threads(read, len(owners))
    return HypothesisReadings._make(torch.from_numpy(each) for each in arrays)


def _maps_of_pair(inputs: HypothesisInputs, number: int) -> PairMaps:
    values = {
        name: getattr(inputs, name)[number].numpy() for name in PairMaps._fields
    }
    stride = int(values.pop("stride"))
    arrays = {name: as_contiguous(value) for name, value in values.items()}
    return PairMaps(stride=stride, **arrays)


def _read_flow(inputs: HypothesisInputs, maps: GridMaps) -> HypothesisReadings:
    """What every hypothesis leaves of the flow, and where it leads."""
    x, y = maps.ray.unbind(1)
    z = maps.depth
    fx, fy, cx, cy = (c[:, None, None] for c in maps.K.unbind(1))
    P = inputs.pose[:, :, :, None, None]
    a, b, c = (
        z * (P[:, i, 0] * x + P[:, i, 1] * y + P[:, i, 2]) + P[:, i, 3]
        for i in range(3)
    )
    front = c > MIN_Z
    i = 1.0 / torch.where(front, c, 1.0)
    a = a * i
    b = b * i
    u = fx * a + cx
    v = fy * b + cy
    ru = maps.target[:, 0] - u
    rv = maps.target[:, 1] - v
    qu = fx * i * (a * P[:, 2, 3] - P[:, 0, 3])
    qv = fy * i * (b * P[:, 2, 3] - P[:, 1, 3])
    # whitened by the symmetric root of sf^2 v_f I + sd^2 v_d q q^T
    sf = inputs.flow_noise.clamp(min=MIN_FLOW_NOISE)[:, None, None]
    sd = inputs.depth_noise[:, None, None]
    information = 1.0 / (sf * sf * maps.flow_variance)
    g = sd * sd * maps.depth_variance * information
    root = torch.sqrt(1.0 + g * (qu * qu + qv * qv))
    shrink = g / (root * (1.0 + root)) * (qu * ru + qv * rv)
    scale = torch.sqrt(information)
    known = maps.usable & front
    eu, ev = (
        torch.where(known, (r - shrink * q) * scale, FAR_RESIDUAL).clamp(
            -FAR_RESIDUAL, FAR_RESIDUAL
        )
        for r, q in ((ru, qu), (rv, qv))
    )
    d2 = eu * eu + ev * ev
    robust = SUPPORT_CUTOFF_SQUARED / (SUPPORT_CUTOFF_SQUARED + d2)
    log_z = torch.log(c.clamp(min=MIN_Z))
    has_depth = known & torch.isfinite(maps.log_depth_at_target)
    nothing = torch.zeros_like(u)
    return HypothesisReadings(
        u=u,
        v=v,
        log_z=log_z,
        in_front=front,
        known=known,
        eu=eu,
        ev=ev,
        length=torch.sqrt(ru * ru + rv * rv),
        support=torch.square(robust) * maps.usable,
        depth_residual=torch.where(
            has_depth, maps.log_depth_at_target - log_z, 0.0
        ),
        has_depth=has_depth.to(z.dtype),
        texture=nothing,
        agreement=nothing,
        depth_ratio=nothing,
        is_compared=nothing,
    )


def _compare_images(maps: GridMaps, read: HypothesisReadings) -> HypothesisReadings:
    """Compare the two images and depth maps of each hypothesis where it leads."""
    log_depth = maps.log_depth_curr
    stride = maps.stride[:, None, None, None]
    planes = [
        maps.image_curr,
        torch.nan_to_num(log_depth),
        torch.isfinite(log_depth).float(),
    ]
    first = torch.div(stride, 2, rounding_mode="floor")
    cell = (torch.stack([read.u, read.v], dim=-1) - first) / stride
    where = 2 * (cell + 0.5) / cell.new_tensor(log_depth.shape[:0:-1]) - 1
    is_inside = read.in_front & maps.has_depth & (where.abs() < 1).all(-1)
    where = torch.where(is_inside[..., None], where, 0.0)
    warped = F.grid_sample(
        torch.stack(planes, dim=1),
        where,
        align_corners=False,
        padding_mode="border",
    )
    p = maps.image_prev
    q = warped[:, 0]
    weight = is_inside.to(p.dtype)
    terms = (
        torch.stack([torch.ones_like(p), p, q, p * p, q * q, p * q], 1)
        * weight[:, None]
    )
    mean = _patch_means(terms)
    cover = mean[:, 0]
    mean = mean[:, 1:] / cover.clamp(min=1e-6)[:, None]
    var_p = (mean[:, 2] - mean[:, 0] ** 2).clamp(min=0)
    var_q = (mean[:, 3] - mean[:, 1] ** 2).clamp(min=0)
    # the texture is that of the previous image, which does not depend on the hypothesis
    is_covered = weight * (cover > MIN_PATCH_COVER)
    texture = var_p / (var_p + HALF_TEXTURE_VARIANCE) * is_covered
    covariance = mean[:, 4] - mean[:, 0] * mean[:, 1]
    noise = torch.sqrt(var_p * var_q) + 0.5 * HALF_TEXTURE_VARIANCE
    known = is_inside & (warped[:, 2] > ALL_KNOWN)
    return read._replace(
        texture=texture,
        agreement=texture * covariance / noise,
        depth_ratio=torch.where(known, warped[:, 1] - read.log_z, 0.0),
        is_compared=known.to(p.dtype),
    )


def _patch_means(x: torch.Tensor) -> torch.Tensor:
    """Average maps (N, C, h, w) over the patch around each pixel, with zeros outside.

    Shifted maps are summed along the columns, then along the rows, which takes an eighth of
    the time of a convolution.
    """
    side = PATCH // 2
    for axis, border in ((2, (0, 0, side, side)), (3, (side, side))):
        padded = F.pad(x, border)
        length = x.shape[axis]
        x = padded.narrow(axis, 0, length).clone()
        for shift in range(1, PATCH):
            x += padded.narrow(axis, shift, length)
    return x / PATCH**2
