"""What strangers install: the wheel, its extras, how it is cited, and the file of the CI."""

from __future__ import annotations

import importlib
import json
import os
import platform
import re
import subprocess
import sys
import tomllib
import zipfile
from collections.abc import Callable
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path

import numpy as np
import pytest
import yaml
from packaging.requirements import Requirement

import hybridvo
from tests.scripts import ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))[
    "project"
]
EXTRAS = PROJECT["optional-dependencies"]
PYTHONS = ["3.11", "3.12", "3.13", "3.14"]


# --- extras ---------------------------------------------------------------------------------------


def _sdk(extra: str, module: str) -> Callable[[Path], object]:
    def load(folder: Path) -> object:
        from hybridvo.io.cameras.base import load_sdk

        return load_sdk(module, extra)

    return load


def _open_bag(folder: Path) -> object:
    bag = folder / "drive.bag"
    bag.write_bytes(b"#ROSBAG V2.0\n")
    return hybridvo.open_sequence(bag)


def _method(name: str) -> Callable[[Path], object]:
    def check(folder: Path) -> object:
        from hybridvo.pipeline import check_method

        return check_method(name)

    return check


def _refinement_in_torch(folder: Path) -> object:
    return importlib.import_module("hybridvo.core.torch_geometry")


ABSENT = {
    "realsense": ("pyrealsense2", _sdk("realsense", "pyrealsense2")),
    "oak": ("depthai", _sdk("oak", "depthai")),
    "orbbec": ("pyorbbecsdk", _sdk("orbbec", "pyorbbecsdk")),
    "bags": ("rosbags", _open_bag),
    "baselines": ("poselib", _method("poselib")),
    "train": ("pypose", _method("pwvo-refine")),
    "train, in torch": ("kornia", _refinement_in_torch),
}
"""Extra -> a library of it, and a call that needs it."""


@pytest.mark.usefixtures("read_here")
@pytest.mark.parametrize("extra", ABSENT)
def test_an_absent_extra_is_one_line_that_names_it(
    extra: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    library, call = ABSENT[extra]
    for name in list(sys.modules):
        if name.partition(".")[0] == library:
            monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.setitem(sys.modules, library, None)
    # modules that have imported it already would hide that it is gone
    for name in ("hybridvo.core.torch_geometry", "hybridvo.io.data.bags.source"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    name = extra.partition(",")[0]
    with pytest.raises(hybridvo.InputError) as found:
        call(tmp_path)
    assert f"pip install 'hybridvo[{name}]'" in str(found.value)
    assert "\n" not in str(found.value)
    assert name in EXTRAS


def test_messages_name_extras_that_exist() -> None:
    for path in (ROOT / "hybridvo").rglob("*.py"):
        for name in re.findall(r"hybridvo\[(\w+)\]", path.read_text("utf-8")):
            assert name in EXTRAS, f"{path.name}: {name}"


def installed_by(requirements: list[str]) -> dict[str, Distribution]:
    """What requirements of the project bring, as far as it is installed here."""
    found: dict[str, Distribution] = {}
    seen = set()
    # with the extra of the package that asks
    waiting = [(Requirement(text), "") for text in requirements]
    while waiting:
        needed, extra = waiting.pop()
        if needed.marker and not needed.marker.evaluate({"extra": extra}):
            continue
        if needed.name == "hybridvo":
            texts = [text for name in needed.extras for text in EXTRAS[name]]
            waiting += [(Requirement(text), "") for text in texts]
            continue
        try:
            package = distribution(needed.name)
        except PackageNotFoundError:
            continue
        name = package.metadata["Name"].lower()
        found[name] = package
        for its_extra in {(name, each) for each in ("", *needed.extras)} - seen:
            seen.add(its_extra)
            texts = package.requires or []
            waiting += [(Requirement(text), its_extra[1]) for text in texts]
    return found


GPL_LIBRARY = re.compile(r"libx26[45]\b")
"""What wheels of FFmpeg may hold, whatever their metadata state."""
PLAIN = PROJECT["dependencies"]


@pytest.mark.parametrize("requirements", [PLAIN, [*PLAIN, "hybridvo[all]"]])
def test_an_installation_brings_nothing_under_gpl(requirements: list[str]) -> None:
    packages = installed_by(requirements)
    assert len(packages) > 20
    for name, package in packages.items():
        data = package.metadata
        stated = [
            data.get("License-Expression") or "",
            (data.get("License") or "").partition("\n")[0],
            *(data.get_all("Classifier") or []),
        ]
        text = " ".join(stated)
        assert not re.search(r"\bA?GPL|GNU (Affero )?General Public", text), name
        libraries = [file.name for file in package.files or []]
        assert not [each for each in libraries if GPL_LIBRARY.match(each)], name


def own_requirements() -> set[str]:
    """The names of what both distributions and their extras ask for."""
    lab = tomllib.loads((ROOT / "hybridvo_lab/pyproject.toml").read_text("utf-8"))
    texts = []
    for project in (PROJECT, lab["project"]):
        texts += project["dependencies"]
        for extra in project["optional-dependencies"].values():
            texts += extra
    return {Requirement(text).name for text in texts} - {"hybridvo", "hybridvo-lab"}


def test_the_notice_lists_every_package_that_is_asked_for() -> None:
    notice = (ROOT / "NOTICE").read_text(encoding="utf-8")
    packages, _ = notice.split("A program that you distribute")
    # names, in one column or separated by commas, stand before two spaces or a line's end
    rows = re.findall(r"^    (\S.*?)(?:  .*|\(.*)?$", packages, re.MULTILINE)
    listed = {name.strip() for row in rows for name in row.split(",")}
    assert listed == own_requirements()


LARGE = {"rerun-sdk", "pyarrow", "open3d"}
"""What each takes a hundred megabytes and more, for one purpose."""


def test_no_large_package_comes_unasked() -> None:
    assert not LARGE & installed_by([*PLAIN, "hybridvo[all]"]).keys()
    assert {"rerun-sdk", "pyarrow"} <= installed_by(["hybridvo[viz]"]).keys()


# --- metadata -------------------------------------------------------------------------------------


def test_classifiers_exist_and_name_the_pythons() -> None:
    known = pytest.importorskip("trove_classifiers").classifiers
    classifiers = PROJECT["classifiers"]
    assert set(classifiers) <= known
    named = [re.findall(r":: (3\.\d+)$", text) for text in classifiers]
    assert [version for found in named for version in found] == PYTHONS


# --- continuous integration -----------------------------------------------------------------------


def test_the_citation_is_that_of_this_version() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["version"] == hybridvo.__version__
    assert citation["license"] == PROJECT["license"]


def test_the_release_builds_for_the_pythons_that_are_tested() -> None:
    text = (ROOT / ".github/workflows/release.yml").read_text(encoding="utf-8")
    jobs = yaml.safe_load(text)["jobs"]
    assert jobs["compiled"]["strategy"]["matrix"]["python"] == PYTHONS
    assert jobs["publish"]["needs"] == ["pure", "compiled"]
    # no other job may speak in the project's name
    allowed = [name for name, job in jobs.items() if "permissions" in job]
    assert allowed == ["publish"]
    assert jobs["publish"]["permissions"] == {"id-token": "write"}


# --- the wheel ------------------------------------------------------------------------------------


@pytest.mark.long
def test_the_wheel_holds_what_it_needs_and_no_more(tmp_path: Path) -> None:
    pytest.importorskip("hatchling")
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel"]
    subprocess.run(
        [*build, "-d", str(tmp_path)], cwd=ROOT, check=True, capture_output=True
    )
    (path,) = tmp_path.iterdir()
    assert path.name == f"hybridvo-{hybridvo.__version__}-py3-none-any.whl"
    # the laboratory is a distribution of its own
    assert path.stat().st_size < 3_000_000
    with zipfile.ZipFile(path) as wheel:
        names = set(wheel.namelist())
        (info,) = [name for name in names if name.endswith("/METADATA")]
        metadata = wheel.read(info).decode()
        entry_points = wheel.read(info.replace("METADATA", "entry_points.txt"))
    tops = {name.partition("/")[0] for name in names}
    assert tops == {"hybridvo", f"hybridvo-{hybridvo.__version__}.dist-info"}
    for folder in ("network/pretrained", "io/example"):
        own = (ROOT / "hybridvo" / folder).rglob("*.*")
        assert {f"hybridvo/{folder}/{x.name}" for x in own} <= names
    presets = (ROOT / "configs/cameras").glob("*.yaml")
    assert {f"hybridvo/io/cameras/presets/{x.name}" for x in presets} <= names
    assert {"hybridvo/py.typed", "hybridvo/run/odometry.yaml"} <= names
    assert any(name.endswith(".safetensors") for name in names)
    assert not [name for name in names if name.endswith((".pyc", ".nbc", ".nbi"))]
    assert b"hybridvo = hybridvo.run.cli:main" in entry_points
    assert re.findall(r"^Provides-Extra: (.*)$", metadata, re.M) == sorted(EXTRAS)
    assert "License-Expression: BSD-3-Clause" in metadata


@pytest.mark.long
def test_the_laboratory_is_built_by_itself(tmp_path: Path) -> None:
    pytest.importorskip("hatchling")
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel"]
    folder = ROOT / "hybridvo_lab"
    subprocess.run(
        [*build, "-d", str(tmp_path)], cwd=folder, check=True, capture_output=True
    )
    (path,) = tmp_path.iterdir()
    with zipfile.ZipFile(path) as wheel:
        names = {name for name in wheel.namelist() if ".dist-info/" not in name}
    kinds = (".py", ".json", ".safetensors", ".yaml", ".md", ".html")
    files = {
        x.relative_to(ROOT).as_posix()
        for x in folder.rglob("*.*")
        if x.suffix in kinds and x.name != "README.md"
    }
    assert names == files


TRACK = """
import json
import hybridvo
tracker = hybridvo.Odometry()
steps = [tracker.track(frame) for frame in hybridvo.example_frames()]
print(json.dumps([hybridvo.__file__, [step.T_world_cam.tolist() for step in steps]]))
"""


def track(package: Path, cache: Path) -> tuple[str, np.ndarray, str]:
    """Where the package lies, the path that it finds, and what it says."""
    done = subprocess.run(
        [sys.executable, "-c", TRACK],
        env=os.environ
        | {"PYTHONPATH": str(package), "NUMBA_CACHE_DIR": str(cache)},
        capture_output=True,
        text=True,
        check=False,
        cwd=cache,
    )
    assert done.returncode == 0, done.stderr
    where, path = json.loads(done.stdout)
    return where, np.array(path), done.stderr


@pytest.mark.long
@pytest.mark.timeout(1800)  # compiles all kernels, twice
@pytest.mark.skipif(platform.machine() != "x86_64", reason="no baseline is known")
def test_the_wheel_with_kernels_compiles_nothing_and_answers_alike(
    tmp_path: Path,
) -> None:
    pytest.importorskip("hatchling")
    dist = tmp_path / "dist"
    build = [sys.executable, str(ROOT / "tools/build_wheel.py"), "--out", str(dist)]
    subprocess.run(build, check=True, capture_output=True)
    pure, compiled = sorted(dist.iterdir(), key=lambda path: path.stat().st_size)
    assert pure.name.endswith("-py3-none-any.whl")
    python = f"cp{sys.version_info.major}{sys.version_info.minor}"
    assert f"-{python}-{python}-" in compiled.name
    assert compiled.stat().st_size < 20_000_000
    found = {}
    for path in (pure, compiled):
        package = tmp_path / path.stem
        cache = tmp_path / f"cache of {path.stem}"
        cache.mkdir()
        with zipfile.ZipFile(path) as wheel:
            wheel.extractall(package)
        where, found[path], said = track(package, cache)
        assert Path(where).is_relative_to(package)
        assert ("compiling once" in said) == (path == pure)
        assert bool(list(cache.rglob("*.nbc"))) == (path == pure)
    # measured: 1e-6 m after 25 frames; the order of sums in float32 differs
    np.testing.assert_allclose(found[pure], found[compiled], rtol=0, atol=1e-5)
