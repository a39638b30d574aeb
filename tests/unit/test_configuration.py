from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import yaml

from hybridvo.configuration import DisOptions, RunOptions, load_options
from hybridvo.errors import FormatError, InputError

CONFIG = Path(__file__).parents[2] / "configs" / "odometry.yaml"


def write(path: Path, text: str) -> str:
    (path / "mine.yaml").write_text(text)
    return str(path / "mine.yaml")


def test_the_shipped_file_equals_the_defaults_and_names_every_key() -> None:
    assert load_options(str(CONFIG)) == RunOptions()
    keys = yaml.safe_load(CONFIG.read_text())
    assert set(keys) == {f.name for f in dataclasses.fields(RunOptions)} - {
        *("refinement", "photometric", "key_frames"),
    }
    assert set(keys["dis"]) == {f.name for f in dataclasses.fields(DisOptions)}


def test_order_of_precedence(tmp_path: Path) -> None:
    path = write(tmp_path, "seed: 1\nstart: 2\nrefinement:\n  cutoff: 4\n")
    options = load_options(path, ["start=3", "refinement.tiles=16"], {"stride": 2, "stop": None})
    assert (options.seed, options.start, options.stride, options.stop) == (1, 3, 2, None)
    assert (options.refinement.cutoff, options.refinement.tiles) == (4.0, 16)
    assert load_options(path, ["start=3"], {"start": 4}).start == 4


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("sed: 1", r"mine\.yaml: unknown key 'sed' \(did you mean 'seed'\?\)"),
        ("refinement:\n  cutof: 1", r"unknown key 'cutof' \(did you mean 'cutoff'\?\)"),
        ("seed: x", "'seed': expected int, got 'x'"),
        ("refinement: 3", "expected a mapping"),
        ("stride: 0", "stride >= 1"),
        ("flow: raft", "flow: expected auto, file, dis, got 'raft'"),
        ("dis:\n  preset: slow", "ultrafast, fast, medium, got 'slow'"),
        ("max_failed: 2", r"a share in \[0, 1\]"),
        ("start: 5\nstop: 5", "stop > start"),
        ("policy: guess", "policy: expected hold, constant_velocity"),
        ("refinement:\n  cutoff: -1", "cutoff"),
    ],
)
def test_mistakes_in_a_file(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        load_options(write(tmp_path, text))


@pytest.mark.parametrize("text", ["- 1", "a: [", "!!python/object:os.system {}", "x" * 2_000_000])
def test_files_that_are_no_options(tmp_path: Path, text: str) -> None:
    with pytest.raises(FormatError, match=r"mine\.yaml"):
        load_options(write(tmp_path, text))


def test_missing_file() -> None:
    with pytest.raises(InputError, match=r"none\.yaml: no such file"):
        load_options("none.yaml")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("seed", "expected key=value"),
        ("=3", "expected key=value"),
        ("refinement..cutoff=3", "expected key=value"),
        ("seed.x=3", "expected int, got"),
        ("refinement.cutof=3", "did you mean 'cutoff'"),
        ("seed=[", "no value that YAML can read"),
    ],
)
def test_mistakes_in_assignments(text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        load_options(assignments=[text])


def test_a_key_below_a_value_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="'seed' holds a value"):
        load_options(write(tmp_path, "seed: 4"), ["seed.x=3"])
