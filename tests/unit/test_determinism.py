"""Same input, same answer; compiled code that is the same wherever it comes from (F42)."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numba
import numpy as np
import pytest

from hybridvo import compilation
from hybridvo import pipeline as hybrid
from hybridvo.cli import main
from hybridvo.geometry import ego_flow, se3_exp
from hybridvo.hypotheses import search
from hybridvo.odometry import Odometry
from hybridvo.pipeline import compile_kernels, estimate, warm_up
from hybridvo.refinement import depth as second_depth
from hybridvo.refinement import kernels, photometric_kernels, readiness, solver
from hybridvo.refinement.refine import refine
from hybridvo.types import Camera, Frame, FramePair

TOOLS = Path(__file__).parents[2] / "tools"
ROOT = TOOLS.parent


@pytest.fixture(autouse=True)
def tools_on_the_path(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(TOOLS)


def test_the_same_bytes_again_and_nearly_those_with_two_threads(tmp_path: Path) -> None:
    """Learned judge, DIS and polish, in this process twice and in another with other threads."""
    from stress_doors import difference
    from stress_parts import command, content, write_walk

    walk = write_walk(tmp_path / "walk", 5, height=64, width=96, pictures=True)
    for name in ("first", "second"):
        assert main([*command(walk, tmp_path / name, "--flow", "dis", "-q")]) == 0
    code = "import sys; from hybridvo.cli import main; sys.exit(main(sys.argv[1:]))"
    arguments = command(walk, tmp_path / "other", "--flow", "dis", "-q")
    two = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "2")
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments],
        env=os.environ | two,
        cwd=ROOT,
        capture_output=True,
    )
    assert done.returncode == 0, done.stderr
    first = content(tmp_path / "first")
    assert len(first["steps.csv"]) == 5 and "trajectory.tum" in first
    assert content(tmp_path / "second") == first
    # the judge's convolutions share out their sums by the number of threads: the last bits of its
    # float32 masks differ, motions by 2e-7 m and 2e-4 standard deviations (measured)
    apart = difference(tmp_path / "first", tmp_path / "other")
    assert apart["translation_m"] < 1e-5 and apart["rotation"] < 1e-5 and apart["sigmas"] < 0.02


def signatures() -> dict[str, int]:
    """How many versions of every kernel have been compiled in this process."""
    modules = (kernels, photometric_kernels, search, second_depth, solver)
    return {
        f"{module.__name__}.{name}": len(value.signatures)
        for module in modules
        for name, value in vars(module).items()
        if hasattr(value, "signatures")
    }


def read_only(array: np.ndarray) -> np.ndarray:
    """As out of ``np.frombuffer``: a message, a mapped file."""
    return np.frombuffer(array.tobytes(), array.dtype).reshape(array.shape)


def unaligned(array: np.ndarray) -> np.ndarray:
    """As out of a packed message: the first number at an odd address."""
    data = b"x" + array.tobytes()
    return np.frombuffer(data, array.dtype, offset=1).reshape(array.shape)


@pytest.mark.parametrize("made", [read_only, unaligned, np.asfortranarray, lambda a: a[::-1][::-1]])
def test_no_frame_makes_a_kernel_compile_anew(made) -> None:
    """Seconds in the middle of a walk, by a flag that the driver of a camera happens to set."""
    warm_up("refine", "on")
    camera = Camera(40, 40, 23.5, 15.5, 32, 48)
    v, u = np.mgrid[:32, :48] / 48
    depth = (2 + 0.5 * np.sin(9 * u) + 0.3 * np.cos(11 * v)).astype(np.float32)
    flow = ego_flow(depth, se3_exp(np.full(6, 0.01)), camera, camera).astype(np.float32)
    rgb = (120 + 60 * np.sin(40 * u) + 60 * np.cos(33 * v)).astype(np.uint8)[..., None].repeat(3, 2)
    before = signatures()
    vo = Odometry(method="refine", polish="on", prepare=False)
    poses = []
    for i in range(3):
        frame = Frame(made(rgb), made(depth), camera, 0.1 * i, i, made(np.full_like(depth, 1e-4)))
        poses.append(vo.track(frame, flow=made(flow) if i else None).T_world_cam)
    assert signatures() == before
    assert np.abs(poses[2] - np.eye(4)).max() > 0.01  # it did track


def twice(x):
    return 2 * x


def test_without_a_folder_for_the_cache_the_code_is_compiled_all_the_same(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A package that root installed, and a user without a home: importing must not fail."""
    from numba.core import caching

    implementation = getattr(caching, "CacheImpl", None) or caching._CacheImpl  # before 0.62
    monkeypatch.setattr(implementation, "_locator_classes", [])
    with pytest.raises(RuntimeError, match="no locator available"):
        numba.njit(cache=True)(twice)
    assert compilation.njit(cache=True)(twice)(21) == 42


def cached_anew(folder: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(folder))
    return compilation.njit(cache=True)(twice)


def test_a_full_disk_or_a_damaged_cache_costs_a_compilation(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from numba.core import caching

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(caching.IndexDataCacheFile, "_save_data", full)
        assert cached_anew(tmp_path, patch)(21) == 42
    assert cached_anew(tmp_path, monkeypatch)(21) == 42
    assert sum(cached_anew(tmp_path, monkeypatch).stats.cache_hits.values()) == 0  # not yet called
    whole = cached_anew(tmp_path, monkeypatch)
    assert whole(21) == 42 and sum(whole.stats.cache_hits.values()) == 1
    for suffix in ("nbc", "nbi"):
        (file,) = tmp_path.rglob(f"*.{suffix}")
        content = file.read_bytes()
        for damage in (b"", content[: len(content) // 2], b"not a cache"):
            file.write_bytes(damage)
            assert cached_anew(tmp_path, monkeypatch)(21) == 42


@pytest.fixture
def kernel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folder of a program with one kernel; its cache is ``tmp_path / 'cache'``."""
    source = tmp_path / "program" / "kernel.py"
    source.parent.mkdir()
    source.write_text("...")
    (tmp_path / "cache").mkdir()
    code = SimpleNamespace(co_filename=str(source))
    made = SimpleNamespace(
        py_func=SimpleNamespace(__code__=code),
        stats=SimpleNamespace(cache_path=str(tmp_path / "cache")),
    )
    monkeypatch.setattr(compilation, "_cached", [made])
    return source.parent


def test_kernels_are_compiled_apart_once(kernel: Path, tmp_path: Path) -> None:
    code = f"open({str(tmp_path / 'log')!r}, 'a').write('x')"
    log = tmp_path / "log"
    assert compilation.compile_once(code, kernel, "k") and log.read_text() == "x"
    assert compilation.compile_once(code, kernel, "k") and log.read_text() == "x"
    (kernel / "kernel.py").write_text("changed")
    assert compilation.compile_once(code, kernel, "k") and log.read_text() == "xx"
    assert len(list((tmp_path / "cache").iterdir())) == 1
    # what cannot be compiled is tried again, and complains in the process that needs it
    assert not compilation.compile_once("raise SystemExit(3)", kernel, "other")
    assert not compilation.compile_once(code, kernel.parent, "elsewhere")


def test_kernels_are_not_compiled_apart_by_a_frozen_program(
    kernel: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """There ``sys.executable`` is the program itself: it would start itself again and again."""
    monkeypatch.setattr(sys, "frozen", True, raising=False)
    assert not compilation.compile_once("raise SystemExit(0)", kernel, "k")


def test_a_library_user_reads_the_code_that_later_processes_read(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A tracker asks for it as ``hybridvo run`` does, and so does the first pair of who did not
    warm up; a process asks once.
    """
    asked = []
    for module in (hybrid, readiness):
        monkeypatch.setattr(module, "compile_once", lambda *args: asked.append(args) or True)
    for once in (readiness.compile_refinement, compile_kernels):
        once.cache_clear()

    def sets() -> list[tuple[str, str]]:
        done = [(sources.name, name) for _, sources, name in asked]
        asked.clear()
        return done

    frame = Frame(None, np.ones((24, 32)), Camera(30, 30, 15.5, 11.5, 24, 32))
    pair = FramePair(frame, frame, np.zeros((24, 32, 2)))
    Odometry(method="refine", prepare=False)
    assert warm_up("identity") == 0.0 and sets() == []
    refine(pair)
    assert sets() == [("refinement", "refine")]
    estimate(pair, method="refine")
    Odometry(method="refine")
    assert sets() == []
    estimate(pair, method="hybrid")
    assert sets() == [("refinement", "judged")]
    estimate(pair, method="hybrid")
    assert sets() == []


def test_the_compiling_process_asks_for_no_other(
    kernel: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = tmp_path / "log"
    code = (
        "import os; from hybridvo.compilation import COMPILING; "
        f"open({str(log)!r}, 'w').write(os.environ[COMPILING])"
    )
    assert compilation.compile_once(code, kernel, "k") and log.read_text() == "1"
    monkeypatch.setenv(compilation.COMPILING, "1")
    assert not compilation.compile_once("raise SystemExit(0)", kernel, "other")


def test_what_the_compiling_processes_run_is_valid(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    for module in (hybrid, readiness):
        monkeypatch.setattr(module, "compile_once", lambda *args: asked.append(args) or True)
    readiness.compile_refinement.cache_clear()
    compile_kernels.cache_clear()
    assert compile_kernels("hybrid")
    ran = []
    monkeypatch.setattr(readiness, "run_kernels", lambda *judge: ran.append(judge))
    for code, _, _ in asked:
        exec(compile(code, "child", "exec"), {})
    assert [len(judge) for judge in ran] == [0, 1]


def test_the_first_motion_in_a_new_process_is_that_of_every_later_one(tmp_path: Path) -> None:
    """With a cold cache and no warm-up: the bytes of a process that finds the cache warm."""
    code = (
        "import numpy as np; from hybridvo.refinement.refine import refine; "
        "from hybridvo.types import Camera, Frame, FramePair; "
        "rng = np.random.default_rng(0); "
        "f = Frame(None, rng.uniform(2, 5, (120, 160)), Camera(90, 90, 79.5, 59.5, 120, 160)); "
        "flow = np.full((120, 160, 2), 1.5) + rng.normal(0, 0.3, (120, 160, 2)); "
        "found = refine(FramePair(f, f, flow)); "
        "print(found.T_curr_prev.tobytes().hex(), found.covariance.tobytes().hex())"
    )
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": os.fspath(ROOT)}
    answers = [
        subprocess.run(
            [sys.executable, "-c", code],
            capture_output=True,
            text=True,
            check=True,
            env=environment,
        ).stdout
        for _ in range(2)
    ]
    assert answers[0] == answers[1] and answers[0].strip()


def test_a_kernel_follows_the_changes_of_the_ones_it_calls(tmp_path: Path) -> None:
    # numba alone answers 2 and 2: its cache looks at the file of the caller only
    head = "from hybridvo.compilation import njit\n"
    (tmp_path / "caller.py").write_text(
        f"{head}from callee import f\n@njit(cache=True)\ndef g():\n    return f()\n"
    )
    command = [
        *(sys.executable, "-c"),
        "from caller import g; print(g(), sum(g.stats.cache_hits.values()))",
    ]
    answers = []
    for value in (2, 30):
        (tmp_path / "callee.py").write_text(
            f"{head}@njit(cache=True)\ndef f():\n    return {value}\n"
        )
        for _ in range(2):  # compiled, then read
            done = subprocess.run(
                command,
                cwd=tmp_path,
                capture_output=True,
                text=True,
                check=True,
                env=os.environ | {"PYTHONPATH": os.fspath(ROOT)},
            )
            answers.append(done.stdout.split())
    assert answers == [["2", "0"], ["2", "1"], ["30", "0"], ["30", "1"]]
