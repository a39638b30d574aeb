"""What is refused at the public functions, and that the words say where and what."""

from __future__ import annotations

import numpy as np
import pytest

import hybridvo as hvo
from hybridvo.errors import InputError
from hybridvo.geometry import to_gtsam_covariance
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
        *((f"estimate seed {v!r}", lambda v=v: hvo.estimate(PAIR, method="refine", seed=v),
           InputError, ("seed",)) for v in BAD_SEEDS),
        ("estimate a tuple", lambda: hvo.estimate((PAIR.prev, PAIR.curr, PAIR.flow)), InputError,
         ("FramePair", "tuple")),
        ("estimate with a dict", lambda: hvo.estimate(PAIR, method="refine", options={}),
         InputError, ("options", "dict")),
        ("no such method", lambda: hvo.estimate(PAIR, method="refin"), InputError,
         ("refin", "refine")),
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


def test_half_precision_and_masked_arrays_are_read() -> None:
    pair, T = worlds.world()
    half = hvo.FramePair(
        hvo.Frame(None, pair.prev.depth.astype(np.float16), pair.prev.camera),
        pair.curr,
        pair.flow.astype(np.float16),
    )
    # 11 bits: 5e-4 of the depth, 1e-3 px of flow of some pixels; averaged over 12 000 of them
    found = hvo.estimate(half, method="refine")
    worlds.assert_pose_close(found.T_curr_prev, T, rad=2e-5, m=2e-4)
    hidden = np.zeros(pair.prev.camera.shape, bool)
    hidden[:20] = True
    masked = hvo.Frame(None, np.ma.masked_array(pair.prev.depth, hidden), pair.prev.camera)
    assert np.array_equal(np.isnan(masked.depth), hidden)


def test_a_flow_provider_that_returns_no_field_is_named() -> None:
    pair, _ = worlds.world()
    vo = tracker(flow=lambda prev, curr: (pair.flow, None))
    vo.track(pair.prev)
    with pytest.raises(InputError, match="flow"):
        vo.track(pair.curr)
