"""What is refused at the public functions, and that the words say where and what."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

import hybridvo as hvo
from hybridvo.core.errors import InputError
from hybridvo.core.geometry import to_gtsam_covariance
from hybridvo.core.results import PixelwisePrediction
from tests import worlds
from tests.doors import refuses

K = worlds.camera((24, 32))
DEPTH = np.full((24, 32), 2.0, np.float32)
PAIR = worlds.world()[0]


def frame(**changed: object) -> hvo.Frame:
    return hvo.Frame(**({"rgb": None, "depth": DEPTH, "camera": K} | changed))


def tracker(**options: object) -> hvo.Odometry:
    return hvo.Odometry(network=None, **options)


def camera(**changed: object) -> hvo.Camera:
    right = {"fx": 9, "fy": 9, "cx": 1, "cy": 1, "height": 4, "width": 4}
    return hvo.Camera(**(right | changed))


BATCH = hvo.PairBatch.from_pairs([PAIR, PAIR])
EYES = torch.eye(4).repeat(2, 1, 1)
ONES = torch.ones(2, *PAIR.prev.camera.shape)
MAPS = PixelwisePrediction(torch.zeros(1, 6, 8, 16), torch.zeros(1, 6, 8, 16))
BAD_SIZES = (0, -1, 2.5, np.nan, np.inf, None, True, 10**400, [4])
BAD_FOCALS = (0, -5.0, np.nan, np.inf, 1e-300, 1e300, None, "wide")
BAD_STAMPS = (np.nan, -np.inf, None, "now", 10**400)
BAD_INDICES = ("a", 1.5, np.nan)
BAD_IMAGES = (
    np.zeros((24, 32, 2), np.uint8),
    np.zeros((3, 24, 32), np.uint8),
    np.zeros((24, 32, 3), np.uint16),
    np.zeros((24, 32, 3), bool),
    np.zeros((23, 32, 3), np.uint8),
    np.zeros((0, 0, 3), np.uint8),
)
BAD_DEPTHS = (
    np.ones((24, 32), int),
    np.ones((24, 32), complex),
    np.ones((24, 32), object),
    np.ones((24, 32, 2)),
    np.ones((32, 24)),
    np.ones(24 * 32),
    [[1.0], [1.0, 2.0]],
    "depth",
    1.0,
)
BAD_POSES = ("x", None, np.diag([1.0, 1, 1, 2]), np.eye(4) * 1j, np.zeros((4, 4)))
BAD_SEEDS = ("x", None, -1, 1.5, True, 2**70)

GREY = np.zeros((24, 32), np.uint8)
FLOW = np.zeros((24, 32, 2), np.float32)
REMEDIES: dict[str, tuple[str, np.ndarray, tuple[str, ...]]] = {
    "millimetres": (
        "depth",
        np.full((24, 32), 2000, np.uint16),
        ("uint16", "divide by 1000"),
    ),
    "a picture of depth": ("depth", GREY, ("uint8", "8 bits", "metres")),
    "depth on its side": ("depth", np.ones((32, 24)), ("transpose",)),
    "RGBA": ("rgb", np.zeros((24, 32, 4), np.uint8), ("alpha", "rgb[..., :3]")),
    "channels first": (
        "rgb",
        np.zeros((3, 24, 32), np.uint8),
        ("transpose(1, 2, 0)",),
    ),
    "rgb up to 1": ("rgb", np.ones((24, 32, 3)), ("Multiply by 255", "uint8")),
    "a mask of numbers": ("mask", GREY, ("boolean", "mask > 0")),
    "flow of RAFT": (
        "flow",
        FLOW.transpose(2, 0, 1)[None],
        ("(H, W, 2)", "flow[0]", "permute"),
    ),
    "flow of half the size": (
        "flow",
        FLOW[::2, ::2],
        ("Resize", "scale its values"),
    ),
    "flow of a field": ("flow", hvo.FlowField(FLOW), ("FlowField", "variance")),
}


def handed_in(name: str, value: np.ndarray) -> object:
    if name == "flow":
        return hvo.FramePair(frame(), frame(), value)
    return frame(**{name: value})


test_remedies = refuses(
    [
        (what, lambda n=name, v=value: handed_in(n, v), InputError,
         (f".{name}: expected", "got", *words))
        for what, (name, value, words) in REMEDIES.items()
    ]
)  # fmt: skip


test_types = refuses(
    [
        *((f"height {v!r}", lambda v=v: camera(height=v), InputError, ("Camera.height", "expected"))
          for v in BAD_SIZES),
        *((f"fx {v!r}", lambda v=v: camera(fx=v), InputError, ("Camera.fx", "expected"))
          for v in BAD_FOCALS),
        *((f"stamp {v!r}", lambda v=v: frame(timestamp=v), InputError, ("Frame.timestamp",))
          for v in BAD_STAMPS),
        *((f"index {v!r}", lambda v=v: frame(index=v), InputError, ("Frame.index", "expected"))
          for v in BAD_INDICES),
        *((f"rgb {i}", lambda v=v: frame(rgb=v), InputError, ("Frame.rgb", "expected", "got"))
          for i, v in enumerate(BAD_IMAGES)),
        *((f"depth {i}", lambda v=v: frame(depth=v), InputError, ("Frame.depth",))
          for i, v in enumerate(BAD_DEPTHS)),
        ("no matrix", lambda: hvo.Camera.from_matrix("K", 4, 4), InputError, ("3x3",)),
        ("no frame", lambda: hvo.FramePair(frame(), None, None), InputError, ("FramePair.curr",)),
        ("flow of another size", lambda: hvo.FramePair(frame(), frame(), np.zeros((9, 9, 2))),
         InputError, ("FramePair.flow", "expected", "got")),
        *((f"gtsam {type(v).__name__}", lambda v=v: to_gtsam_covariance(v), InputError,
           ("to_gtsam_covariance",)) for v in (None, np.eye(4), "x")),
    ]
)  # fmt: skip

test_functions = refuses(
    [
        *((f"estimate seed {v!r}", lambda v=v: hvo.estimate(PAIR, method="classical", seed=v),
           InputError, ("seed",)) for v in BAD_SEEDS),
        ("estimate a tuple", lambda: hvo.estimate((PAIR.prev, PAIR.curr, PAIR.flow)), InputError,
         ("FramePair", "tuple")),
        ("estimate with a dict", lambda: hvo.estimate(PAIR, method="classical", options={}),
         InputError, ("options", "dict")),
        *((f"estimate models {v!r}", lambda v=v: hvo.estimate(PAIR, models=v), InputError,
           ("estimate.models", "Models")) for v in ("x", {}, 3)),
        *((f"estimate method {v!r}", lambda v=v: hvo.estimate(PAIR, method=v), InputError,
           ("estimate.method", "str")) for v in (None, 3, ["classical"], {})),
        *((f"estimate prior {v!r}", lambda v=v: hvo.estimate(PAIR, prior=v), InputError,
           ("estimate.prior", "MotionPrior")) for v in ("x", 3)),
        *((f"estimate {v!r}", lambda v=v: hvo.estimate(v), InputError, ("FramePair", "got"))
          for v in (None, 3, "x")),
        ("flow of numbers", lambda: hvo.dis_flow()(1, 2), InputError,
         ("dis_flow()(prev, curr): prev", "expected Frame", "got int")),
        *((f"open_sequence {name}", lambda n=name: hvo.open_sequence(".", **{n: 5}), InputError,
           (f"open_sequence: {name}", "got int"))
          for name in ("topic_rgb", "topic_depth", "topic_info", "topic_truth", "depth_dir")),
        ("estimate one frame", lambda: hvo.estimate(PAIR.prev), InputError,
         ("FramePair.curr", "NoneType")),
        ("refine of a frame", lambda: hvo.refine(PAIR.prev), InputError,
         ("refine.pair", "FramePair", "Frame")),
        *((f"refine weights {name}", lambda v=v: hvo.refine(PAIR, None, v), InputError,
           ("refine.weights", "expected", "got"))
          for name, v in {"with a gradient": ONES[0].clone().requires_grad_(), "text": "x",
                          "another size": np.ones((3, 3)), "complex": np.ones((96, 128)) * 1j,
                          "objects": np.full((96, 128), None), "meta": ONES[0].to("meta"),
                          "sparse": ONES[0].to_sparse()}.items()),
        *((f"refine start {name}", lambda v=v: hvo.refine(PAIR, v), InputError,
           ("refine.T_init", "expected", "got"))
          for name, v in {"text": "x", "scaled": 2 * np.eye(4), "two": np.zeros((2, 4, 4)),
                          "with a gradient": torch.eye(4).requires_grad_(),
                          "sparse": torch.eye(4).to_sparse()}.items()),
        *((f"refine {name} of a pair", lambda name=name: hvo.refine(PAIR, **{name: 1}), InputError,
           (f"refine.{name}", "PairBatch.from_pairs"))
          for name in ("noise", "kernel")),
        ("no such method", lambda: hvo.estimate(PAIR, method="refin"), InputError,
         ("refin", "classical")),
        *((f"tracker seed {v!r}", lambda v=v: tracker(seed=v), InputError, ("seed",))
          for v in BAD_SEEDS),
        ("tracker with a dict", lambda: tracker(options={"cutoff": 3}), InputError, ("options",)),
        *((f"set_pose {i}", lambda v=v: tracker().set_pose(v), InputError, ("set_pose",))
          for i, v in enumerate(BAD_POSES)),
        *((f"resume {v!r}", lambda v=v: tracker().resume(v), InputError, ("resume",))
          for v in (None, "x", {})),
        *((f"skip {v!r}", lambda v=v: tracker().skip(*v), InputError, ("skip",))
          for v in ((1, np.nan), ("a", 0.0), (1, "b"), (None, 0.0))),
    ]
)  # fmt: skip


RIGHT_K = BATCH.K_prev


def intrinsics(row: int, column: int, value: float) -> torch.Tensor:
    """Intrinsics of two pairs, of which the second has one other number."""
    K = RIGHT_K.clone()
    K[1, row, column] = value
    return K


BAD_INTRINSICS = {
    "one for all": (RIGHT_K[:1], ("shape (2, 3, 3)",)),
    "a matrix": (RIGHT_K[0], ("shape (2, 3, 3)",)),
    "whole numbers": (RIGHT_K.long(), ("floating point",)),
    "numpy": (RIGHT_K.numpy(), ("torch tensor", "ndarray", "torch.as_tensor")),
    "none": (None, ("torch tensor", "NoneType")),
    "not finite": (intrinsics(0, 0, np.nan), ("[1]", "finite")),
    "skew": (
        intrinsics(0, 1, 2.0),
        ("[1]", "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]", "Camera.K"),
    ),
    "last row": (intrinsics(2, 2, 7.0), ("[1]", "[0, 0, 1]]")),
    "transposed": (RIGHT_K.mT, ("[0]", "transposed")),
    "negative focal length": (
        intrinsics(1, 1, -90.0),
        ("[1]", "fy", "focal length"),
    ),
    "no focal length": (intrinsics(0, 0, 0.0), ("[1]", "fx", "focal length")),
    "centre far away": (intrinsics(0, 2, 1e4), ("[1]", "cx", "centre")),
    "sparse": (RIGHT_K.to_sparse(), ("dense", "sparse")),
    "meta": (RIGHT_K.to("meta"), ("dense", "meta")),
}
BAD_STARTS = {
    "text": "x",
    "no start": torch.zeros(2, 0, 4, 4),
    "one for two": torch.eye(4),
    "a part": EYES[:, :3],
    "sparse": EYES.to_sparse(),
    "meta": EYES.to("meta"),
    "rags": [[1.0], [1.0, 2.0]],
    "a dict": {},
}
BAD_WEIGHTS = {
    "text": "x",
    "another size": ONES[:, 1:],
    "sparse": ONES.to_sparse(),
    "meta": ONES.to("meta"),
    "complex": ONES * 1j,
    "a set": {1.0},
}

test_batches = refuses(
    [
        *((f"{name}: {what}",
           lambda name=name, K=K: replace(BATCH, **{name: K}),
           InputError, (f"PairBatch.{name}", "expected", "got", *words))
          for name in ("K_prev", "K_curr") for what, (K, words) in BAD_INTRINSICS.items()),
        ("flow of RAFT", lambda: replace(BATCH, flow=BATCH.flow.movedim(3, 1)), InputError,
         ("PairBatch.flow", "(B, H, W, 2)", "(2, 2, 96, 128)")),
        ("sparse depth", lambda: replace(BATCH, depth_curr=BATCH.depth_curr.to_sparse()),
         InputError, ("PairBatch.depth_curr", "sparse")),
        ("flow of numpy", lambda: replace(BATCH, flow=BATCH.flow.numpy()), InputError,
         ("PairBatch.flow", "from_pairs")),
        *((f"pairs {name}", lambda v=v: hvo.PairBatch.from_pairs(v), InputError,
           ("PairBatch.from_pairs", "expected", "got"))
          for name, v in {"none": None, "empty": [], "a pair": PAIR, "frames": [PAIR.prev],
                          "text": "xy"}.items()),
        ("pairs of two sizes",
         lambda: hvo.PairBatch.from_pairs([PAIR, hvo.FramePair(frame(), frame(), None)]),
         InputError, ("one size", "(24, 32)", "(96, 128)")),
        *((f"device {v!r}", lambda v=v: hvo.PairBatch.from_pairs([PAIR], device=v), InputError,
           ("PairBatch.from_pairs", "device")) for v in ("nope", 1.5, [])),
        *((f"dtype {v!r}", lambda v=v: hvo.PairBatch.from_pairs([PAIR], dtype=v), InputError,
           ("PairBatch.from_pairs", "dtype")) for v in ("float32", torch.int64, 1)),
        *((f"start {name}", lambda v=v: hvo.refine(BATCH, v, ONES), InputError,
           ("refine_batch", "T_init", "expected", "got")) for name, v in BAD_STARTS.items()),
        *((f"weights {name}", lambda v=v: hvo.refine(BATCH, EYES, v), InputError,
           ("refine_batch", "weights", "expected", "got")) for name, v in BAD_WEIGHTS.items()),
        *((f"evidence {name}", lambda v=v: hvo.refine(BATCH, hvo.PoseSeed(EYES, ONES, v)),
           InputError, ("refine_batch", "evidence", "expected", "got"))
          for name, v in {"text": "x", "of three": torch.ones(3), "one": 1.0}.items()),
        *((f"noise {name}", lambda v=v: hvo.refine(BATCH, noise=v), InputError,
           ("refine_batch", "noise", "expected", "got"))
          for name, v in {"text": "x", "one": 0.3, "zero": (0, 0), "nan": (np.nan, 0.1),
                          "of three": torch.ones(3, 2)}.items()),
        *((f"kernel {v!r}", lambda v=v: hvo.refine(BATCH, kernel=v), InputError,
           ("kernel", "geman-mcclure", "cauchy")) for v in ("tukey", 3, [])),
        *((f"maps {type(v).__name__}", lambda v=v: hvo.select(v), InputError,
           ("select", "PixelwisePrediction", type(v).__name__)) for v in (None, BATCH, "x")),
        *((f"maps, {name} {what}", lambda n=name, v=v: hvo.select(replace(MAPS, **{n: v})),
           InputError, (f"select.maps.{name}", "expected", "got"))
          for name in ("motion", "log_scale", "evidence", "image_size")
          for what, v in {"text": "x", "number": 3, "array": np.zeros(2), "rows": ONES,
                          "sparse": ONES.to_sparse(), "tuple": (0, 0)}.items()),
        ("options of no network", lambda: hvo.PWVO("pwvo"), InputError,
         ("PWVO.options", "PWVOOptions", "str")),
        ("kernel of an array", lambda: hvo.refine(BATCH, kernel=ONES), InputError, ("kernel",)),
        ("device of an array", lambda: hvo.PairBatch.from_pairs([PAIR], ONES), InputError,
         ("device",)),
        ("8-bit floats", lambda: replace(BATCH, flow=BATCH.flow.to(torch.float8_e4m3fn)),
         InputError, ("PairBatch.flow", "16 bits", "float8")),
        ("unknown selection", lambda: hvo.select(MAPS, "best"), InputError, ("best", "softmax")),
        ("selection of no text", lambda: hvo.select(MAPS, 3), InputError,
         ("select.method", "str", "int")),
        ("selection of patches that are missing", lambda: hvo.select(MAPS, "fused"), InputError,
         ("fused", "patches", "hybridvo[train]")),
        *((f"weights of {v!r}", lambda v=v: hvo.PWVO.from_pretrained(v), InputError,
           ("no such weights", "pwvo-paper")) for v in (None, 3, "", "nosuch", [], b"pwvo")),
        *((f"PWVO of {type(v).__name__}", lambda v=v: hvo.PWVO.from_pretrained()(v),
           InputError, ("FramePair", "PairBatch", type(v).__name__)) for v in (None, [PAIR], "x")),
    ]
)  # fmt: skip


def test_half_precision_and_masked_arrays_are_read() -> None:
    pair, T = worlds.world()
    half = hvo.FramePair(
        hvo.Frame(None, pair.prev.depth.astype(np.float16), pair.prev.camera),
        pair.curr,
        pair.flow.astype(np.float16),
    )
    # 11 bits: 5e-4 of the depth, 1e-3 px of flow of some pixels; averaged over 12 000 of them
    found = hvo.estimate(half, method="classical")
    worlds.assert_pose_close(found.T_curr_prev, T, rad=2e-5, m=2e-4)
    hidden = np.zeros(pair.prev.camera.shape, bool)
    hidden[:20] = True
    masked = hvo.Frame(
        None, np.ma.masked_array(pair.prev.depth, hidden), pair.prev.camera
    )
    assert np.array_equal(np.isnan(masked.depth), hidden)


def test_a_flow_provider_that_returns_no_field_is_named() -> None:
    pair, _ = worlds.world()
    vo = tracker(flow=lambda prev, curr: (pair.flow, None))
    vo.track(pair.prev)
    with pytest.raises(InputError, match="flow"):
        vo.track(pair.curr)


def test_pairs_may_come_from_a_generator() -> None:
    made = hvo.PairBatch.from_pairs(pair for pair in [PAIR, PAIR])
    for name, value in vars(BATCH).items():
        other = getattr(made, name)
        assert value is None if other is None else torch.equal(value, other), name
    assert (
        hvo.PairBatch.from_pairs([PAIR], dtype=torch.float64).flow.dtype
        == torch.float64
    )


def test_intrinsics_a_little_off_are_those_of_a_camera() -> None:
    """Rounding, and the steps of finite differences."""
    K = BATCH.K_prev.double() + 1e-7
    assert torch.equal(replace(BATCH, K_prev=K.requires_grad_()).K_prev, K)
