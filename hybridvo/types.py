"""What goes in: camera, frame, pair and batch, with the checks of what users hand in.

``T_target_source`` maps points of ``source`` into ``target``. Camera axes are x right, y down, z
forward. Pixel (0, 0) is the centre of the top-left pixel. Tangent vectors are (translation,
rotation) of a left perturbation in the current camera.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from hybridvo.checks import as_number, brief, check_kind, to_numpy
from hybridvo.depth_units import depth_unit_fix, typical_depth
from hybridvo.errors import InputError

if TYPE_CHECKING:
    import torch

# largest image, in pixels, that a frame or a file header may declare
MAX_PIXELS = 2**28
# pixels; single precision can hold their inverses and squares
FOCAL_RANGE = (1e-3, 1e9)


@dataclass(frozen=True)
class Camera:
    """A pinhole camera without distortion.

    Pixel (0, 0) is the centre of the top-left pixel; camera axes are x right, y down, z forward.

    Attributes:
        fx: horizontal focal length, pixels of this image.
        fy: vertical focal length, pixels.
        cx: column of the principal point, pixels; about (width - 1) / 2.
        cy: row of the principal point, pixels; about (height - 1) / 2.
        height: rows of the image.
        width: columns of the image.

    Raises:
        InputError: for a size, a focal length or a centre that no such image has.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    height: int
    width: int

    def __post_init__(self) -> None:
        for name in ("height", "width"):
            value = getattr(self, name)
            if isinstance(value, bool) or as_number(value) % 1 != 0 or value <= 0:
                raise InputError(
                    f"Camera.{name}: expected a positive integer, got {value!r}."
                )
            object.__setattr__(self, name, int(value))
        size = f"an image of {self.width}x{self.height}"
        if self.height * self.width > MAX_PIXELS:
            raise InputError(
                f"Camera: {size} pixels is above the limit of {MAX_PIXELS}."
            )
        x_range = (-self.width, 2 * self.width)
        y_range = (-self.height, 2 * self.height)
        limits = {
            "fx": FOCAL_RANGE,
            "fy": FOCAL_RANGE,
            "cx": x_range,
            "cy": y_range,
        }
        for name, (low, high) in limits.items():
            value = getattr(self, name)
            what = "focal length" if name[0] == "f" else "centre"
            if not low <= as_number(value) <= high:
                expected = f"a {what} of {low:g} to {high:g} pixels for {size}"
                raise InputError(
                    f"Camera.{name}: expected {expected}, got {value!r}."
                )
            object.__setattr__(self, name, float(value))

    @classmethod
    def from_matrix(cls, K: np.ndarray, height: int, width: int) -> Camera:
        """Make a camera from an intrinsic matrix (3, 3) without skew."""
        K = to_numpy(K, "Camera")
        is_matrix = (
            K.shape == (3, 3) and K.dtype.kind in "fiu" and np.isfinite(K).all()
        )
        fixed = [[0, 1, 0], [1, 0, 0], [1, 1, 1]]
        if not is_matrix or not np.allclose(K * fixed, np.diag([0, 0, 1])):
            expected = "a finite 3x3 matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]"
            raise InputError(f"Camera: expected {expected}, got {K.tolist()}.")
        return cls(K[0, 0], K[1, 1], K[0, 2], K[1, 2], height, width)

    @property
    def K(self) -> np.ndarray:
        """The intrinsic matrix, (3, 3) float64."""
        return np.array(
            [[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]]
        )

    @property
    def shape(self) -> tuple[int, int]:
        """The height and the width of the image, in this order."""
        return self.height, self.width


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
"""What makes an image the type that is expected."""


def _type_remedy(name: str, array: np.ndarray) -> str:
    """What to do with an image whose type is not the one expected."""
    if name == "rgb" and array.dtype.kind == "f":
        largest = float(np.nanmax(array, initial=0.0))
        if largest > 1.0:
            return "Its values exceed 1: round and convert it, as np.uint8(rgb.round())"
        return "Multiply by 255 and convert it, as np.uint8(255 * rgb)"
    if name == "depth" and array.dtype == np.uint8:
        return "8 bits are a picture of depth: hand over the sensor's own values, in metres"
    if name == "depth" and array.dtype.kind in "iu" and array.size:
        median = typical_depth(array.astype(np.float64))
        advice = "" if median is None else depth_unit_fix(median)
        if advice:
            unit = f"its median is {median:.4g}, so it is no depth in metres"
            return f"Convert it to float32 and {advice}: {unit}"
    return TYPE_REMEDIES.get(name, "Convert it to float32")


def _shape_remedy(name: str, array: np.ndarray, camera: Camera) -> str:
    """What to do with an image whose shape is not the one expected."""
    height, width = camera.shape
    resize = "Resize with hybridvo.resize_frame, which also scales the camera"
    if name == "rgb" and array.shape == (height, width, 4):
        return "Drop the alpha channel, as rgb[..., :3]"
    if name == "rgb" and array.shape == (3, height, width):
        return "Put the channels last, as rgb.transpose(1, 2, 0)"
    if name == "flow":
        if array.shape in ((2, height, width), (1, 2, height, width)):
            first = "flow[0]" if array.ndim == 4 else "flow"
            return f"Permute it to (H, W, 2), as {first}.transpose(1, 2, 0), in torch .permute"
        if array.shape == (1, height, width, 2):
            return "Take the only pair, as flow[0]"
        if array.ndim == 3 and array.shape[2] == 2:
            whole = "Resize it to the image's size and scale its values"
            return f"{whole}, u by the widths' ratio and v by the heights'"
    if array.shape == (width, height, *array.shape[2:]):
        return "Height and width are exchanged: transpose it"
    if array.shape[:2] == (height, width):
        return "Its height and width fit, its number of channels does not"
    return resize


def _take_image(
    owner: Frame | FramePair, camera: Camera, name: str, kind: str, *channels: int
) -> None:
    """Check one image of a frame or pair, if it has it: (H, W) or (H, W, channels) of a kind."""
    value = getattr(owner, name)
    where = f"{type(owner).__name__}.{name}"
    if value is None:
        return
    array = to_numpy(value, where)
    shape = (*camera.shape, *channels)
    if kind not in (array.dtype.kind, array.dtype.str[1:]):
        got = f"{array.dtype} {array.shape}. {_type_remedy(name, array)}"
        raise InputError(f"{where}: expected {ARRAY_KINDS[kind]}, got {got}.")
    if array.ndim == 3 and array.shape[2] == 1:
        array = array[:, :, 0]
    if kind == "u1" and array.ndim == 2:  # grey
        array = np.dstack([array] * 3)
    if array.shape != shape:
        wanted = f"shape {shape} (height, width, ...) as the camera has"
        remedy = _shape_remedy(name, array, camera)
        raise InputError(
            f"{where}: expected {wanted}, got {array.shape}. {remedy}."
        )
    if kind == "f":
        with np.errstate(over="ignore"):  # beyond float32 is inf, which is invalid
            array = array.astype(np.float32, copy=False)
    object.__setattr__(owner, name, array)


@dataclass(frozen=True, eq=False)
class Frame:
    """One RGB-D frame, checked against its camera.

    Attributes:
        rgb: (H, W, 3) uint8, red first, or grey (H, W); None where only depth and flow are used.
        depth: (H, W) floating point, metres along the optical axis z, registered to the image;
            NaN, inf, 0 and negative are invalid. None where there is none.
        camera: the intrinsics, of the same image size.
        timestamp: seconds.
        index: number of the frame; None: the tracker counts.
        depth_variance: (H, W) variance of log depth, that is, relative, or None.
        mask: (H, W) bool; False takes the depth, and so the pixel, away. None: all are used.

    Raises:
        InputError: for an image of another size or type than the camera and this page say.
    """

    rgb: np.ndarray | None
    depth: np.ndarray | None
    camera: Camera
    timestamp: float = 0.0
    index: int = None  # type: ignore[assignment]
    depth_variance: np.ndarray | None = None
    mask: np.ndarray | None = None

    def __post_init__(self) -> None:
        check_kind("Frame.camera", self.camera, Camera)
        _take_image(self, self.camera, "rgb", "u1", 3)
        for name, kind in (("depth", "f"), ("depth_variance", "f"), ("mask", "b")):
            _take_image(self, self.camera, name, kind)
        if self.mask is not None and self.depth is not None:
            masked = np.where(self.mask, self.depth, np.float32(np.nan))
            object.__setattr__(self, "depth", masked)
        stamp = as_number(self.timestamp)
        if not np.isfinite(stamp):
            raise InputError(
                f"Frame.timestamp: expected finite seconds, got {self.timestamp!r}."
            )
        object.__setattr__(self, "timestamp", stamp)
        if self.index is not None:
            if as_number(self.index) % 1:
                raise InputError(
                    f"Frame.index: expected a whole number, got {self.index!r}."
                )
            object.__setattr__(self, "index", int(self.index))


@dataclass(frozen=True, eq=False)
class FramePair:
    """Two frames of one size with the flow between them, which is what every estimator takes.

    Attributes:
        prev: the previous frame.
        curr: the current frame.
        flow: (H, W, 2) floating point, pixels (u, v) from the previous to the current image, on
            the previous grid; NaN where unknown. None where there is none.
        flow_variance: (H, W) px^2 of a component, relative or absolute, or None.
        flow_valid: (H, W) bool, False where the flow is known to be wrong, or None.
        flow_source: file, dis, or the name of a callable.
        flow_is_true: whether it is ground truth: an oracle.
        depth_source: sensor, stereo, file, or true (of a renderer: an oracle).

    Raises:
        InputError: for frames of two sizes, and for flow that does not fit them.
    """

    prev: Frame
    curr: Frame
    flow: np.ndarray | None
    flow_variance: np.ndarray | None = None
    flow_valid: np.ndarray | None = None
    flow_source: str = "unknown"
    flow_is_true: bool = False
    depth_source: str = "unknown"

    def __post_init__(self) -> None:
        check_kind("FramePair.prev", self.prev, Frame)
        check_kind("FramePair.curr", self.curr, Frame)
        camera = self.prev.camera
        if self.curr.camera.shape != camera.shape:
            got = (
                f"the previous {camera.shape}, the current {self.curr.camera.shape}"
            )
            remedy = "Resize with hybridvo.resize_frame"
            raise InputError(
                f"FramePair: expected frames of one size, got {got}. {remedy}."
            )
        _take_image(self, camera, "flow", "f", 2)
        _take_image(self, camera, "flow_variance", "f")
        _take_image(self, camera, "flow_valid", "b")


def check_dense(where: str, tensor: torch.Tensor) -> None:
    """Refuse a tensor without values in memory, and one of 8-bit floats, which cannot compute."""
    if tensor.is_floating_point() and tensor.element_size() == 1:
        raise InputError(f"{where}: expected 16 bits or more, got {tensor.dtype}.")
    if str(tensor.layout) != "torch.strided" or tensor.is_meta:
        got = "one on the meta device" if tensor.is_meta else str(tensor.layout)
        raise InputError(
            f"{where}: expected a dense tensor with values, got {got}."
        )


def _check_intrinsics(K: torch.Tensor, where: str, flow: torch.Tensor) -> None:
    """Check intrinsics (B, 3, 3) for the images of a flow (B, H, W, 2) as a Camera does."""
    if K.shape != (len(flow), 3, 3) or not K.is_floating_point():
        wanted = (
            f"shape ({len(flow)}, 3, 3), floating point, a matrix for each pair"
        )
        raise InputError(
            f"{where}: expected {wanted}, got {tuple(K.shape)} of {K.dtype}."
        )
    for k, one in enumerate(K.detach().double().cpu().numpy()):
        place = f"{where}[{k}]"
        with np.errstate(invalid="ignore"):
            fits = (
                np.isfinite(one).all()
                and (np.abs(one - PINHOLE) <= PINHOLE_TOLERANCE).all()
            )
        if not fits:
            is_turned = np.isfinite(one).all()
            is_turned &= bool((np.abs(one.T - PINHOLE) <= PINHOLE_TOLERANCE).all())
            remedy = "it is transposed" if is_turned else "Camera.K has this form"
            expected = (
                "a finite matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels"
            )
            raise InputError(
                f"{place}: expected {expected}, got {one.tolist()}; {remedy}."
            )
        try:
            Camera(one[0, 0], one[1, 1], one[0, 2], one[1, 2], *flow.shape[1:3])
        except InputError as error:
            raise InputError(f"{place}: {error}") from None


PINHOLE = np.diag([0.0, 0.0, 1.0])
"""Intrinsics of a pinhole camera without focal lengths and centre."""
PINHOLE_TOLERANCE = np.array(
    [[np.inf, 1e-3, np.inf], [1e-3, np.inf, np.inf], [1e-6, 1e-6, 1e-6]]
)
"""How far intrinsics may be from that: 1e-3 px of skew are nothing, and rounding."""


@dataclass(frozen=True, eq=False)
class PairBatch:
    """A batch of B pairs as torch tensors, through which gradients can flow.

    The tensors are dense and on one device; ``hybridvo.refine`` checks their shapes.

    Attributes:
        flow: (B, H, W, 2) px from the previous to the current image, on the previous grid; NaN
            where unknown.
        depth_prev: (B, H, W) metres along z; what is not finite and positive is invalid.
        K_prev: (B, 3, 3) intrinsics of the previous image, px: ``[[fx, 0, cx], [0, fy, cy],
            [0, 0, 1]]``.
        K_curr: (B, 3, 3) intrinsics of the current image.
        depth_curr: (B, H, W) metres on the current grid, or None.
        flow_variance: (B, H, W) px^2 of a component, relative or absolute, or None.
        depth_variance: (B, H, W) of log depth, that is, relative, or None.
        valid: (B, H, W) bool, True where pixels may be used, or None.

    Raises:
        InputError: for what is no dense tensor, and for intrinsics that no pinhole camera has.
    """

    flow: torch.Tensor
    depth_prev: torch.Tensor
    K_prev: torch.Tensor
    K_curr: torch.Tensor
    depth_curr: torch.Tensor | None = None
    flow_variance: torch.Tensor | None = None
    depth_variance: torch.Tensor | None = None
    valid: torch.Tensor | None = None

    def __post_init__(self) -> None:
        import torch

        needed = ("flow", "depth_prev", "K_prev", "K_curr")
        for name, value in vars(self).items():
            if value is None and name not in needed:
                continue
            if not isinstance(value, torch.Tensor):
                remedy = "Numpy pairs go through PairBatch.from_pairs, arrays torch.as_tensor"
                got = f"{type(value).__name__}. {remedy}"
                raise InputError(
                    f"PairBatch.{name}: expected a torch tensor, got {got}."
                )
            check_dense(f"PairBatch.{name}", value)
        if self.flow.ndim != 4 or self.flow.shape[3] != 2 or self.flow.numel() == 0:
            got = str(tuple(self.flow.shape))
            raise InputError(
                f"PairBatch.flow: expected shape (B, H, W, 2), got {got}."
            )
        for name in ("K_prev", "K_curr"):
            _check_intrinsics(getattr(self, name), f"PairBatch.{name}", self.flow)

    @classmethod
    def from_pairs(
        cls,
        pairs: Iterable[FramePair],
        device: torch.device | str | None = None,
        dtype: torch.dtype | None = None,
    ) -> PairBatch:
        """Stack numpy pairs of one size; what a pair lacks becomes NaN, which is invalid.

        Args:
            pairs: FramePairs, as a list or from a generator such as ``iter_pairs``.
            device: of the tensors; None: torch's default.
            dtype: of the floating-point tensors; None: float32.

        Raises:
            InputError: for no pairs, for other things, and for pairs of several sizes.
        """
        import torch

        if isinstance(pairs, FramePair) or not isinstance(pairs, Iterable):
            got = type(pairs).__name__
            raise InputError(
                f"PairBatch.from_pairs: expected a list of FramePairs, got {got}."
            )
        pairs = list(pairs)
        for k, pair in enumerate(pairs):
            check_kind(f"PairBatch.from_pairs, pair {k}", pair, FramePair)
        sizes = {pair.prev.camera.shape for pair in pairs}
        if len(sizes) != 1:
            got = str(sorted(sizes)) if sizes else "no pairs"
            raise InputError(
                f"PairBatch.from_pairs: expected pairs of one size, got {got}."
            )
        size = sizes.pop()
        try:
            device = torch.empty(0, device=device).device
            dtype = (
                torch.float32
                if dtype is None
                else torch.empty(0, dtype=dtype).dtype
            )
        except (TypeError, RuntimeError, AssertionError) as error:
            got = f"{brief(device)}, {brief(dtype)}: {str(error).splitlines()[0][:200]}"
            where = "PairBatch.from_pairs"
            raise InputError(
                f"{where}: expected a torch device and dtype, got {got}."
            ) from None
        if not dtype.is_floating_point:
            raise InputError(
                f"PairBatch.from_pairs: expected a floating dtype, got {dtype}."
            )

        def stack(
            values: list[Any], shape: tuple[int, ...] = (), lacking: float = np.nan
        ) -> Any:
            """One tensor, or None where no pair has a value and no shape asks for one."""
            shape = next(
                (value.shape for value in values if value is not None), shape
            )
            filled = [
                np.full(shape, lacking) if value is None else value
                for value in values
            ]
            array = torch.as_tensor(np.stack(filled), device=device).to(dtype)
            return array if shape else None

        every = np.ones(size, np.bool_)
        valid = [
            every if pair.flow_valid is None else pair.flow_valid for pair in pairs
        ]
        return cls(
            flow=stack([p.flow for p in pairs], (*size, 2)),
            depth_prev=stack([p.prev.depth for p in pairs], size),
            K_prev=stack([p.prev.camera.K for p in pairs]),
            K_curr=stack([p.curr.camera.K for p in pairs]),
            depth_curr=stack([p.curr.depth for p in pairs]),
            # a pair without variances beside one with them has those of a typical pixel
            flow_variance=stack([p.flow_variance for p in pairs], lacking=1.0),
            depth_variance=stack(
                [p.prev.depth_variance for p in pairs], lacking=1.0
            ),
            valid=torch.as_tensor(np.stack(valid), device=device),
        )
