"""What a network in an ONNX file takes and gives: a YAML file beside it, or a ready one."""

from __future__ import annotations

from dataclasses import field
from pathlib import Path
from typing import Any, Literal, NamedTuple

from hybridvo.core.errors import FormatError, InputError
from hybridvo.core.files import MAX_YAML_LENGTH, parse_yaml, read_text
from hybridvo.core.options import NETWORK, Count, Positive, option_group

DESCRIPTION_FOLDERS = (
    Path(__file__).parent / "presets",
    Path(__file__).parents[3] / "configs" / "onnx",
)
"""Where ready descriptions lie: in an installed package, and in a clone."""
Colour = tuple[float, float, float]
"""A number for each channel, in the order in which the network takes them."""


@option_group
class NetworkDescription:
    """What a network takes and gives.

    Attributes:
        task: depth, flow or mask.
        inputs: names of the image, of flow of both images; by default the file's first ones.
        layout: of an image: ``nchw``, ``nhwc``, or ``nvchw`` with views as a second axis.
        channels: ``rgb`` or ``bgr``.
        size: rows and columns of the image; by default those of the file where they are fixed.
        longest: longer side where the size is free, pixels; by default that of the image.
        multiple_of: each side is rounded to a multiple of this where the size is free.
        fit: ``stretch`` to the size, or ``pad``: keep the shape and fill with ``padding``.
        padding: grey levels, in the order of ``channels``.
        mean: subtracted from the image, grey levels from 0 to 255.
        std: by which the image is divided then.
        constants: further inputs that are numbers.
        intrinsics_input: name of an input that takes the camera's 3x3 matrix.
        output: name of the map; by default the first output.
        output_layout: of the map: ``nchw`` or ``nhwc``.
        channel: of the map, that is depth; of a point map 2.
        unit: of depth: ``metres``, ``millimetres``, or ``inverse``: 1 / metres.
        canonical_focal: focal length, px, for which depth is given; it is multiplied by the focal
            length of the resized image over this one.
        factor_output: names of an output by which depth is multiplied; the first that is there.
        recover_shift: whether a point map has an unknown shift along z, which the focal length
            determines.
        valid_output: name of an output that marks where depth is valid.
        valid_above: depth is valid where this output exceeds it.
        valid_below: depth is valid where it is below; replaces ``valid_above``.
        max_depth_m: depth beyond is left out, metres.
        flow_scale: factor on the flow, which is pixels of the resized image then.
        both_directions: whether flow is computed backward as well, which gives its variance.
        classes: channels of the mask that are people.
        threshold: of a mask of one channel.
        file: where the file comes from.
        licence: its licence.
        note: what to expect.

    Example:
        >>> NetworkDescription(task="depth", unit="inverse").channels
        'rgb'
    """

    task: Literal["depth", "flow", "mask"]
    inputs: tuple[str, ...] = ()
    layout: Literal["nchw", "nhwc", "nvchw"] = "nchw"
    channels: Literal["rgb", "bgr"] = "rgb"
    size: tuple[Count, Count] | None = None
    longest: Count | None = None
    multiple_of: Count = 1
    fit: Literal["stretch", "pad"] = "stretch"
    padding: Colour = (0.0, 0.0, 0.0)
    mean: Colour = (0.0, 0.0, 0.0)
    std: tuple[Positive, Positive, Positive] = (1.0, 1.0, 1.0)
    constants: dict[str, float] = field(default_factory=dict)
    intrinsics_input: str = ""
    output: str = ""
    output_layout: Literal["nchw", "nhwc"] = "nchw"
    channel: int = 0
    unit: Literal["metres", "millimetres", "inverse"] = "metres"
    canonical_focal: Positive | None = None
    factor_output: tuple[str, ...] = ()
    recover_shift: bool = False
    valid_output: str = ""
    valid_above: float = 0.5
    valid_below: float | None = None
    max_depth_m: Positive | None = None
    flow_scale: Positive = 1.0
    both_directions: bool = True
    classes: tuple[int, ...] = (1,)
    threshold: float = 0.5
    file: str = ""
    licence: str = ""
    note: str = ""


class NetworkFiles(NamedTuple):
    """A network and what describes it."""

    model: Path
    description: Path


def read_description(path: str | Path, task: str) -> NetworkDescription:
    """Read the description of a network.

    Args:
        path: a YAML file.
        task: depth, flow or mask, for which it must be.

    Returns:
        The description.

    Raises:
        FormatError: the file is no description.
        InputError: it is that of another task.

    Example:
        >>> path = DESCRIPTION_FOLDERS[1] / "neuflow_v2.yaml"
        >>> read_description(path, "flow").std  # doctest: +SKIP
        (255.0, 255.0, 255.0)
    """
    content: Any = parse_yaml(read_text(path, MAX_YAML_LENGTH), str(path))
    if not isinstance(content, dict):
        raise FormatError(f"{path}: expected 'key: value' lines, as 'task: depth'.")
    try:
        found = NetworkDescription(
            **{str(k): value for k, value in content.items()}
        )
    except (InputError, TypeError) as error:
        raise FormatError(f"{path}: {error}") from None
    if found.task != task:
        raise InputError(
            f"{path}: describes a network for {found.task}: expected one for {task}."
        )
    return found


def description_names() -> list[str]:
    """Return the names of the descriptions that hybridvo brings along."""
    folders = DESCRIPTION_FOLDERS
    files = (path for folder in folders for path in folder.glob("*.yaml"))
    return sorted({path.stem for path in files})


def find_network(text: str, option: str) -> NetworkFiles:
    """Find the files that a text names.

    Args:
        text: ``onnx:FILE``, with ``@NAME`` or ``@YAML`` for a description that does not lie
            beside the network.
        option: what the user gave it to, for messages.

    Returns:
        The ONNX file, and its description: the one that is named, ``model.yaml`` beside
        ``model.onnx``, or the ready one of the same name.

    Raises:
        InputError: one of them is not there.

    Example:
        >>> find_network("onnx:no.onnx", "--depth")
        Traceback (most recent call last):
        hybridvo.core.errors.InputError: --depth onnx:no.onnx: expected an ONNX file, got no \
such file.
    """
    name, _, described = text.removeprefix(NETWORK).partition("@")
    model = Path(name)
    if not model.is_file():
        raise InputError(
            f"{option} {text}: expected an ONNX file, got no such file."
        )
    beside = model.with_suffix(".yaml")
    if not described and beside.is_file():
        return NetworkFiles(model, beside)
    if described and Path(described).is_file():
        return NetworkFiles(model, Path(described))
    wanted = described or model.stem
    for folder in DESCRIPTION_FOLDERS:
        ready = folder / f"{wanted}.yaml"
        if wanted == Path(wanted).name and ready.is_file():
            return NetworkFiles(model, ready)
    names = ", ".join(description_names())
    raise InputError(
        f"{option} {text}: no description of the network: expected {beside.name} beside it, or "
        f"onnx:FILE@NAME with a YAML file or one of {names}."
    )
