"""What a driver requests of its camera, and the presets of it in ``configs/cameras``."""

from __future__ import annotations

from dataclasses import field
from pathlib import Path
from typing import Any, Literal

from hybridvo.core.errors import FormatError, InputError
from hybridvo.core.files import MAX_YAML_LENGTH, parse_yaml, read_text
from hybridvo.core.options import Count, NonNegative, Positive, option_group

# where no preset states otherwise: every camera that has a driver offers this, and
# two cores keep up with it
LIVE_WIDTH_PX = 640
LIVE_HEIGHT_PX = 480
LIVE_RATE_HZ = 30

PRESET_FOLDERS = (
    Path(__file__).parent / "presets",
    Path(__file__).parents[3] / "configs" / "cameras",
)
"""Where presets lie: in an installed package, and in a clone."""


@option_group
class CameraSettings:
    """What a driver requests of its camera.

    Attributes:
        driver: realsense, oak, orbbec or opencv; ``own`` where hybridvo has no driver.
        width: columns of the image, pixels.
        height: rows of the image, pixels.
        fps: frames a second.
        depth_width: columns of depth before it is registered; by default those of the image.
        depth_height: its rows.
        image: ``color``, or ``infrared``: the left image of a RealSense's stereo pair.
        serial: the serial number, where several cameras are connected.
        intrinsics: fx, fy, cx, cy in pixels, where the camera states none.
        readout_ms: time from the first row of the colour image to the last, where its shutter
            rolls.
        depth_lag_ms: how much later than the colour image the depth map is measured. Of an
            infrared image both times are 0: depth is measured in it.
        min_depth_m: depth below is taken away, metres.
        max_depth_m: depth above is taken away, metres.
        imu: whether the camera's IMU is used, if it has one.
        options: what to set before the first frame, by the SDK's own names.

    Example:
        >>> CameraSettings(driver="realsense", width=848).size
        (848, 480)
    """

    driver: Literal["realsense", "oak", "orbbec", "opencv", "own"] = "own"
    width: Count = LIVE_WIDTH_PX
    height: Count = LIVE_HEIGHT_PX
    fps: Count = LIVE_RATE_HZ
    depth_width: Count | None = None
    depth_height: Count | None = None
    image: Literal["color", "infrared"] = "color"
    serial: str = ""
    intrinsics: tuple[Positive, Positive, float, float] | None = None
    readout_ms: NonNegative = 0.0
    depth_lag_ms: float = 0.0
    min_depth_m: float = 0.0
    max_depth_m: Positive | None = None
    imu: bool = True
    options: dict[str, float] = field(default_factory=dict)

    @property
    def size(self) -> tuple[int, int]:
        """Columns and rows of the image, pixels."""
        return self.width, self.height

    @property
    def depth_size(self) -> tuple[int, int]:
        """Columns and rows of depth as the sensor measures it, pixels."""
        return self.depth_width or self.width, self.depth_height or self.height


def read_preset(name: str | Path) -> CameraSettings:
    """Read a preset.

    Args:
        name: a YAML file, or the name of one in ``configs/cameras``, as ``d435``.

    Returns:
        The settings.

    Raises:
        InputError: there is no such preset, or a value is of no use.
        FormatError: the file is no YAML of settings.

    Example:
        >>> read_preset("kinect_v1").driver
        'opencv'
    """
    path = _preset_file(name)
    content: Any = parse_yaml(read_text(path, MAX_YAML_LENGTH), str(path))
    if not isinstance(content, dict):
        raise FormatError(f"{path}: expected 'key: value' lines, as d435.yaml has.")
    try:
        return CameraSettings(**{str(key): value for key, value in content.items()})
    except (InputError, TypeError) as error:
        raise FormatError(f"{path}: {error}") from None


def preset_names() -> list[str]:
    """Return the names of the presets that hybridvo brings along."""
    files = (path for folder in PRESET_FOLDERS for path in folder.glob("*.yaml"))
    return sorted({path.stem for path in files})


def _preset_file(name: str | Path) -> Path:
    """Return the file of a preset."""
    path = Path(name)
    if path.is_file():
        return path
    for folder in PRESET_FOLDERS:
        known = folder / f"{path.name}.yaml"
        if str(path) == path.name and known.is_file():
            return known
    names = ", ".join(preset_names())
    raise InputError(f"--preset {name}: expected a YAML file or one of {names}.")
