"""What fuzzing and its crafted relatives have found, and must not find again.

The corpus in ``tests/fuzz/corpus`` holds one valid file of every format and every input that broke
something. Costs are bounded in each replay, see ``tests/fuzz/targets.py``.
"""

from __future__ import annotations

import os
import pickle
import resource
import struct
import subprocess
import sys
import textwrap
import time
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest
import sequences as write
import torch

from hybridvo.configuration import load_options
from hybridvo.data import image_io
from hybridvo.data.file_sequence import associate, natural_key
from hybridvo.data.plain_yaml import plain_yaml
from hybridvo.data.presets import load_preset
from hybridvo.data.sequence import open_sequence
from hybridvo.errors import CheckpointError, FormatError, InputError
from hybridvo.network.weights import load_weights
from hybridvo.training.checkpoint import FORMAT, load_checkpoint, save_checkpoint

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "fuzz"))
import targets

KEPT = [path for path in sorted(targets.CORPUS.rglob("*")) if path.is_file()]


def test_every_target_has_a_corpus_and_it_is_small():
    assert {path.parent.name for path in KEPT} == set(targets.TARGETS)
    assert sum(path.stat().st_size for path in KEPT) < 300_000


@pytest.mark.parametrize("path", KEPT, ids=lambda p: f"{p.parent.name}/{p.name}")
def test_corpus_breaks_no_promise(path, tmp_path):
    targets.run(path.parent.name, path.read_bytes(), tmp_path)


@pytest.mark.parametrize(
    ("name", "data", "error"),
    [
        ("flo", b"", None),
        ("raises", b"", ValueError),
        ("warns", b"", RuntimeWarning),
        ("lingers", b"", targets.TooExpensive),
    ],
)
def test_the_targets_would_notice(name, data, error, tmp_path, monkeypatch):
    def raises(data, folder):
        raise ValueError

    def warns(data, folder):
        np.float32(3e38) * np.float32(1e5)

    def lingers(data, folder):
        while time.process_time() - started < 0.05:
            pass

    started = time.process_time()
    if name == "lingers":
        monkeypatch.setattr(targets, "SLACK_S", 0.01)
    monkeypatch.setitem(targets.TARGETS, "raises", raises)
    monkeypatch.setitem(targets.TARGETS, "warns", warns)
    monkeypatch.setitem(targets.TARGETS, "lingers", lingers)
    if error is None:
        targets.run(name, data, tmp_path)
    else:
        with pytest.raises(error):
            targets.run(name, data, tmp_path)


def test_memory_beyond_the_bound_is_noticed(monkeypatch):
    # the peak of this process may lie far above what it holds now: a bound that any peak breaks
    monkeypatch.setattr(targets, "SLACK_BYTES", -1)
    with pytest.raises(targets.TooExpensive, match="MiB for 0 bytes"), targets.bounded(0):
        pass


def cpu(call) -> float:
    started = time.process_time()
    call()
    return time.process_time() - started


# --- settings -------------------------------------------------------------------------------------
ALIASES = "a0: &a0 {x: 1}\n" + "".join(
    f"a{i}: &a{i} {{<<: [*a{i - 1}, *a{i - 1}]}}\n" for i in range(1, 40)
)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (ALIASES, "anchors and aliases"),  # 2^39 entries by merge keys in 1 kB
        ("a: *x\n", "anchors and aliases"),
        ("a: !!int x\n", "tags"),
        ("a: !!timestamp x\n", "tags"),
        ("a: " + "[" * 900 + "]" * 900, "levels of nesting"),
        ("a: " + "x" * 1001, "more than 1000 characters"),
        ("a: 0x_\n", "not a plain YAML"),
        ("a: \x00", "not a plain YAML"),
        ("a: \udcff", "not a plain YAML"),
    ],
)
def test_yaml_that_unfolds_or_runs(text, reason, tmp_path):
    def refuse():
        with pytest.raises(FormatError, match=reason) as caught:
            plain_yaml(text, "x.yaml")
        assert len(str(caught.value)) < 1000

    assert cpu(refuse) < 1.0  # the merge keys took hours and all memory


def test_plain_yaml_reads_what_settings_use():
    text = (
        "a: 1\nb: [0.5, -2, .inf]\nc: {d: true, e: null, f: word}\ng: 0001-01-01\nh: 1:30\n'<<': 2"
    )
    expected = {"a": 1, "b": [0.5, -2, float("inf")], "c": {"d": True, "e": None, "f": "word"}}
    expected |= {"g": "0001-01-01", "h": "1:30", "<<": 2}  # no dates, no base 60, no merging
    assert plain_yaml(text, "x") == expected


@pytest.mark.parametrize("assignment", ["seed=" + "9" * 400, "max_failed=" + "9" * 400])
def test_numbers_beyond_every_float(assignment):
    with pytest.raises(InputError, match="a number of more than 300 digits"):
        load_options(assignments=[assignment])


def test_kind_of_a_preset_that_is_no_word(tmp_path):
    (tmp_path / "x.yaml").write_text("preset: [paper]\n")
    with pytest.raises(InputError, match="must be one of paper, wide"):
        load_preset(tmp_path / "x.yaml")


# --- lists and names ------------------------------------------------------------------------------
def test_digits_of_other_scripts_in_file_names():
    # isdecimal() holds for them, and numbers stood where text stands in other names
    names = ["b9.png", "\N{ARABIC-INDIC DIGIT THREE}1.png", "b10.png", "\N{SUPERSCRIPT TWO}.png"]
    assert sorted(names, key=natural_key)[:2] == ["b9.png", "b10.png"]


def test_stamps_that_all_fit_all_are_refused():
    first, second = 1 + 1e-9 * np.arange(20_000), np.ones(20_000)  # 4e8 candidates, 30 GB

    def refuse():
        with pytest.raises(InputError, match="400000000 pairs of stamps"):
            associate(first, second)

    assert cpu(refuse) < 1.0
    # truth at 1 kHz beside frames at 30 Hz is no such case
    frames, truth = np.arange(300) / 30, np.arange(10_000) / 1000
    pairs = associate(frames, truth)
    assert [i for i, _ in pairs] == list(range(300))
    assert np.abs(frames - truth[[j for _, j in pairs]]).max() <= 0.0005 + 1e-9


def test_infinite_stamps_have_no_partner(tmp_path):
    written = write.write_tum(tmp_path)
    for name in ("rgb.txt", "depth.txt"):
        path = written.path / name
        path.write_text(path.read_text() + "inf rgb/0.png\n")
    sequence = open_sequence(written.path)
    assert len(sequence) == 3 and np.isfinite(sequence.timestamps).all()


def test_poses_that_overflow(tmp_path):
    written = write.write_tum(tmp_path)
    path = written.path / "groundtruth.txt"
    for row in ("100 1e300 0 0 0 0 0 1\n", "100 0 0 0 1e200 0 0 1e200\n"):
        path.write_text(row)
        with pytest.raises(FormatError, match=r"groundtruth\.txt: pose 0"):
            open_sequence(written.path)


@pytest.mark.parametrize("old, new", [("0 20 2.5", "0 0 2.5"), ("20 0 4.5 5", "20 0 4.5 1e308")])
def test_kitti_projection_that_cannot_be_inverted(old, new, tmp_path):
    written = write.write_kitti(tmp_path)
    path = written.path / "calib.txt"
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(FormatError, match=r"calib\.txt: P2: expected"):
        open_sequence(written.path)


def test_kitti_truth_that_is_no_rotation(tmp_path):
    written = write.write_kitti(tmp_path)
    (tmp_path / "poses" / "07.txt").write_text("0 0 0 0 0 0 0 0 0 0 0 0\n" * 3)
    with pytest.raises(FormatError, match=r"07\.txt: pose 0: expected a rotation"):
        open_sequence(written.path)


@pytest.mark.parametrize("width", [1, 8, 15, 16, 17, 31])
def test_stereo_of_narrow_images_finds_no_depth(width, tmp_path):
    # OpenCV's matcher raises for these, and crashes the process at 15 pixels
    written = write.write_kitti(tmp_path, stereo=True)
    for path in sorted(written.path.glob("image_*/*.png")):
        write.png(path, write.image(0, 40, width))
    calibration = written.path / "calib.txt"
    calibration.write_text(calibration.read_text().replace(" 4.5 ", f" {width / 2} "))
    assert not open_sequence(written.path, depth="stereo").frame(0).depth.any()


# --- files that are none --------------------------------------------------------------------------
@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes here")
def test_pipes_and_devices_do_not_block(tmp_path):
    os.mkfifo(tmp_path / "pipe.png")  # open() waits for a writer
    os.symlink("/dev/zero", tmp_path / "zero.png")  # read() never ends
    for name in ("pipe.png", "zero.png"):
        for reader in (image_io.read_rgb, image_io.image_size, image_io.read_text):
            with pytest.raises(FormatError, match=f"{name}: expected a file, got a pipe or device"):
                reader(tmp_path / name)
    (tmp_path / "file").touch()
    with pytest.raises(FormatError, match="cannot be read"):
        image_io.read_rgb(tmp_path / "file" / "x.png")


@pytest.mark.parametrize("name", ["x" * 300, "file/x", "a\0b"])
def test_names_that_no_file_can_have(name, tmp_path):
    (tmp_path / "file").touch()
    path = f"{tmp_path}/{name}"
    for read in (load_options, load_preset, load_weights, load_checkpoint, open_sequence):
        with pytest.raises(InputError):
            read(path)


# --- images ---------------------------------------------------------------------------------------
def jpeg(**options: int) -> bytes:
    flags = [item for pair in options.items() for item in (getattr(cv2, pair[0]), pair[1])]
    return cv2.imencode(".jpg", np.full((64, 96, 3), 90, np.uint8), flags)[1].tobytes()


def test_small_jpeg_of_a_huge_image(tmp_path):
    content = jpeg()
    at = content.index(b"\xff\xc0") + 5
    path = tmp_path / "x.jpg"
    path.write_bytes(content[:at] + struct.pack(">HH", 16383, 16383) + content[at + 4 :])
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss

    def refuse():
        with pytest.raises(FormatError, match="16383x16383 pixels cannot fit"):
            image_io.read_rgb(path)

    assert cpu(refuse) < 1.0  # 20 s and 800 MB before
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 50e3  # kB


def test_jpeg_of_very_many_scans(tmp_path):
    content = jpeg(IMWRITE_JPEG_PROGRESSIVE=1)
    scan = content.index(b"\xff\xda")
    path = tmp_path / "x.jpg"
    path.write_bytes(content[:scan] + content[scan:-2] * 60 + content[-2:])
    with pytest.raises(FormatError, match="more than 256 scans"):
        image_io.read_rgb(path)


@pytest.mark.parametrize("quality", [1, 95])
@pytest.mark.parametrize("progressive", [0, 1])
def test_even_a_flat_image_keeps_its_jpeg(quality, progressive, tmp_path):
    # the most pixels per byte that a writer can reach; the limit has to be far above
    flat = np.full((3000, 4000, 3), 128, np.uint8)
    flags = [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_PROGRESSIVE, progressive]
    flags += [cv2.IMWRITE_JPEG_OPTIMIZE, 1]
    content = cv2.imencode(".jpg", flat, flags)[1].tobytes()
    (tmp_path / "x.jpg").write_bytes(content)
    assert image_io.read_rgb(tmp_path / "x.jpg").shape == flat.shape
    assert flat.shape[0] * flat.shape[1] < 0.5 * 2048 * len(content)


def test_headers_cost_nothing_under_a_memory_limit(tmp_path):
    # F3 and F36 with the address space limited: an allocation of what a header says would fail
    program = f"""
        import resource, struct, sys
        from pathlib import Path
        from hybridvo.data import image_io
        from hybridvo.errors import FormatError
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + 2**26,) * 2)
        path = Path({str(tmp_path / "x.flo")!r})
        for width, height in ((8192, 8192), (16384, 16384), (2**31 - 1, 1), (46341, 46341)):
            path.write_bytes(image_io.TAG_BYTES + struct.pack("<ii", width, height) + bytes(64))
            for reader in (image_io.read_flo, image_io.read_dpt):
                try:
                    reader(path)
                except FormatError:
                    continue
                sys.exit(f"{{width}}x{{height}} was read")
        print("refused")
    """
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(program)],
        capture_output=True,
        text=True,
        check=False,
    )
    if "No such file" in done.stderr and "/proc" in done.stderr:
        pytest.skip("no /proc here to learn the memory in use")
    assert done.stdout == "refused\n", done.stderr


# --- checkpoints ----------------------------------------------------------------------------------
def state() -> dict:
    network = {"w": torch.arange(6.0).reshape(2, 3)}
    rest = {"optimizer": {}, "ema": None, "progress": {"step": 1}, "rng": torch.zeros(8).byte()}
    return {"options": {}, "network": network, **rest}


def refused(path: Path, reason: str) -> None:
    with pytest.raises(CheckpointError, match=reason) as caught:
        load_checkpoint(path)
    assert path.name in str(caught.value) and len(str(caught.value)) < 1000


def repacked(path: Path, change, compression: int = zipfile.ZIP_STORED) -> None:
    """The archive again with each entry's content changed."""
    with zipfile.ZipFile(path) as archive:
        content = {entry.filename: archive.read(entry) for entry in archive.infolist()}
    with zipfile.ZipFile(path, "w", compression) as archive:
        for name, data in content.items():
            archive.writestr(name, change(name, data))


def test_the_checkpoint_itself_is_read(tmp_path):
    path = save_checkpoint(tmp_path / "x.pt", state())
    assert torch.equal(load_checkpoint(path)["network"]["w"], state()["network"]["w"])
    repacked(path, lambda name, data: data)
    assert load_checkpoint(path)["progress"] == {"step": 1}


class Terabyte:
    def __reduce__(self):
        return bytearray, (2**40,)


def test_checkpoint_that_asks_for_a_terabyte(tmp_path):
    path = save_checkpoint(tmp_path / "x.pt", state())
    # torch's weights_only would make it
    bomb = pickle.dumps({"format": FORMAT, "options": Terabyte()}, protocol=2)
    repacked(path, lambda name, data: bomb if name.endswith("data.pkl") else data)
    refused(path, "names '[a-z_]*builtin[a-z_]* bytearray'")


def test_checkpoint_of_a_tensor_that_repeats_one_number(tmp_path):
    path = tmp_path / "x.pt"
    many = torch.zeros(1).expand(2**40)  # isfinite of it takes a terabyte
    save_checkpoint(path, {**state(), "network": {"w": many}})
    refused(path, r"tensor of shape \(1099511627776,\)")
    save_checkpoint(path, {**state(), "optimizer": {"state": [{"m": (many,)}]}})
    refused(path, r"tensor of shape \(1099511627776,\)")


def test_compressed_and_inflated_archives(tmp_path):
    path = save_checkpoint(tmp_path / "x.pt", state())
    repacked(path, lambda name, data: data, zipfile.ZIP_DEFLATED)
    refused(path, "compressed entries")
    save_checkpoint(path, state())
    content = path.read_bytes()
    end = content.rindex(b"PK\x01\x02")  # the last entry of the directory
    path.write_bytes(content[: end + 20] + struct.pack("<II", 2**31, 2**31) + content[end + 28 :])
    refused(path, "larger than the file|not a whole")


def test_old_and_bare_pickles_are_not_even_opened(tmp_path):
    path = tmp_path / "x.pt"
    torch.save({"format": FORMAT, **state()}, path, _use_new_zipfile_serialization=False)
    refused(path, "expected a zip archive")
    path.write_bytes(pickle.dumps({"format": FORMAT, **dict.fromkeys(state())}))
    refused(path, "expected a zip archive")


@pytest.mark.parametrize(
    "change",
    [
        {"network": [1, 2]},
        {"network": {"w": "text"}},
        {"network": {"w": torch.tensor(float("nan"))}},
        {"options": None},
        {"progress": 3},
        {"rng": "seed"},
        {"ema": 1.0},
    ],
)
def test_checkpoint_of_another_structure(change, tmp_path):
    refused(save_checkpoint(tmp_path / "x.pt", {**state(), **change}), "of type|not finite")


def test_a_list_that_holds_itself(tmp_path):
    loop: list = []
    loop.append(loop)
    path = save_checkpoint(tmp_path / "x.pt", {**state(), "options": {"loop": loop}})
    assert load_checkpoint(path)["progress"] == {"step": 1}


def test_judge_training_refuses_the_checkpoint_of_another_training(tmp_path):
    from hybridvo.training.judge_loop import JudgeTrainer, JudgeTrainingOptions

    save_checkpoint(tmp_path / "checkpoint.pt", state())
    trainer = object.__new__(JudgeTrainer)  # resume() needs no pictures
    trainer.out, trainer.options = tmp_path, JudgeTrainingOptions()
    trainer.network = torch.nn.Linear(2, 1)  # type: ignore[assignment]
    with pytest.raises(CheckpointError, match=r"checkpoint\.pt: not of this training"):
        trainer.resume()
