"""Opening a sequence with the reader of its data set, and making pairs of its frames."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Callable, Iterator
from numbers import Integral
from pathlib import Path
from typing import Any

from hybridvo.core.checks import as_number, check_kind
from hybridvo.core.errors import InputError, missing_sequence
from hybridvo.core.options import NETWORK
from hybridvo.core.types import Camera, Frame, FramePair
from hybridvo.io.data import datasets
from hybridvo.io.data.arrays import ArraySequence
from hybridvo.io.data.bags.reader import BagSequence
from hybridvo.io.data.captures.kinect import KinectSequence
from hybridvo.io.data.captures.recorder import RecorderSequence
from hybridvo.io.data.captures.replica import ReplicaSequence
from hybridvo.io.data.captures.scannet import ScanNetSequence, SensSequence
from hybridvo.io.data.captures.transforms import TransformsSequence
from hybridvo.io.data.confined.limits import is_confined
from hybridvo.io.data.confined.sequence import ConfinedSequence
from hybridvo.io.data.folder import FolderSequence
from hybridvo.io.data.foreign import recognised
from hybridvo.io.data.lists import abbreviated, images_elsewhere
from hybridvo.io.data.predicted import PredictedSequence
from hybridvo.io.data.published.kitti_raw import KittiRawSequence
from hybridvo.io.data.published.openloris import OpenLorisSequence
from hybridvo.io.data.published.rgbd_scenes import RgbdScenesSequence
from hybridvo.io.data.published.virtual_kitti import VirtualKittiSequence
from hybridvo.io.data.record3d.reader import Record3dSequence
from hybridvo.io.data.selected import RateSequence, TimedSequence
from hybridvo.io.data.sequence import Sequence
from hybridvo.io.data.stereo_reader import EurocSequence, OwnStereoSequence
from hybridvo.io.data.streams import StreamSequence, check_choices
from hybridvo.io.data.video import StrayScannerSequence, VideoSequence
from hybridvo.io.onnx.depth import DepthNetwork
from hybridvo.io.onnx.mask import MaskNetwork
from hybridvo.io.resolution import resolution_question

READERS: dict[str, type[Sequence]] = {
    "sintel": datasets.SintelSequence,
    "tartanair": datasets.TartanAirSequence,
    "7scenes": datasets.SevenScenesSequence,
    "stereo": OwnStereoSequence,
    "strayscanner": StrayScannerSequence,
    "record3d": Record3dSequence,
    "scannet": ScanNetSequence,
    "sens": SensSequence,
    "replica": ReplicaSequence,
    "recorder": RecorderSequence,
    "kinect": KinectSequence,
    "video": VideoSequence,
    "folder": FolderSequence,
    "kitti": datasets.KittiSequence,
    "kitti-raw": KittiRawSequence,
    "vkitti2": VirtualKittiSequence,
    "openloris": OpenLorisSequence,
    "rgbd-scenes": RgbdScenesSequence,
    "tum": datasets.TumSequence,
    "bag": BagSequence,
    "euroc": EurocSequence,
    "arrays": ArraySequence,
    "transforms": TransformsSequence,
}
"""The readers by kind, in the order in which they are tried on a folder."""
WITHOUT_FOLDERS = ("bag", "arrays", "sens", "record3d", "kinect", "video")
"""Kinds whose recordings are files: a folder beside them is no part of them."""
LOOKED_AT = 200
"""Entries of a folder that is no sequence in which sequences are looked for."""
RECORDINGS = ".bag, .mcap, .db3, .npz, .mkv, .mp4, .r3d, .sens"
"""Endings of the files that are recordings, for a message."""
OWN_DATA = (
    "Own data: hybridvo needs metric depth for each image. Put images into rgb/, depth registered "
    "to them into depth/, and describe the camera with 'hybridvo init DIR' (kind 'folder')."
)


def open_sequence(
    path: str | Path,
    dataset: str | None = None,
    camera: str | Path | Camera | None = None,
    depth_scale: float | None = None,
    mask: str | Path | None = None,
    *,
    topic_rgb: str | None = None,
    topic_depth: str | None = None,
    topic_info: str | None = None,
    topic_truth: str | None = None,
    topic_imu: str | None = None,
    imu_rotation: str | None = None,
    frame: str | None = None,
    depth_dir: str | None = None,
    stereo: float | str | bool | None = None,
    depth: str | None = None,
    readout_ms: float | None = None,
    depth_lag_ms: float | None = None,
    depth_offset_ms: float | None = None,
    fps: float | None = None,
    needs_depth: bool = True,
    trust: bool = False,
) -> Sequence:
    """Open a sequence in the published layout of its data set, or a recording.

    Args:
        path: The folder, or the file of a recording.
        dataset: One of ``READERS``; by default detected from the files.
        camera: Replaces the data set's own: ``fx,fy,cx,cy`` in pixels, a file (``camera.yaml``,
            ROS ``camera_info``, RealSense or Open3D intrinsics, a 3x3 matrix in ``.npy``), or a
            Camera.
        depth_scale: Replaces the data set's own, in stored units per metre.
        mask: A folder of images that are 0 where pixels must not be used; or ``onnx:FILE``, a
            network that finds people.
        topic_rgb: The topic of colour in a bag; by default it is guessed, as the others are.
        topic_depth: That of depth.
        topic_info: That of the camera of colour.
        topic_truth: That of true poses.
        topic_imu: That of the inertial sensor.
        imu_rotation: The unit quaternion ``x,y,z,w`` that turns the axes of the inertial sensor of
            a bag into those of the camera; by default by ``/tf_static``.
        frame: A frame of reference that ``/tf_static`` of a bag connects to the camera, such as
            ``base_link``: ``hybridvo run`` writes its path instead of the camera's.
        depth_dir: The folder of the depth maps of a video; by default ``depth`` beside it.
        stereo: Take depth from two cameras: the baseline, m, of rectified images in ``left`` and
            ``right``; True, or empty, where the sequence states it.
        depth: ``onnx:FILE``: a network predicts depth, also where the sequence has some.
        readout_ms: Replaces the camera's own: ms from the first row to the last, see Camera.
        depth_lag_ms: Replaces the camera's own: by how much depth is later than the image, ms.
        depth_offset_ms: By how much the stamps of depth are late, ms, against those of the images:
            it is subtracted before both are matched.
        fps: Frames a second, in place of the time stamps of the files: for files without any.
        needs_depth: Whether a video, or a folder of images, without depth is refused.
        trust: Whether foreign formats, such as bags and videos, are read in this process instead of
            a child process.

    Returns:
        The frames in order of time. Each is read when it is used.

    Raises:
        InputError: Something cannot be read. The message states what was expected, and the remedy.

    Example:
        >>> from tempfile import TemporaryDirectory
        >>> import numpy as np
        >>> folder = TemporaryDirectory()
        >>> rgb = np.zeros((3, 60, 80, 3), np.uint8)
        >>> depth = np.ones((3, 60, 80), np.float32)
        >>> K = np.array([[80, 0, 39.5], [0, 80, 29.5], [0, 0, 1]])
        >>> np.savez(f"{folder.name}/walk.npz", rgb=rgb, depth=depth, K=K)
        >>> sequence = open_sequence(f"{folder.name}/walk.npz")
        >>> len(sequence), sequence[0].depth.shape
        (3, (60, 80))
        >>> folder.cleanup()
    """
    _check_arguments(path, dataset, camera, depth_scale, mask)
    times = _stated_times(readout_ms, depth_lag_ms)
    _check_rate(fps)
    predict_depth = _depth_network(depth)
    needs_depth = needs_depth and predict_depth is None
    find_people = None
    if isinstance(mask, str) and mask.startswith(NETWORK):
        find_people = MaskNetwork(mask)
        mask = None
    folder = Path(path)
    given = _given(
        topic_rgb=topic_rgb,
        topic_depth=topic_depth,
        topic_info=topic_info,
        topic_truth=topic_truth,
        topic_imu=topic_imu,
        imu_rotation=imu_rotation,
        frame=frame,
        depth_offset_ms=_milliseconds("depth_offset_ms", depth_offset_ms),
        depth_dir=depth_dir,
        stereo=_baseline(stereo),
    )
    try:
        reader = _reader(folder, dataset, "stereo" in given, needs_depth)
        sequence = _opened(
            reader,
            folder.absolute(),
            camera,
            depth_scale,
            mask,
            given,
            needs_depth,
            trust,
        )
    # a file that is missing, a folder that may not be read
    except OSError as error:
        raise InputError(
            f"{str(folder)[:200]}: cannot be read: {str(error)[:200]}."
        ) from None
    sequence = _as_stated(sequence, times, fps)
    return _with_networks(sequence, predict_depth, find_people)


def _as_stated(
    sequence: Sequence, times: dict[str, float], fps: float | None
) -> Sequence:
    """Return a sequence with the times of its camera and the rate that a user states of it."""
    if times:
        sequence = TimedSequence(sequence, times)
    if fps is not None:
        sequence = RateSequence(sequence, float(fps))
    return sequence


def _depth_network(depth: str | None) -> DepthNetwork | None:
    """Return the network that predicts depth; None where none is named."""
    return None if depth is None else DepthNetwork(_network(depth, "depth"))


def _with_networks(
    sequence: Sequence, depth: DepthNetwork | None, people: MaskNetwork | None
) -> Sequence:
    """Return a sequence whose frames go through networks, where there are any."""
    if depth is None and people is None:
        return sequence
    return PredictedSequence(sequence, depth, people)


def _given(**chosen: Any) -> dict[str, Any]:
    """Return what only some recordings need, where it is given; an InputError for other types."""
    for name, value in chosen.items():
        check_kind(f"open_sequence: {name}", value, str, Path, type(None))
    return {name: value for name, value in chosen.items() if value is not None}


def _network(text: Any, name: str) -> str:
    """Return a text that names a network; an InputError for anything else."""
    if isinstance(text, str) and text.startswith(NETWORK):
        return text
    got = f"got {str(text)[:80]!r}"
    raise InputError(f"open_sequence: {name}: expected '{NETWORK}FILE', {got}.")


def _opened(
    reader: type[Sequence],
    folder: Path,
    camera: str | Path | Camera | None,
    depth_scale: float | None,
    mask: str | Path | None,
    given: dict[str, Any],
    needs_depth: bool,
    trust: bool,
) -> Sequence:
    """Open a sequence with what was given for it; an InputError where it does not take that."""
    scale = None if depth_scale is None else float(depth_scale)
    known = reader.choices
    wants_stereo = "stereo" in given
    if "stereo" not in known and given.get("stereo") == "":
        # KITTI's reader finds the right images by itself
        del given["stereo"]
    check_choices(reader.kind, given, known)
    if not trust and is_confined(reader.kind, folder):
        sequence: Sequence = ConfinedSequence(
            reader, folder, camera, scale, mask, needs_depth, given
        )
    elif not needs_depth:
        sequence = reader(folder, camera, scale, mask, needs_depth=False, **given)
    else:
        sequence = reader(folder, camera, scale, mask, **given)
    _ask_about_resolution(sequence)
    if wants_stereo and sequence.depth_source != "stereo":
        raise InputError(
            f"--stereo: {folder} is of kind '{reader.kind}', with depth of its own: expected two "
            "cameras, as left/ and right/."
        )
    return sequence


def _ask_about_resolution(sequence: Sequence) -> None:
    """Add a warning where the intrinsics seem to be those of other images."""
    # a damaged file of a camera is reported with the frame that needs it
    with contextlib.suppress(InputError, OSError):
        if question := resolution_question(sequence.camera(0)):
            sequence.warnings.append(f"{sequence.name}: {question}")


def _baseline(stereo: Any) -> str | None:
    """The baseline as text, empty where the sequence states it; None without stereo."""
    if stereo is None or stereo is False:
        return None
    if stereo is True or stereo == "":
        return ""
    if not as_number(stereo) > 0:
        raise InputError(
            f"stereo: expected the baseline in metres, got {str(stereo)[:80]!r}."
        )
    return str(stereo)


def _check_arguments(
    path: Any, dataset: Any, camera: Any, depth_scale: Any, mask: Any
) -> None:
    """Raise an InputError where an argument of :func:`open_sequence` is of no use."""
    check_kind("open_sequence: path", path, str, Path)
    if mask is not None:
        check_kind("open_sequence: mask", mask, str, Path)
    if camera is not None:
        check_kind("open_sequence: camera", camera, str, Path, Camera)
    if depth_scale is not None and not as_number(depth_scale) > 0:
        got = f"got {str(depth_scale)[:80]!r}"
        raise InputError(f"depth_scale: expected units per metre, {got}.")
    if dataset is None:
        return
    if not isinstance(dataset, str) or dataset not in READERS:
        names = ", ".join(READERS)
        got = str(dataset)[:80]
        raise InputError(f"dataset: '{got}' is unknown; known: {names}. {OWN_DATA}")


def _stated_times(readout_ms: Any, depth_lag_ms: Any) -> dict[str, float]:
    """Return the times of a camera that are stated; an InputError where one is no time."""
    times = {}
    if readout_ms is not None:
        if not 0 <= as_number(readout_ms) < float("inf"):
            got = f"got {str(readout_ms)[:80]!r}"
            raise InputError(f"readout_ms: expected milliseconds from 0 on, {got}.")
        times["readout_ms"] = float(readout_ms)
    if depth_lag_ms is not None:
        times["depth_lag_ms"] = float(
            _milliseconds("depth_lag_ms", depth_lag_ms) or 0
        )
    return times


def _milliseconds(name: str, value: Any) -> str | None:
    """Return a time as text, None where there is none; an InputError where it is no time."""
    if value is None:
        return None
    if not abs(as_number(value)) < float("inf"):
        got = f"got {str(value)[:80]!r}"
        raise InputError(f"{name}: expected milliseconds, {got}.")
    return str(float(value))


def _check_rate(fps: Any) -> None:
    """Raise an InputError where a rate is none."""
    if fps is None or 0 < as_number(fps) < float("inf"):
        return
    got = f"got {str(fps)[:80]!r}"
    raise InputError(f"fps: expected frames a second, more than 0, {got}.")


def _reader(
    folder: Path,
    dataset: str | None,
    is_stereo: bool = False,
    needs_depth: bool = True,
) -> type[Sequence]:
    """Return the reader of a data set, by default the first one that knows the folder."""
    if folder.exists() and not folder.is_dir():
        wanted = READERS if dataset is None else {dataset: READERS[dataset]}
        for reader in wanted.values():
            if issubclass(reader, StreamSequence) and reader.knows(folder):
                return reader
        got = recognised(folder) or f"a file, of no kind in {RECORDINGS}"
        expected = "expected a sequence folder or the file of a recording"
        raise InputError(f"{folder}: {expected}, got {got}.")
    if dataset is not None:
        return READERS[dataset]
    # rectified images need no file beside them where the user states what it would hold
    if is_stereo and (folder / "left").is_dir() and (folder / "right").is_dir():
        return OwnStereoSequence
    if not needs_depth and VideoSequence.knows_without_depth(folder):
        known = (reader for reader in READERS.values() if reader.knows(folder))
        reader = next(known, VideoSequence)
        # which knows every folder with a camera.yaml
        return VideoSequence if reader is FolderSequence else reader
    for reader in READERS.values():
        if reader.knows(folder):
            return reader
    if not folder.is_dir():
        raise InputError(missing_sequence(folder))
    has_depth = not needs_depth or (folder / "depth").is_dir()
    if (folder / "rgb").is_dir() and has_depth:
        return FolderSequence
    raise InputError(f"{folder}: {_why_unknown(folder)}")


def _why_unknown(folder: Path) -> str:
    """Describe a folder that no reader knows, for a message."""
    if description := recognised(folder):
        return f"{description}. {OWN_DATA}"
    entries = sorted(folder.iterdir())
    if inside := _sequences_among(entries):
        others = f" It also holds {abbreviated(inside[1:])}." if inside[1:] else ""
        return f"holds sequences: give one, such as {folder / inside[0]}.{others}"
    if lack := _lack_of(folder):
        return lack
    above = folder.absolute().parent
    layouts = [READERS[kind] for kind in READERS if kind not in WITHOUT_FOLDERS]
    if any(reader.knows(above) for reader in layouts):
        return f"a part of a sequence: give the folder above it, {above}."
    names = [path.name for path in entries]
    content = abbreviated(names) or "nothing"
    where = images_elsewhere(folder, "rgb")
    kinds = ", ".join(kind for kind in READERS if kind != FolderSequence.kind)
    text = f"not a layout that is read ({kinds}). It holds: {content}; {where}."
    return f"{text} {OWN_DATA}"


def _lack_of(folder: Path) -> str:
    """Name the kind of which half of the files are there, and what it lacks; else empty."""
    for kind, reader in READERS.items():
        for names in reader.markers:
            missing = [name for name in names if not _is_there(folder, name)]
            # a folder such as depth/ tells nothing
            tells = any("." in name for name in names if name not in missing)
            if tells and 2 * len(missing) <= len(names):
                return f"of kind '{kind}', without {' and '.join(missing)}."
    return ""


def _is_there(folder: Path, name: str) -> bool:
    """Whether a folder holds a file or folder of a name with wildcards; a pipe is neither."""
    return any(path.is_file() or path.is_dir() for path in folder.glob(name))


def _sequences_among(entries: list[Path]) -> list[str]:
    """Return the names of those files and folders that a reader knows."""
    return [
        path.name
        for path in entries[:LOOKED_AT]
        if any(
            reader.knows(path)
            for reader in READERS.values()
            if path.is_dir() or issubclass(reader, StreamSequence)
        )
    ]


def iter_pairs(
    sequence: Sequence,
    flow: Callable[[Frame, Frame], Any] | None = None,
    *,
    start: int = 0,
    stop: int | None = None,
    stride: int = 1,
) -> Iterator[FramePair]:
    """Yield the consecutive pairs of a sequence; each frame is read once, two are in memory.

    Args:
        sequence: What :func:`open_sequence` returns.
        flow: A callable (prev, curr) such as ``hybridvo.dis_flow()``, which returns a FlowField or
            (H, W, 2) px; by default the sequence's files.
        start: The first frame.
        stop: The frame after the last one; by default all.
        stride: Number of frames between the two of a pair.

    Returns:
        An iterator of pairs, whose flow is None where there is none.

    Raises:
        InputError: An argument is invalid, or there are no flow files.

    Example:
        >>> from tempfile import TemporaryDirectory
        >>> import numpy as np
        >>> from hybridvo.flow.providers import dis_flow
        >>> folder = TemporaryDirectory()
        >>> rgb = np.random.default_rng(0).integers(0, 255, (3, 60, 80, 3), np.uint8)
        >>> depth = np.ones((3, 60, 80), np.float32)
        >>> K = np.array([[80, 0, 39.5], [0, 80, 29.5], [0, 0, 1]])
        >>> np.savez(f"{folder.name}/walk.npz", rgb=rgb, depth=depth, K=K)
        >>> sequence = open_sequence(f"{folder.name}/walk.npz")
        >>> [(pair.prev.index, pair.flow_source) for pair in iter_pairs(sequence, dis_flow())]
        [(0, 'dis'), (1, 'dis')]
        >>> folder.cleanup()
    """
    check_kind("iter_pairs: sequence", sequence, Sequence)
    _check_whole("start", start)
    if stop is not None:
        _check_whole("stop", stop)
    _check_whole("stride", stride)
    if stride < 1 or start < 0:
        raise InputError(
            f"iter_pairs: expected start >= 0 and stride >= 1, got {start}, {stride}."
        )
    if flow is not None and not callable(flow):
        expected = "a callable (prev, curr), such as hybridvo.dis_flow()"
        raise InputError(
            f"iter_pairs: flow: expected {expected}, got {type(flow).__name__}."
        )
    if flow is None:
        from hybridvo.flow.providers import file_flow

        sequence.check_flow(stride)
        flow = file_flow(sequence)
    return _pairs(sequence, flow, range(len(sequence))[start:stop:stride])


def _check_whole(name: str, value: Any) -> None:
    """Raise an InputError where an argument of :func:`iter_pairs` is no whole number."""
    if not isinstance(value, Integral) or isinstance(value, bool):
        got = f"{str(value)[:80]!r}"
        raise InputError(f"iter_pairs: {name}: expected a whole number, got {got}.")


def _pairs(
    sequence: Sequence, flow: Callable[[Frame, Frame], Any], indices: range
) -> Iterator[FramePair]:
    """Read the frames one after the other and join neighbours."""
    # it loads numba, which opening a sequence does without
    from hybridvo.flow.providers import with_flow

    frames = map(sequence.frame, indices)
    for prev, curr in itertools.pairwise(frames):
        pair = FramePair(prev, curr, None, depth_source=sequence.depth_source)
        yield with_flow(pair, flow)
