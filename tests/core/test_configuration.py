from __future__ import annotations

from pathlib import Path

import pytest

from hybridvo.core.errors import FormatError, InputError
from hybridvo.core.options import Options, load_options, option_defaults

CONFIG = Path(__file__).parents[2] / "hybridvo" / "run" / "odometry.yaml"


def write(folder: Path, text: str) -> Path:
    (folder / "mine.yaml").write_text(text)
    return folder / "mine.yaml"


def test_the_shipped_file_equals_the_defaults_and_names_every_key():
    assert load_options(CONFIG) == Options()
    text = CONFIG.read_text()
    for key in option_defaults():
        assert f"  {key.split('.')[1]}:" in text


def test_order_of_precedence(tmp_path):
    path = write(tmp_path, "run:\n  seed: 1\n  start: 2\nrefine:\n  cutoff: 4\n")
    given = {"run.stride": 2, "run.stop": None}
    options = load_options(path, ["run.start=3", "refine.tiles=16"], given)
    run = options.run
    assert (run.seed, run.start, run.stride, run.stop) == (1, 3, 2, None)
    assert (options.refine.cutoff, options.refine.tiles) == (4.0, 16)
    assert load_options(path, ["run.start=3"], {"run.start": 4}).run.start == 4


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("run:\n  sed: 1", "run.sed: unknown (did you mean 'seed'?)"),
        ("refine:\n  cutof: 1", "refine.cutof: unknown (did you mean 'cutoff'?)"),
        ("run:\n  seed: x", "seed"),
        ("refine: 3", "refine"),
        ("run:\n  stride: 0", "stride"),
        ("flow:\n  source: raft", "raft"),
        ("run:\n  max_failed: 2", "max_failed"),
        ("refine:\n  cutoff: -1", "cutoff"),
        ("refine:\n  cutoff: .nan", "cutoff"),
    ],
)
def test_mistakes_name_the_file_and_the_key(tmp_path, text, expected):
    with pytest.raises(InputError) as error:
        load_options(write(tmp_path, text))
    assert "mine.yaml" in str(error.value) and expected in str(error.value)


@pytest.mark.parametrize("text", ["- 1", "a: [", "!!python/object:os.system {}"])
def test_files_that_are_no_options(tmp_path, text):
    with pytest.raises(FormatError, match=r"mine\.yaml"):
        load_options(write(tmp_path, text))


@pytest.mark.parametrize(
    "text", ["seed", "=3", "refine..cutoff=3", "run.seed.x=3", "run.seed=x"]
)
def test_assignments_that_cannot_be_meant(text):
    with pytest.raises(InputError, match="--set"):
        load_options(assignments=[text])
