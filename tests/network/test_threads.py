"""Inference works on one thread, and leaves the number of threads of all others as it was."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from threading import Barrier, Thread

import numpy as np
import pytest
import torch

import hybridvo as hvo
from hybridvo.network.threads import one_thread, single_threaded_inference
from tests import worlds
from tests.scripts import ROOT


def numbers() -> tuple[int, int]:
    """Threads that torch and MKL would use here."""
    told = re.search(
        r"mkl_get_max_threads\(\) : (\d+)", torch.__config__.parallel_info()
    )
    return torch.get_num_threads(), int(
        told[1]
    ) if told else torch.get_num_threads()


def numbers_of_a_new_thread() -> tuple[int, int]:
    found: list[tuple[int, int]] = []
    thread = Thread(target=lambda: found.append(numbers()))
    thread.start()
    thread.join()
    return found[0]


@pytest.fixture(autouse=True)
def three_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    yield
    torch.set_num_threads(before)


@pytest.mark.parametrize("context", [one_thread, single_threaded_inference])
def test_within_this_thread_works_alone_and_no_other_is_changed(context) -> None:
    assert numbers() == (3, 3)
    with context():
        assert numbers() == (1, 1)
        assert numbers_of_a_new_thread() == (3, 3)
        with context():
            assert numbers() == (1, 1)
        assert numbers() == (1, 1)
    assert numbers() == (3, 3)
    with pytest.raises(KeyError), context():
        raise KeyError
    assert numbers() == (3, 3)


def test_threads_that_come_and_go_in_any_order() -> None:
    """The first to enter leaves first: saving and restoring one number would keep the other's 1."""
    barrier = Barrier(4)

    def work(turn: int) -> tuple[int, int]:
        for k in range(20):
            barrier.wait(timeout=60)
            with single_threaded_inference():
                assert numbers() == (1, 1)
                if (k + turn) % 2:
                    barrier.wait(timeout=60)
            if not (k + turn) % 2:
                barrier.wait(timeout=60)
        return numbers()

    with ThreadPoolExecutor(4) as pool:
        assert set(pool.map(work, range(4))) == {(3, 3)}
        assert numbers_of_a_new_thread() == (3, 3)
    assert numbers() == (3, 3)


def test_estimates_in_threads_agree_and_change_no_setting() -> None:
    pair, _ = worlds.world(noise=(0.1, 0.01))
    expected = hvo.estimate(pair, method="hybrid-flow").T_curr_prev
    with ThreadPoolExecutor(3) as pool:
        found = list(
            pool.map(lambda _: hvo.estimate(pair, method="hybrid-flow"), range(6))
        )
    assert all(np.array_equal(motion.T_curr_prev, expected) for motion in found)
    assert numbers() == numbers_of_a_new_thread() == (3, 3)


@pytest.mark.slow
def test_the_first_use_of_torch_in_a_process_may_be_within() -> None:
    code = """
import torch
from hybridvo.network.threads import one_thread
with one_thread():
    inside = torch.get_num_threads()
print(inside, torch.get_num_threads())
"""
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={"OMP_NUM_THREADS": "2", "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout == "1 2\n", done.stderr
