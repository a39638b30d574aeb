"""Input types: camera, frame, pair and batch. Their values are checked.

``T_target_source`` maps points from ``source`` to ``target``. Camera axes are x right,
y down, z forward. Pixel (0, 0) is the centre of the top-left pixel. Tangent vectors are
(translation, rotation) of a left perturbation in the current camera.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import KW_ONLY, dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from hybridvo.core.checks import (
    as_number,
    brief,
    check_kind,
    kind_of,
    to_numpy,
)
from hybridvo.core.depth_units import depth_unit_fix, typical_depth
from hybridvo.core.errors import InputError

if TYPE_CHECKING:
    import torch

# largest image, in pixels, that a frame or a file header may declare
MAX_PIXELS = 2**28
# focal lengths, px, whose inverses and squares single precision can hold
FOCAL_RANGE = (1e-3, 1e9)
# bytes of an element of the smallest tensor type that can be computed with
MIN_ELEMENT_BYTES = 2
# characters of a message of torch that is shown
SHOWN_CHARACTERS = 200


SHOWN_NUMBERS = 16
"""Numbers of an array that a message shows; of a large one they would be gigabytes of text."""


@dataclass(frozen=True)
class Camera:
    """A pinhole camera without distortion.

    Pixel (0, 0) is the centre of the top-left pixel; camera axes are x right, y
    down, z forward.

    Attributes:
        fx: horizontal focal length, in pixels of this image.
        fy: vertical focal length, pixels.
        cx: column of the principal point, pixels; usually about (width - 1) / 2.
        cy: row of the principal point, pixels; usually about (height - 1) / 2.
        height: number of rows.
        width: number of columns.
        readout_ms: time from the first row to the last of a rolling shutter, ms; 0 if all
            rows are exposed at once, or if it is unknown.
        depth_lag_ms: how much later than the middle row of the image the depth map is measured,
            ms; below 0: earlier; 0 if both are of one time, or if it is unknown. With a lag, all
            of the depth map is of one time; without, its rows are those of the image.

    Raises:
        InputError: the size, focal length or principal point is impossible.

    >>> camera = Camera(fx=525, fy=525, cx=319.5, cy=239.5, height=480, width=640)
    >>> camera.shape
    (480, 640)
    """

    fx: float
    fy: float
    cx: float
    cy: float
    # width comes first in other libraries: nobody has to remember it
    _: KW_ONLY
    height: int
    width: int
    readout_ms: float = 0.0
    depth_lag_ms: float = 0.0

    def __post_init__(self) -> None:
        for name in ("height", "width"):
            self._check_size(name)
        size = f"an image of {self.width}x{self.height}"
        if self.height * self.width > MAX_PIXELS:
            raise InputError(
                f"Camera: {size} pixels is above the limit of {MAX_PIXELS}."
            )
        self._check_number("fx", "focal length", FOCAL_RANGE)
        self._check_number("fy", "focal length", FOCAL_RANGE)
        # a crop may leave the centre outside, by as much as the image is large
        self._check_number("cx", "centre", (-self.width, 2 * self.width))
        self._check_number("cy", "centre", (-self.height, 2 * self.height))
        readout = as_number(self.readout_ms)
        if not 0 <= readout < np.inf:
            raise InputError(
                f"Camera.readout_ms: expected milliseconds from 0 on, got {self.readout_ms!r}."
            )
        object.__setattr__(self, "readout_ms", readout)
        lag = as_number(self.depth_lag_ms)
        if not np.isfinite(lag):
            raise InputError(
                f"Camera.depth_lag_ms: expected milliseconds, got {self.depth_lag_ms!r}."
            )
        object.__setattr__(self, "depth_lag_ms", lag)

    def _check_size(self, name: str) -> None:
        value = getattr(self, name)
        size = as_number(value)
        is_integer = not isinstance(value, bool) and size % 1 == 0
        if not is_integer or size <= 0:
            raise InputError(
                f"Camera.{name}: expected a positive integer, got {value!r}."
            )
        object.__setattr__(self, name, int(size))

    def _check_number(
        self, name: str, what: str, limits: tuple[float, float]
    ) -> None:
        low, high = limits
        value = getattr(self, name)
        if not low <= as_number(value) <= high:
            raise InputError(
                f"Camera.{name}: expected a {what} of {low:g} to {high:g} pixels "
                f"for an image of {self.width}x{self.height}, got {value!r}."
            )
        object.__setattr__(self, name, float(value))

    @classmethod
    def from_matrix(cls, K: np.ndarray, height: int, width: int) -> Camera:
        """Return a camera with a given intrinsic matrix.

        Args:
            K: (3, 3) without skew, ``[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]``, px.
            height: number of rows.
            width: number of columns.

        Returns:
            The camera.

        Raises:
            InputError: the matrix has another form, or its values are impossible.
        """
        K = to_numpy(K, "Camera")
        if not _is_intrinsic(K):
            expected = "a finite 3x3 matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]"
            got = (
                K.tolist()
                if K.size <= SHOWN_NUMBERS
                else f"an array of shape {K.shape}"
            )
            raise InputError(f"Camera: expected {expected}, got {got}.")
        return cls(
            fx=K[0, 0],
            fy=K[1, 1],
            cx=K[0, 2],
            cy=K[1, 2],
            height=height,
            width=width,
        )

    @property
    def K(self) -> np.ndarray:
        """The intrinsic matrix, (3, 3) float64."""
        return np.array(
            [[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]]
        )

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width of the image, in this order."""
        return self.height, self.width


def _is_intrinsic(K: np.ndarray) -> bool:
    """Whether an array is a finite (3, 3) intrinsic matrix without skew."""
    if K.shape != (3, 3) or K.dtype.kind not in "fiu" or not np.isfinite(K).all():
        return False
    # the elements that are the same in every intrinsic matrix
    fixed = [[0, 1, 0], [1, 0, 0], [1, 1, 1]]
    return np.allclose(K * fixed, np.diag([0, 0, 1]))


# -- images of frames and pairs ----------------------------------------------------

ARRAY_KINDS = {
    "f": "a floating-point array",
    "u1": "uint8 values 0..255",
    "b": "a boolean array",
}
MASK_REMEDY = "Make it boolean, as mask > 0"
TYPE_REMEDIES = {
    "rgb": "Make it uint8, as np.uint8(rgb / 257) of 16 bits",
    "depth": "Convert it to metres in float32, as np.float32(depth) / 1000 of millimetres",
    "flow": "Convert it to pixels in float32",
    "mask": MASK_REMEDY,
    "flow_valid": MASK_REMEDY,
}
"""How an image of another type is converted to the expected one."""


def _type_remedy(name: str, array: np.ndarray) -> str:
    """What to do with an image whose type is not the one expected."""
    remedy = TYPE_REMEDIES.get(name, "Convert it to float32")
    if name == "flow" and array.dtype == object:
        return "Of a FlowField hand over flow, variance and valid by themselves"
    if name == "rgb" and array.dtype.kind == "f":
        largest = float(np.nanmax(array, initial=0.0))
        if largest > 1.0:
            return "Its values exceed 1: round and convert it, as np.uint8(rgb.round())"
        return "Multiply by 255 and convert it, as np.uint8(255 * rgb)"
    if name == "depth" and array.dtype == np.uint8:
        return "8 bits are a picture of depth: hand over the sensor's own values, in metres"
    if name == "depth" and array.dtype.kind in "iu" and array.size:
        return _integer_depth_remedy(array) or remedy
    return remedy


def _integer_depth_remedy(depth: np.ndarray) -> str:
    """What makes metres of a depth map of integers; empty where unknown."""
    median = typical_depth(depth.astype(np.float64))
    if median is None:
        return ""
    fix = depth_unit_fix(median)
    if not fix:
        return ""
    return (
        f"Convert it to float32 and {fix}: its median is {median:.4g}, so it is no "
        f"depth in metres"
    )


def _size_remedy(name: str, array: np.ndarray, camera: Camera) -> str:
    """What to do with an image of another height and width than the camera's."""
    height, width = array.shape[:2]
    if (height, width) == (camera.width, camera.height):
        return (
            f"Height and width are exchanged: is it Camera(height={height}, width={width})? Of an "
            f"image that was turned, take the camera that was turned with it; to transpose it "
            f"would mirror it"
        )
    if name in ("depth", "depth_variance"):
        return (
            "Depth must be registered to the image, not resized: let the camera's driver do it, or "
            "hybridvo.io.data.registration.register_depth"
        )
    return (
        "Give the camera of images of this size; hybridvo.io.data.resize.resize_camera makes it of "
        "one for larger images that were reduced"
    )


def _shape_remedy(name: str, array: np.ndarray, camera: Camera) -> str:
    """What to do with an image whose shape is not the one expected."""
    height, width = camera.shape
    if name == "rgb" and array.shape == (height, width, 4):
        return "Drop the alpha channel, as rgb[..., :3]"
    if name == "rgb" and array.shape == (3, height, width):
        return "Put the channels last, as rgb.transpose(1, 2, 0)"
    if name == "flow" and array.shape in (
        (2, height, width),
        (1, 2, height, width),
    ):
        first = "flow[0]" if array.ndim == 4 else "flow"
        return f"Permute it to (H, W, 2), as {first}.transpose(1, 2, 0), in torch .permute"
    if name == "flow" and array.shape == (1, height, width, 2):
        return "Take the only pair, as flow[0]"
    if name == "flow" and array.ndim == 3 and array.shape[2] == 2:
        return (
            "Resize it to the image's size and scale its values, u by the widths' ratio "
            "and v by the heights'"
        )
    if array.shape[:2] == (height, width):
        return "Its height and width fit, its number of channels does not"
    if array.ndim not in (2, 3):
        return "Hand in one image, without a batch"
    return _size_remedy(name, array, camera)


def _check_image(
    owner: Frame | FramePair, camera: Camera, name: str, kind: str, *channels: int
) -> None:
    """Check and convert one image of a frame or pair, if it has it.

    Args:
        owner: the frame or pair; its attribute is replaced.
        camera: has the size.
        name: of the attribute.
        kind: a key of :data:`ARRAY_KINDS`.
        channels: sizes behind height and width.

    Raises:
        InputError: for another type or size.
    """
    value = getattr(owner, name)
    if value is None:
        return
    where = f"{type(owner).__name__}.{name}"
    array = to_numpy(value, where)
    if kind not in (array.dtype.kind, array.dtype.str[1:]):
        got = f"{kind_of(array)}. {_type_remedy(name, array)}"
        raise InputError(f"{where}: expected {ARRAY_KINDS[kind]}, got {got}.")
    if array.ndim == 3 and array.shape[2] == 1:
        array = array[:, :, 0]
    is_grey = kind == "u1" and array.ndim == 2
    if is_grey:
        array = np.dstack([array, array, array])
    shape = (*camera.shape, *channels)
    if array.shape != shape:
        remedy = _shape_remedy(name, array, camera)
        raise InputError(
            f"{where}: expected shape {shape} (height, width, ...) as the camera has, "
            f"got {array.shape}. {remedy}."
        )
    if kind == "f":
        # what is too large for float32 becomes inf, which is invalid
        with np.errstate(over="ignore"):
            array = array.astype(np.float32, copy=False)
    object.__setattr__(owner, name, array)


REPR_STRIDE = 4
"""Of the rows and columns of depth that the text of a frame is made of."""


@dataclass(frozen=True, eq=False)
class Frame:
    """One RGB-D frame, checked against its camera.

    Attributes:
        rgb: (H, W, 3) uint8, red first, or greyscale (H, W); None if only depth and
            flow are used.
        depth: (H, W) floating point, metres along the optical axis z, registered to
            the image; NaN, inf, 0 and negative values are invalid. None if there is no
            depth.
        camera: the intrinsics, for the same image size.
        timestamp: seconds.
        index: number of the frame; None lets the tracker count.
        depth_variance: (H, W) variance of log depth, i.e. relative, or None.
        mask: (H, W) bool; where it is False, depth is removed, so that the pixel is not
            used. None uses all pixels.
        depth_source: where the depth comes from; with ``network``, its scale may vary
            from frame to frame, which ``depth.scale_per_frame`` corrects.
        depth_scale: factor by which the tracker has divided the depth.

    Raises:
        InputError: the size of an array differs from the camera's, or its type from the
            one given above.

    >>> camera = Camera(fx=525, fy=525, cx=319.5, cy=239.5, height=480, width=640)
    >>> rgb = np.zeros((480, 640, 3), np.uint8)
    >>> depth_mm = np.full((480, 640), 1500, np.uint16)
    >>> frame = Frame(rgb, np.float32(depth_mm) / 1000, camera, timestamp=0.1)
    >>> float(frame.depth[0, 0])
    1.5
    """

    rgb: np.ndarray | None
    depth: np.ndarray | None
    camera: Camera
    timestamp: float = 0.0
    index: int = None  # type: ignore[assignment]
    depth_variance: np.ndarray | None = None
    mask: np.ndarray | None = None
    depth_source: str = "unknown"
    depth_scale: float = 1.0

    def __repr__(self) -> str:
        parts = [
            "without image" if self.rgb is None else "image",
            self._depth_text(),
        ]
        if self.mask is not None:
            parts.append("mask")
        number = "" if self.index is None else f"{self.index}, "
        size = f"{self.camera.width}x{self.camera.height}"
        return f"Frame({number}{self.timestamp:.6g} s, {size}: {', '.join(parts)})"

    def _depth_text(self) -> str:
        """How much depth there is, and how far it reaches, in words."""
        if self.depth is None:
            return "without depth"
        shown = self.depth[::REPR_STRIDE, ::REPR_STRIDE]
        median = typical_depth(shown)
        if median is None:
            return "no valid depth"
        valid = np.mean(np.isfinite(shown) & (shown > 0))
        return f"depth on {100 * valid:.0f} %, median {median:.3g} m"

    def __post_init__(self) -> None:
        check_kind("Frame.camera", self.camera, Camera)
        _check_image(self, self.camera, "rgb", "u1", 3)
        _check_image(self, self.camera, "depth", "f")
        _check_image(self, self.camera, "depth_variance", "f")
        _check_image(self, self.camera, "mask", "b")
        if self.mask is not None and self.depth is not None:
            masked = np.where(self.mask, self.depth, np.float32(np.nan))
            object.__setattr__(self, "depth", masked)
        self._check_timestamp()
        self._check_index()

    def _check_timestamp(self) -> None:
        stamp = as_number(self.timestamp)
        if not np.isfinite(stamp):
            raise InputError(
                f"Frame.timestamp: expected finite seconds, got {self.timestamp!r}."
            )
        object.__setattr__(self, "timestamp", stamp)

    def _check_index(self) -> None:
        if self.index is None:
            return
        if as_number(self.index) % 1 != 0:
            raise InputError(
                f"Frame.index: expected a whole number, got {self.index!r}."
            )
        object.__setattr__(self, "index", int(self.index))

    @property
    def is_rgbd(self) -> bool:
        """Whether the frame has both an image and a depth map."""
        return self.rgb is not None and self.depth is not None


@dataclass(frozen=True, eq=False)
class FramePair:
    """Two frames of the same size and the flow between them: the input of every estimator.

    Attributes:
        prev: the previous frame.
        curr: the current frame.
        flow: (H, W, 2) floating point, pixels (u, v) from the previous to the
            current image, on the previous grid; NaN where unknown. None if there is no
            flow.
        flow_variance: (H, W) variance per component, px^2, relative or absolute, or None.
        flow_valid: (H, W) bool, False where the flow is known to be wrong, or None.
        flow_source: file, dis, or the name of a callable.
        flow_is_true: whether the flow is ground truth, i.e. an oracle.
        depth_source: sensor, stereo, file, network, or true (rendered, i.e. an oracle).

    Raises:
        InputError: the frames differ in size, or the flow does not fit them.

    >>> camera = Camera(fx=80, fy=80, cx=39.5, cy=29.5, height=60, width=80)
    >>> frame = Frame(None, np.ones((60, 80), np.float32), camera)
    >>> flow = np.zeros((60, 80, 2), np.float32)
    >>> FramePair(frame, frame, flow, flow_source="file").flow.shape
    (60, 80, 2)
    """

    prev: Frame
    curr: Frame
    flow: np.ndarray | None
    flow_variance: np.ndarray | None = None
    flow_valid: np.ndarray | None = None
    flow_source: str = "unknown"
    flow_is_true: bool = False
    depth_source: str = "unknown"

    def __repr__(self) -> str:
        flow = "without flow" if self.flow is None else f"flow: {self.flow_source}"
        return f"FramePair({self.prev!r}, {self.curr!r}, {flow})"

    def __post_init__(self) -> None:
        check_kind("FramePair.prev", self.prev, Frame)
        check_kind("FramePair.curr", self.curr, Frame)
        camera = self.prev.camera
        if self.curr.camera.shape != camera.shape:
            raise InputError(
                f"FramePair: expected frames of one size, got the previous "
                f"{camera.shape}, the current {self.curr.camera.shape}. "
                f"Resize with hybridvo.resize_frame."
            )
        _check_image(self, camera, "flow", "f", 2)
        _check_image(self, camera, "flow_variance", "f")
        _check_image(self, camera, "flow_valid", "b")

    @property
    def has_images(self) -> bool:
        """Whether both frames have an image: one alone can be compared with nothing."""
        return self.prev.rgb is not None and self.curr.rgb is not None


# -- batches -----------------------------------------------------------------------


def check_dense(where: str, tensor: torch.Tensor) -> None:
    """Raise an InputError for a tensor that cannot be computed with.

    Args:
        where: name of the argument, for the message.
        tensor: of any shape.
    """
    too_small = tensor.element_size() < MIN_ELEMENT_BYTES
    if tensor.is_floating_point() and too_small:
        raise InputError(f"{where}: expected 16 bits or more, got {tensor.dtype}.")
    if str(tensor.layout) != "torch.strided" or tensor.is_meta:
        got = "one on the meta device" if tensor.is_meta else str(tensor.layout)
        raise InputError(
            f"{where}: expected a dense tensor with values, got {got}."
        )


def check_plain(where: str, tensor: torch.Tensor) -> None:
    """Raise an InputError inside of a transform of torch.func, or for a tensor with a tangent.

    The refinement of a batch goes through numpy and branches on values, and even what it makes
    of plain tensors is wrapped inside of a transform. Its gradient is one step that is attached to
    the solution, for reverse-mode autograd.

    Args:
        where: name of the argument, for the message.
        tensor: of any shape.
    """
    import torch
    from torch.autograd.forward_ad import unpack_dual

    is_transformed = torch._C._are_functorch_transforms_active()
    if not is_transformed and tensor.is_floating_point():
        is_transformed = unpack_dual(tensor).tangent is not None
    if is_transformed:
        raise InputError(
            f"{where}: expected a plain tensor outside of torch.func and forward-mode "
            "differentiation, got it inside of one (jacrev, jvp, vmap). Use torch.autograd.grad or "
            "torch.autograd.functional.jacobian, and instead of vmap one batch of all samples."
        )


PINHOLE = np.diag([0.0, 0.0, 1.0])
"""Intrinsics of a pinhole camera without focal lengths and centre."""
PINHOLE_TOLERANCE = np.array(
    [[np.inf, 1e-3, np.inf], [1e-3, np.inf, np.inf], [1e-6, 1e-6, 1e-6]]
)
"""How far intrinsics may be from that: skew of 1e-3 px has no effect, and rounding.
"""


def _check_intrinsics(K: torch.Tensor, where: str, flow: torch.Tensor) -> None:
    """Check intrinsics (B, 3, 3) for the size of a flow, as a Camera does."""
    count = len(flow)
    height, width = flow.shape[1:3]
    if K.shape != (count, 3, 3) or not K.is_floating_point():
        raise InputError(
            f"{where}: expected shape ({count}, 3, 3), floating point, a matrix for "
            f"each pair, got {tuple(K.shape)} of {K.dtype}."
        )
    for k, matrix in enumerate(K.detach().double().cpu().numpy()):
        place = f"{where}[{k}]"
        if not _is_pinhole(matrix):
            is_transposed = _is_pinhole(matrix.T)
            remedy = (
                "it is transposed" if is_transposed else "Camera.K has this form"
            )
            raise InputError(
                f"{place}: expected a finite matrix [[fx, 0, cx], [0, fy, cy], "
                f"[0, 0, 1]] in pixels, got {matrix.tolist()}; {remedy}."
            )
        try:
            Camera(
                fx=matrix[0, 0],
                fy=matrix[1, 1],
                cx=matrix[0, 2],
                cy=matrix[1, 2],
                height=height,
                width=width,
            )
        except InputError as error:
            raise InputError(f"{place}: {error}") from None


def _is_pinhole(K: np.ndarray) -> bool:
    """Whether a matrix (3, 3) is finite and has the form of a pinhole's intrinsics."""
    if not np.isfinite(K).all():
        return False
    return bool((np.abs(K - PINHOLE) <= PINHOLE_TOLERANCE).all())


@dataclass(frozen=True, eq=False)
class PairBatch:
    """A batch of B pairs as torch tensors, through which gradients can flow.

    The tensors are dense and on the same device; ``hybridvo.refine`` checks their
    shapes.

    Attributes:
        flow: (B, H, W, 2) px from the previous to the current image, on the
            previous grid; NaN where unknown.
        depth_prev: (B, H, W) metres along z; values that are not finite and positive are
            invalid.
        K_prev: (B, 3, 3) intrinsics of the previous image, px: ``[[fx, 0, cx],
            [0, fy, cy], [0, 0, 1]]``.
        K_curr: (B, 3, 3) intrinsics of the current image.
        depth_curr: (B, H, W) metres on the current grid, or None.
        flow_variance: (B, H, W) variance per component, px^2, relative or absolute, or None.
        depth_variance: (B, H, W) variance of log depth, i.e. relative, or None.
        valid: (B, H, W) bool, True where a pixel may be used, or None.
        rgb_prev: (B, H, W, 3) uint8 previous image, an input of PWVO, or None.
        rgb_curr: (B, H, W, 3) uint8 current image, or None.
        has_images: (B,) bool, False for a pair without images; None: every pair has those of
            the batch.

    Raises:
        InputError: a value is not a dense tensor, or the intrinsics are not those of a
            pinhole camera.

    >>> import torch
    >>> batch = PairBatch(
    ...     flow=torch.zeros(2, 60, 80, 2),
    ...     depth_prev=torch.ones(2, 60, 80),
    ...     K_prev=torch.tensor([[80.0, 0, 39.5], [0, 80, 29.5], [0, 0, 1]]).repeat(2, 1, 1),
    ...     K_curr=torch.tensor([[80.0, 0, 39.5], [0, 80, 29.5], [0, 0, 1]]).repeat(2, 1, 1),
    ... )
    >>> batch
    PairBatch(2 pairs of 80x60, torch.float32, cpu)
    >>> len(batch), len(batch[1:]), batch.to("cpu", torch.float64).flow.dtype
    (2, 1, torch.float64)
    """

    flow: torch.Tensor
    depth_prev: torch.Tensor
    K_prev: torch.Tensor
    K_curr: torch.Tensor
    depth_curr: torch.Tensor | None = None
    flow_variance: torch.Tensor | None = None
    depth_variance: torch.Tensor | None = None
    valid: torch.Tensor | None = None
    rgb_prev: torch.Tensor | None = None
    rgb_curr: torch.Tensor | None = None
    has_images: torch.Tensor | None = None

    def __post_init__(self) -> None:
        import torch

        needed = ("flow", "depth_prev", "K_prev", "K_curr")
        for name, value in vars(self).items():
            if value is None and name not in needed:
                continue
            if not isinstance(value, torch.Tensor):
                raise InputError(
                    f"PairBatch.{name}: expected a torch tensor, got "
                    f"{type(value).__name__}. Numpy pairs go through "
                    f"PairBatch.from_pairs, arrays torch.as_tensor."
                )
            check_dense(f"PairBatch.{name}", value)
            check_plain(f"PairBatch.{name}", value)
        if self.flow.ndim != 4 or self.flow.shape[3] != 2 or self.flow.numel() == 0:
            got = str(tuple(self.flow.shape))
            raise InputError(
                f"PairBatch.flow: expected shape (B, H, W, 2), got {got}."
            )
        for name in ("K_prev", "K_curr"):
            _check_intrinsics(getattr(self, name), f"PairBatch.{name}", self.flow)

    def __len__(self) -> int:
        return len(self.flow)

    def __repr__(self) -> str:
        _, height, width, _ = self.flow.shape
        about = f"{width}x{height}, {self.flow.dtype}, {self.flow.device}"
        return f"PairBatch({len(self)} pairs of {about})"

    def __getitem__(self, samples: slice | list[int] | torch.Tensor) -> PairBatch:
        """Return some of the pairs, through which gradients flow as well.

        Args:
            samples: A slice, numbers, or a mask (B,) bool.

        Returns:
            A batch of at least one pair.

        Raises:
            InputError: They name no pair, or one that is not there.

        Example:
            >>> later = batch[2:]  # doctest: +SKIP
        """
        if isinstance(samples, int):
            last = f"{samples}:{samples + 1}" if samples != -1 else "-1:"
            raise InputError(
                f"PairBatch[{samples}]: expected a slice, numbers or a mask, got one number: a "
                f"batch of one pair is batch[{last}]."
            )
        try:
            return self._with(lambda value: value[samples])
        except (IndexError, TypeError, ValueError) as error:
            reason = " ".join(str(error).split())[:200]
            raise InputError(
                f"PairBatch[{str(samples)[:80]}]: expected pairs of 0 to {len(self) - 1}: {reason}"
            ) from None

    def to(
        self,
        device: torch.device | str | None = None,
        dtype: torch.dtype | None = None,
    ) -> PairBatch:
        """Return the batch on another device, or in another type of floating-point numbers.

        Args:
            device: as ``cuda``; None: where it is.
            dtype: of the floating-point tensors; images and masks keep theirs. None: as it is.

        Returns:
            The batch; gradients flow through it.

        Example:
            >>> batch = batch.to("cuda")  # doctest: +SKIP
        """

        def moved(value: torch.Tensor) -> torch.Tensor:
            return value.to(device, dtype if value.is_floating_point() else None)

        return self._with(moved)

    def _with(self, change: Callable[[torch.Tensor], torch.Tensor]) -> PairBatch:
        """The batch with every tensor changed in one way."""
        present = {name: v for name, v in vars(self).items() if v is not None}
        return PairBatch(**{name: change(value) for name, value in present.items()})

    @classmethod
    def from_pairs(
        cls,
        pairs: Iterable[FramePair],
        device: torch.device | str | None = None,
        dtype: torch.dtype | None = None,
    ) -> PairBatch:
        """Stack numpy pairs of the same size; what a pair lacks becomes invalid (NaN).

        A pair without images beside one with them has black ones, and says so.

        Args:
            pairs: FramePairs, as a list or from a generator such as ``iter_pairs``.
            device: device of the tensors; None: torch's default.
            dtype: type of the floating-point tensors; None: float32.

        Returns:
            The batch, with one sample per pair, in the same order.

        Raises:
            InputError: there are no pairs, an item is not a FramePair, or the pairs differ
                in size.
        """
        import torch

        pairs, size = _pairs_of_one_size(pairs)
        device, dtype = _device_and_dtype(device, dtype)
        stack = partial(_stack, device=device, dtype=dtype)
        no_depth = np.full(size, np.nan)
        no_flow = np.full((*size, 2), np.nan)
        # a pair without variances beside one with them has those of a typical pixel
        typical = np.ones(size)
        valid = [_unmasked(p) for p in pairs]
        black = np.zeros((*size, 3), np.uint8)
        rgb_prev = [p.prev.rgb if p.has_images else None for p in pairs]
        rgb_curr = [p.curr.rgb if p.has_images else None for p in pairs]
        as_images = partial(stack, dtype=torch.uint8)
        as_flags = partial(stack, dtype=torch.bool)
        has_images = None
        if any(p.has_images for p in pairs):
            has_images = as_flags([np.array(p.has_images) for p in pairs])
        return cls(
            flow=_filled([p.flow for p in pairs], no_flow, stack),
            depth_prev=_filled([p.prev.depth for p in pairs], no_depth, stack),
            K_prev=stack([p.prev.camera.K for p in pairs]),
            K_curr=stack([p.curr.camera.K for p in pairs]),
            depth_curr=_optional([p.curr.depth for p in pairs], no_depth, stack),
            flow_variance=_optional(
                [p.flow_variance for p in pairs], typical, stack
            ),
            depth_variance=_optional(
                [p.prev.depth_variance for p in pairs], typical, stack
            ),
            valid=_filled(valid, np.ones(size, np.bool_), as_flags),
            rgb_prev=_optional(rgb_prev, black, as_images),
            rgb_curr=_optional(rgb_curr, black, as_images),
            has_images=has_images,
        )

    def pairs(self) -> list[FramePair]:
        """Return the pairs as numpy arrays, without gradient.

        Returns:
            The pairs, in the order of the samples.
        """
        arrays = {
            name: None if value is None else value.detach().cpu().numpy()
            for name, value in vars(self).items()
        }

        def of(name: str, k: int) -> Any:
            values = arrays[name]
            if values is None:
                return None
            one = values[k]
            is_exact = one.dtype in (np.uint8, np.bool_)
            return one if is_exact else one.astype(np.float32)

        def camera(name: str, k: int) -> Camera:
            K = np.asarray(arrays[name])[k].astype(float)
            height, width = self.depth_prev.shape[1:]
            return Camera(
                K[0, 0], K[1, 1], K[0, 2], K[1, 2], height=height, width=width
            )

        pairs = []
        for k in range(len(self.flow)):
            seen = self.has_images is None or bool(self.has_images[k])
            prev = Frame(
                of("rgb_prev", k) if seen else None,
                of("depth_prev", k),
                camera("K_prev", k),
                depth_variance=of("depth_variance", k),
            )
            curr = Frame(
                of("rgb_curr", k) if seen else None,
                of("depth_curr", k),
                camera("K_curr", k),
            )
            flow = (of("flow", k), of("flow_variance", k), of("valid", k))
            pairs.append(FramePair(prev, curr, *flow))
        return pairs


def _unmasked(pair: FramePair) -> np.ndarray | None:
    """(H, W) bool where the flow of a pair may be used; None: everywhere."""
    mask = pair.prev.mask
    if mask is None or pair.flow_valid is None:
        return pair.flow_valid if mask is None else mask
    return pair.flow_valid & mask


def _pairs_of_one_size(
    pairs: Iterable[FramePair],
) -> tuple[list[FramePair], tuple[int, int]]:
    """The pairs as a list, and their height and width."""
    where = "PairBatch.from_pairs"
    if isinstance(pairs, FramePair) or not isinstance(pairs, Iterable):
        got = type(pairs).__name__
        raise InputError(f"{where}: expected a list of FramePairs, got {got}.")
    pairs = list(pairs)
    for k, pair in enumerate(pairs):
        check_kind(f"{where}, pair {k}", pair, FramePair)
    sizes = {pair.prev.camera.shape for pair in pairs}
    if len(sizes) != 1:
        got = str(sorted(sizes)) if sizes else "no pairs"
        raise InputError(f"{where}: expected pairs of one size, got {got}.")
    return pairs, sizes.pop()


def _device_and_dtype(
    device: torch.device | str | None, dtype: torch.dtype | None
) -> tuple[torch.device, torch.dtype]:
    """The torch device and floating-point type that were named, or the defaults."""
    import torch

    where = "PairBatch.from_pairs"
    named = f"{brief(device)}, {brief(dtype)}"
    try:
        device = torch.empty(0, device=device).device
        if dtype is None:
            dtype = torch.float32
        dtype = torch.empty(0, dtype=dtype).dtype
    except (TypeError, RuntimeError, AssertionError) as error:
        cause = str(error).splitlines()[0][:SHOWN_CHARACTERS]
        raise InputError(
            f"{where}: expected a torch device and dtype, got {named}: {cause}."
        ) from None
    if not dtype.is_floating_point:
        raise InputError(f"{where}: expected a floating dtype, got {dtype}.")
    return device, dtype


def _stack(
    arrays: list[np.ndarray], device: torch.device, dtype: torch.dtype
) -> torch.Tensor:
    """Arrays of one shape as one tensor, with the batch first."""
    import torch

    return torch.as_tensor(np.stack(arrays), device=device).to(dtype)


Stack = Callable[[list[np.ndarray]], "torch.Tensor"]


def _filled(
    arrays: list[np.ndarray | None], lacking: np.ndarray, stack: Stack
) -> torch.Tensor:
    """One tensor of arrays, with ``lacking`` in place of those that are missing."""
    return stack([lacking if array is None else array for array in arrays])


def _optional(
    arrays: list[np.ndarray | None], lacking: np.ndarray, stack: Stack
) -> torch.Tensor | None:
    """The same; None where all are missing."""
    if all(array is None for array in arrays):
        return None
    return _filled(arrays, lacking, stack)
