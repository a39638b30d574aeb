"""What the attacks had left open, one test for each that is closed by now.

What was tried, and what is left, is in docs/attack.md.
"""

from __future__ import annotations

import json
import os
import re
import runpy
import subprocess
import sys
import warnings
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import psutil
import pytest
import torch
from hybridvo.data.file_sequence import to_seconds

from hybridvo.checks import stamp_unit
from hybridvo.cli import main
from hybridvo.data.sequence import open_sequence
from hybridvo.data.workflow import PaperOptions
from hybridvo.errors import CheckpointError, InputError, OutputError
from hybridvo.evaluation import metrics
from hybridvo.geometry import ego_flow, invert, se3_exp
from hybridvo.network.judge import JudgeOptions
from hybridvo.network.weights import pretrained
from hybridvo.odometry import Odometry
from hybridvo.pose.selection import SELECTION_METHODS, select
from hybridvo.quiet_import import quiet_import
from hybridvo.run_folder import RunFolder
from hybridvo.training import stream
from hybridvo.training.judge_loop import JudgeTrainer, JudgeTrainingOptions
from hybridvo.training.outputs import check_export
from hybridvo.trajectory import Trajectory, read_trajectory, write_tum
from hybridvo.types import Camera, Frame, PixelwisePrediction
from tests.sequences import write_folder

ROOT = Path(__file__).resolve().parents[2]

# select


def prediction(**changed: object) -> PixelwisePrediction:
    maps = torch.zeros(1, 3, 8, 16)
    names = ("rotation", "translation", "log_scale_rotation", "log_scale_translation")
    return PixelwisePrediction(**{name: changed.get(name, maps) for name in names})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("rotation", None, "expected rotation as a torch tensor, got NoneType"),
        ("rotation", torch.zeros(1, 3, 8, 16).numpy(), "rotation as a torch tensor, got ndarray"),
        ("translation", None, "expected translation as a torch tensor, got NoneType"),
        ("translation", torch.zeros(1, 3, 8, 16, dtype=torch.int64), "got torch.int64"),
        ("translation", torch.zeros(1, 3, 8, 16, dtype=torch.complex64), "got torch.complex64"),
        ("log_scale_rotation", torch.zeros(1, 3, 8, 16, dtype=torch.bool), "got torch.bool"),
        ("log_scale_rotation", "softmax", "as a torch tensor, got str"),
        ("log_scale_translation", torch.zeros(1, 3, 8, 16, device="meta"), "on cpu .* got meta"),
        ("log_scale_translation", torch.zeros(1, 3, 8, 16).to_sparse(), "a dense tensor"),
        ("log_scale_translation", torch.zeros(2, 3, 8, 16), r"of \(1, 3, 8, 16\), got \(2, 3"),
    ],
)
def test_select_refuses_maps_of_another_kind(name: str, value: object, message: str) -> None:
    with pytest.raises(InputError, match=message):
        select(prediction(**{name: value}))


@pytest.mark.parametrize("what", [None, "softmax", (torch.zeros(1, 3), torch.zeros(1, 3)), {}])
def test_select_refuses_what_is_no_prediction(what: object) -> None:
    with pytest.raises(InputError, match="expected a PixelwisePrediction, got"):
        select(what)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"method": ["softmax"]}, "method .* unknown"),
        ({"method": torch.zeros(2)}, "method .* unknown"),
        ({"joint": torch.zeros(2)}, "joint to be True or False"),
        ({"joint": "no"}, "joint to be True or False"),
        ({"patch": 8.0}, "at least 1 cell"),
    ],
)
def test_select_refuses_options_of_another_kind(options: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        select(prediction(), **options)


@pytest.mark.parametrize("method", SELECTION_METHODS)
def test_a_patch_larger_than_the_map_is_the_map(method: str) -> None:
    """A side of 10^9 asked for 10^18 cells of padding."""
    maps = torch.randn(2, 3, 8, 16, generator=torch.Generator().manual_seed(0))
    drawn = PixelwisePrediction(maps, maps + 1, -maps, maps.flip(3))
    for got, expected in zip(select(drawn, method, 10**9), select(drawn, method, 16), strict=True):
        assert torch.equal(got, expected)


def test_select_takes_maps_of_several_real_types() -> None:
    """As they come out of a network under autocast, with scales in single precision."""
    half = torch.ones(1, 3, 8, 16, dtype=torch.bfloat16)
    rotation, translation = select(prediction(rotation=half, translation=2 * half))
    assert rotation.tolist() == [[1.0] * 3]
    assert translation.tolist() == [[2.0] * 3]


# surroundings


def in_a_fresh_process(
    code: str, *words: object, flags: tuple[str, ...] = (), **environment: str
) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, *flags, "-c", code, *map(str, words)],
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
        cwd=ROOT,
        env=os.environ | {"OMP_NUM_THREADS": "1"} | environment,
    )


ASK_EVERY_DOOR = """
import contextlib, io, runpy, sys
from hybridvo.cli import main
folder = sys.argv[1]
tool = lambda name: runpy.run_path(f"tools/{name}.py")["main"]
for door, words in (
    (main, ["run", "--sequence", folder]),
    (main, ["demo", "--out", folder, "--frames", "3"]),
    (tool("train"), ["--config", "configs/train_pwvo.yaml", "--out", folder, "--steps", "1"]),
    (tool("generate_dataset"), ["--out", folder, "--frames", "3"]),
    (tool("train_judge"), ["make", "--data", folder, "--first-seed", "0", "--seeds", "1"]),
):
    with contextlib.redirect_stderr(io.StringIO()) as said:
        code = door(words)
    print(code, said.getvalue().strip())
import hybridvo
for name in ("Odometry", "estimate"):
    try:
        getattr(hybridvo, name)
    except hybridvo.HybridVOError as error:
        print(2, f"{name}: {error}")
main(["doctor"])
"""


@pytest.mark.parametrize("threads", ["0", "many", "1000000"])
def test_numbas_threads_are_refused_in_words(tmp_path: Path, threads: str) -> None:
    """Numba: a ValueError, a warning that holds a traceback, the end of the process."""
    done = in_a_fresh_process(ASK_EVERY_DOOR, tmp_path / "out", NUMBA_NUM_THREADS=threads)
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stdout + done.stderr
    *doors, ready = done.stdout.strip().splitlines()
    answers = [line for line in doors if line.startswith("2 ")]
    assert len(answers) == 7
    told = (
        f"NUMBA_NUM_THREADS (environment): expected a whole number from 1 to 4096, got '{threads}'"
    )
    assert all(told in line and "Unset it" in line for line in answers)
    assert any(line.startswith("note") and told in line for line in doors)
    assert ready == "NOT ready: see above"
    assert not (tmp_path / "out").exists()


def test_the_first_name_that_is_asked_for_may_be_refine() -> None:
    code = "import hybridvo as hvo\ntry: hvo.refine\nexcept hvo.HybridVOError as e: print(e)"
    done = in_a_fresh_process(code, NUMBA_NUM_THREADS="0")
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("NUMBA_NUM_THREADS (environment): expected")


# training


def configuration(folder: Path, **changes: object) -> Path:
    (folder / "data_paper.yaml").write_text("preset: paper\nheight: 32\nwidth: 64\n")
    options = {
        "network": {"width": 0.1, "head_stride": 2},
        "data": ["data_paper.yaml"],
        "data_weights": [1.0],
        "steps": 1,
        "batch_size": 2,
        "log_every": 1,
    }
    path = folder / "train.yaml"
    path.write_text(json.dumps(options | changes))
    return path


class Training:
    """``tools/train.py`` on a tiny network, and what it says."""

    def __init__(self, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
        self.tool = runpy.run_path(str(ROOT / "tools" / "train.py"))["main"]
        self.config, self.out, self.capsys = configuration(folder), folder / "run", capsys

    def __call__(self, *words: object) -> tuple[int, str]:
        common = ["--config", self.config, "--out", self.out, "--export-count", "1"]
        code = self.tool([str(word) for word in [*common, *words]])
        return code, self.capsys.readouterr().err


@pytest.fixture
def train(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Iterator[Training]:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # on a busy machine two wait for each other, for seconds
    yield Training(tmp_path, capsys)
    torch.set_num_threads(threads)


def test_a_batch_larger_than_the_memory_is_refused(train: Training) -> None:
    """It was drawn, sample by sample, until the memory ended."""
    code, said = train("--batch-size", 10**9)
    assert code == 2
    assert "batch_size: 1000000000 samples of" in said and "of memory are free" in said
    assert not train.out.exists()


def test_a_batch_that_fits_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two copies of 128 x 256 pixels of nine floats and a flag: 2.4 MB a sample at most."""
    mixture = stream.Mixture((PaperOptions(),), (1.0,))
    monkeypatch.setattr(stream, "available_bytes", lambda: 10**9)
    stream.check_batch_fits(mixture, 10**9 // 2_430_000)
    with pytest.raises(InputError, match=r"need 2.\d\d GB .* 1 GB of memory are free"):
        stream.check_batch_fits(mixture, 1000)
    monkeypatch.setattr(stream, "available_bytes", lambda: None)  # who does not know lets it be
    stream.check_batch_fits(mixture, 10**12)


def test_the_free_memory_is_known_here() -> None:
    have = stream.available_bytes()
    assert have is not None
    assert 10**7 < have <= psutil.virtual_memory().total


@pytest.mark.parametrize("name", ["checkpoint.pt", "options.json", "log.jsonl"])
@pytest.mark.parametrize("words", [(), ("--overwrite",)])
def test_a_training_replaces_nobody_elses_file(
    train: Training, name: str, words: tuple[str, ...]
) -> None:
    train.out.mkdir()
    (train.out / name).write_text('{"jogging": "5 km"}')
    code, said = train(*words)
    assert code == 2
    assert f"holds {name}, and no options.json that says a training wrote it" in said
    assert [path.name for path in train.out.iterdir()] == [name]
    assert (train.out / name).read_text() == '{"jogging": "5 km"}'


def test_a_training_replaces_its_own_files(train: Training) -> None:
    assert train()[0] == 0
    first = (train.out / "checkpoint.pt").read_bytes()
    assert train("--seed", 3, "--overwrite")[0] == 0
    assert (train.out / "checkpoint.pt").read_bytes() != first
    # one that was killed before its first checkpoint, or while it wrote its record
    (train.out / "checkpoint.pt").unlink()
    (train.out / "options.json").write_text('{"command": ')
    assert train()[0] == 0
    # a checkpoint alone, as the library leaves it
    (train.out / "options.json").unlink()
    assert train("--overwrite")[0] == 0
    assert json.loads((train.out / "options.json").read_text())["options"]["steps"] == 1


@pytest.mark.parametrize("name", ["thesis.safetensors", "thesis.json"])
def test_an_export_replaces_nobody_elses_file(train: Training, tmp_path: Path, name: str) -> None:
    """Said before the training, and neither does --overwrite, which is there to start anew."""
    (tmp_path / name).write_text('{"chapter": 1}')
    for words in ((), ("--overwrite",), ("--no-train",)):
        code, said = train("--export", tmp_path / "thesis.safetensors", *words)
        assert code == 2
        assert f"{name} is there already, and no training wrote it: not replaced" in said
    assert (tmp_path / name).read_text() == '{"chapter": 1}'
    assert not train.out.exists()


def test_an_export_replaces_an_export(train: Training, tmp_path: Path) -> None:
    """The command that was started again goes on and exports again, as docs/training.md says."""
    weights = tmp_path / "new" / "w.safetensors"
    assert train("--export", weights)[0] == 0
    first = weights.read_bytes()
    assert train("--export", weights, "--steps", "2")[0] == 0
    assert weights.read_bytes() != first
    assert train("--export", weights, "--no-train", "--overwrite")[0] == 0


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("run/checkpoint.pt", "is a file of the training itself"),
        ("run/options.safetensors", "options.json is a file of the training itself"),
        ("run/../run/log.jsonl", "is a file of the training itself"),
        ("w.json", "that of its model card"),
        ("", "got a folder"),
        ("train.yaml/w.safetensors", "is a file, expected a folder or a new name"),
    ],
)
def test_an_export_needs_a_name_of_its_own(
    train: Training, tmp_path: Path, name: str, message: str
) -> None:
    code, said = train("--export", tmp_path / name)
    assert code == (5 if "new name" in message else 2)
    assert message in said
    assert not train.out.exists() or not list(train.out.iterdir())


def test_a_resumed_training_keeps_its_seed(train: Training) -> None:
    assert train("--seed", 5)[0] == 0
    before = (train.out / "checkpoint.pt").read_bytes()
    for words in ((), ("--seed", 6), ("--no-train", "--export", train.out / "w.safetensors")):
        code, said = train(*words)
        assert code == 2
        asked = words[1] if "--seed" in words else 0
        assert f"was trained with seed 5, this run asks for seed {asked}" in said
    assert (train.out / "checkpoint.pt").read_bytes() == before
    assert train("--seed", 5, "--steps", 2)[0] == 0


def test_a_judge_replaces_nobody_elses_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tool = runpy.run_path(str(ROOT / "tools" / "train_judge.py"))["main"]
    out, data = tmp_path / "run", tmp_path / "data"
    out.mkdir()
    data.mkdir()
    # a folder of `hybridvo run`, whose state the record of the training would have replaced
    (out / "run.json").write_text('{"identity": {}, "state": "done"}')
    common = ["--out", str(out)]
    assert tool(["train", "--data", str(data), *common, "--time-limit", "1"]) == 2
    assert "no run.json that says a training wrote it" in capsys.readouterr().err
    assert (out / "run.json").read_text() == '{"identity": {}, "state": "done"}'
    (tmp_path / "mine.safetensors").write_text("mine")
    words = ["export", *common, "--held-out", str(data), "--export"]
    assert tool([*words, str(tmp_path / "mine.safetensors")]) == 2
    assert "no training wrote it: not replaced" in capsys.readouterr().err
    # the weights and the card in the package are those of a training
    check_export(pretrained("judge"), out, "run.json")
    check_export(pretrained("pwvo"), out, "options.json")


def test_a_resumed_judge_keeps_its_seed(tmp_path: Path) -> None:
    network = JudgeOptions(width=0.25)
    JudgeTrainer(JudgeTrainingOptions(network, seed=4), tmp_path, tmp_path).save()
    with pytest.raises(CheckpointError, match="was trained with seed 4, this run asks for seed 0"):
        JudgeTrainer(JudgeTrainingOptions(network), tmp_path, tmp_path).resume()
    assert JudgeTrainer(JudgeTrainingOptions(network, seed=4), tmp_path, tmp_path).resume()


# evaluate


def walk(stamps: np.ndarray, seed: int = 0, noise: float = 0.0) -> Trajectory:
    """A path that bends in all directions, one pose a stamp."""
    rng = np.random.default_rng(seed)
    t = np.linspace(0.0, 20.0, len(stamps))
    tangents = np.stack([np.sin(0.3 * t), t, np.cos(0.7 * t), *(0.5 * np.sin([t, 2 * t, 3 * t]))])
    steps = noise * rng.standard_normal((len(stamps), 6))
    T = [se3_exp(a) @ se3_exp(b) for a, b in zip(tangents.T, steps, strict=True)]
    return Trajectory(stamps, np.stack(T))


def test_evaluate_says_that_nothing_could_be_matched(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Not one figure is none of the things that exit code 0 promises."""
    stamps = np.arange(20) / 10
    write_tum(walk(stamps), tmp_path / "a")
    write_tum(walk(stamps + 5000), tmp_path / "b")
    assert main(["evaluate", str(tmp_path / "a"), str(tmp_path / "b"), "--json"]) == 2
    said = capsys.readouterr()
    assert json.loads(said.out)["matched"] == 0
    assert said.err.count("\n") == 1
    assert "nothing could be compared: only 0 of 20 poses match within 0.02 s" in said.err
    # a camera on a straight line leaves the alignment open; other figures stand
    straight = np.tile(np.eye(4), (20, 1, 1))
    straight[:, 0, 3] = stamps
    write_tum(Trajectory(stamps, straight), tmp_path / "c")
    assert main(["evaluate", str(tmp_path / "c"), str(tmp_path / "c"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["ate_rmse"] is None


@pytest.mark.parametrize("delta", [1, 7])
@pytest.mark.parametrize("noise", [1e-9, 1e-3, 1.0])
def test_angles_of_all_pairs_at_once_are_evos(delta: int, noise: float) -> None:
    from evo.core.metrics import RPE, PoseRelation, Unit

    stamps = np.arange(60) / 10
    est, gt = walk(stamps, 1, noise), walk(stamps)
    match = metrics.associate(est, gt)
    metric = RPE(PoseRelation.rotation_angle_deg, delta, Unit.frames, all_pairs=True)
    paths = [metrics._to_evo(t, i) for t, i in ((gt, match.gt_indices), (est, match.est_indices))]
    metric.process_data(tuple(paths))
    errors = np.asarray(metric.error)
    found = metrics.rpe(est, gt, delta)
    # the same formula on the same numbers: rounding of sums, and of angles near 1e-14 deg
    assert found.pairs == len(errors) == 60 - delta
    for value, expected in (
        (found.rot_rmse_deg, np.sqrt(np.mean(errors**2))),
        (found.rot_mean_deg, errors.mean()),
        (found.rot_median_deg, np.median(errors)),
    ):
        assert value == pytest.approx(expected, rel=1e-12, abs=1e-13)


# output folders and stamps


@pytest.mark.parametrize("below", ["", "deeper/still"])
def test_an_output_folder_that_is_a_link_to_nowhere(tmp_path: Path, below: str) -> None:
    """'File exists' was all that was said."""
    (tmp_path / "link").symlink_to(tmp_path / "gone")
    with pytest.raises(OutputError) as caught:
        RunFolder(tmp_path / "link" / below, {}, {})
    assert f"{tmp_path / 'link'} is a symbolic link to {tmp_path / 'gone'}" in str(caught.value)
    assert "which leads nowhere. Make that folder, or remove the link." in str(caught.value)
    assert not (tmp_path / "gone").exists()
    (tmp_path / "gone").mkdir()  # as the message says
    RunFolder(tmp_path / "link" / below, {}, {}).close()
    assert (tmp_path / "gone" / below / "run.json").is_file()


def test_every_door_names_the_link(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    link = tmp_path / "link"
    link.symlink_to("gone")
    (tmp_path / "file").write_text("mine")
    tool = runpy.run_path(str(ROOT / "tools" / "train.py"))["main"]
    for call in (
        lambda out: main(["demo", "--frames", "3", "--out", out]),
        lambda out: tool(["--config", str(configuration(tmp_path)), "--out", out]),
    ):
        assert call(str(link)) == 5
        assert f"{link} is a symbolic link to gone, which leads nowhere" in capsys.readouterr().err
        assert call(str(tmp_path / "file" / "out")) == 5
        assert "file is a file, expected a folder or a new name" in capsys.readouterr().err


EPOCH = {"milliseconds": 1e3, "microseconds": 1e6, "nanoseconds": 1e9}


@pytest.mark.parametrize("start", [1_000_000_001.0, 1_763_000_000.0, 4_102_444_800.0])
@pytest.mark.parametrize("unit", EPOCH)
def test_the_unit_of_todays_stamps_is_told(
    tmp_path: Path, unit: str, start: float, caplog: pytest.LogCaptureFixture
) -> None:
    seconds = start + np.arange(9) / 25
    stamps = np.round(seconds * EPOCH[unit])
    assert stamp_unit(stamps) == (EPOCH[unit], unit)
    (tmp_path / "t").write_text("".join(f"{int(s)} 0 0 0 0 0 0 1\n" for s in stamps))
    read = read_trajectory(tmp_path / "t")
    assert unit in read.notices[0]
    np.testing.assert_allclose(read.timestamps, seconds, rtol=0, atol=1e-6)
    listed, notices = to_seconds(stamps, "rgb.txt")
    assert unit in notices[0]
    np.testing.assert_allclose(listed, seconds, rtol=0, atol=1e-6)
    assert stamp_unit(np.append(stamps, np.nan)) == (EPOCH[unit], unit)


@pytest.mark.parametrize(
    ("stamps", "unit"),
    [
        (1.7e15 + 4e7 * np.arange(9), "nanoseconds"),  # 20 days after the start, 25 pictures a s
        (1.7e15 + 2e6 * np.arange(9), "nanoseconds"),  # either: 500 a second, or one in 2 s
        (np.array([1.7e15]), "nanoseconds"),  # one alone tells nothing
        (2e14 + 4e4 * np.arange(9), "nanoseconds"),  # microseconds of 1976 are no clock's
        (1.7e12 + 4e7 * np.arange(9), "seconds"),  # nanoseconds half an hour after the start
        (1.7e12 + 4e4 * np.arange(9), "seconds"),  # microseconds after 20 days
        (1.7e9 + np.arange(9) / 25, "seconds"),
        (1.7e9 + 86400.0 * np.arange(9), "seconds"),
        (np.arange(9.0), "seconds"),
        (np.array([np.nan, np.inf]), "seconds"),
        (np.zeros(0), "seconds"),
    ],
)
def test_a_unit_that_cannot_be_told_stays(stamps: np.ndarray, unit: str) -> None:
    assert stamp_unit(stamps)[1] == unit


def test_pictures_named_by_microseconds_have_stamps(tmp_path: Path) -> None:
    written = write_folder(tmp_path)
    camera = written.path / "camera.yaml"
    camera.write_text(re.sub("fps:.*", "", camera.read_text()))
    (written.path / "poses.txt").unlink()
    for i, path in enumerate(sorted((written.path / "rgb").iterdir())):
        depth = next((written.path / "depth").glob(f"{path.stem}.*"))
        for old in (path, depth):
            old.rename(old.with_stem(str(1_763_000_000_000_000 + 40_000 * i)))
    sequence = open_sequence(written.path)
    expected = 1_763_000_000 + 0.04 * np.arange(len(sequence))
    np.testing.assert_allclose(sequence.timestamps, expected, rtol=0, atol=1e-6)


# torch's settings, and what others warn of

ASK_THE_NETWORK = """
import sys, warnings
import numpy as np, torch
torch.set_default_device(sys.argv[1])
import hybridvo as hvo
from hybridvo.geometry import ego_flow, se3_exp
from hybridvo.learned import estimate_learned, propose_motion, shipped_network
camera = hvo.Camera(80.0, 80.0, 47.5, 35.5, 72, 96)
v, u = np.mgrid[:72, :96]
depth = (3 + np.sin(u / 9) + np.cos(v / 7)).astype(np.float32)
T = se3_exp(np.array([0.02, -0.01, 0.03, 0.004, -0.006, 0.002]))
flow = ego_flow(depth, T, camera, camera).astype(np.float32)
pair = hvo.FramePair(hvo.Frame(None, depth, camera), hvo.Frame(None, depth, camera), flow)
before = list(warnings.filters)
network = shipped_network("pwvo")
for found in (propose_motion(network, pair), estimate_learned(pair, "pwvo"), hvo.estimate(pair)):
    print(repr(found.T_curr_prev.tolist()))
assert "pypose" in sys.modules
new = [f for f in warnings.filters if f not in before]
assert all(f in warnings.filters for f in before)
assert all(f[2].__module__.startswith("sympy") for f in new), new  # which torch loads
assert torch.get_default_device().type == sys.argv[1]
"""


def test_another_default_device_and_warnings_as_errors_change_nothing() -> None:
    """Torch: no data in a meta tensor; pypose: torch.jit.script is deprecated."""
    plain = in_a_fresh_process(ASK_THE_NETWORK, "cpu", flags=("-W", "default"))
    strict = in_a_fresh_process(ASK_THE_NETWORK, "meta", flags=("-W", "error"))
    assert plain.returncode == strict.returncode == 0, plain.stderr + strict.stderr
    assert strict.stderr == "" and "jit" not in plain.stderr
    assert strict.stdout == plain.stdout and plain.stdout.count("\n") == 3


def test_a_batch_is_the_first_thing_that_is_refined_under_warnings_as_errors() -> None:
    """No network and no tracker before it, which would have loaded pypose already."""
    code = """
import torch, hybridvo as hvo
K = torch.tensor([[[80.0, 0, 47.5], [0, 80, 35.5], [0, 0, 1]]])
depth = 3 + torch.linspace(0, 2, 72 * 96).reshape(1, 72, 96).sin()
found = hvo.refine(hvo.PairBatch(torch.zeros(1, 72, 96, 2), depth, K, K))
print((found.T_curr_prev - torch.eye(4)).abs().max().item())
"""
    done = in_a_fresh_process(code, flags=("-W", "error"))
    assert done.returncode == 0 and done.stderr == "", done.stderr
    assert float(done.stdout) < 1e-6


def test_a_quiet_import_shields_only_its_own_warnings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From many threads at once; what is no deprecation is heard as before."""
    names = [f"warns_of_{kind}" for kind in ("DeprecationWarning", "FutureWarning")]
    for name in (*names, "warns_of_UserWarning"):
        kind = name.removeprefix("warns_of_")
        (tmp_path / f"{name}.py").write_text(
            f"import time, warnings\nwarnings.warn('old', {kind})\ntime.sleep(0.05)\nready = 1\n"
        )
    monkeypatch.syspath_prepend(tmp_path)
    before = list(warnings.filters)
    with ThreadPoolExecutor(8) as pool:
        modules = list(pool.map(quiet_import, 8 * names))
    assert all(module.ready for module in modules)
    assert warnings.filters == before
    with pytest.warns(UserWarning, match="old"):
        quiet_import("warns_of_UserWarning")
    with pytest.raises(ImportError):
        quiet_import("nowhere_to_be_found")
    with pytest.warns(DeprecationWarning):
        warnings.warn("new", DeprecationWarning, stacklevel=1)
    for name in (*names, "warns_of_UserWarning"):
        sys.modules.pop(name)


# the tracker


def test_after_a_skipped_frame_a_flow_leads_from_the_last_tracked_one() -> None:
    """Which frame a flow must lead from is what the anchor and the provider's arguments say."""
    camera = Camera(40.0, 40.0, 15.5, 11.5, 24, 32)
    v, u = np.mgrid[:24, :32]
    depth = (3 + np.sin(u / 5) + np.cos(v / 4)).astype(np.float32)
    frames = [Frame(None, depth, camera, timestamp=0.1 * i, index=i) for i in range(4)]
    T = se3_exp(np.array([0.02, -0.01, 0.03, 0.004, -0.006, 0.002]))
    across = ego_flow(depth, T, camera, camera).astype(np.float32)
    asked = []

    def provider(prev: Frame, curr: Frame) -> np.ndarray:
        asked.append((prev.index, curr.index))
        return across

    for given in (None, across):
        vo = Odometry(None, flow=provider, prepare=False)
        vo.track(frames[0])
        vo.skip(1, 0.1)
        assert vo.anchor.frame is not None and vo.anchor.frame.index == 0 and vo.anchor.gap == 1
        step = vo.track(frames[2], given)
        # the motion of the pair 0 -> 2: float32 of the flow, over pixels of 3 m / 40 px
        np.testing.assert_allclose(step.T_world_cam, invert(T), atol=1e-5)
        assert vo.anchor.frame.index == 2 and vo.anchor.gap == 0
    assert asked == [(0, 2)]
    told = " ".join((Odometry.track.__doc__ or "").split())
    assert "after :meth:`skip` the last one that was tracked" in told
    assert "``anchor.frame``" in told
