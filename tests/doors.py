"""One table of bad calls and what refuses them."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import pytest

Case = tuple[str, Callable[[], object], type[Exception], tuple[str, ...]]
"""Name, the call, the error, words of its message: where, what was got, what was expected."""


def refuses(cases: Sequence[Case]) -> Callable[..., None]:
    """A test of every case: ``test_doors = refuses([...])``.

    Each message is one line below 1000 characters and holds the words, in any order.
    """

    @pytest.mark.parametrize(
        ("call", "error", "words"),
        [pytest.param(*case[1:], id=case[0]) for case in cases],
    )
    def test_refuses(
        call: Callable[[], object], error: type, words: tuple[str, ...]
    ) -> None:
        with pytest.raises(error) as caught:
            call()
        message = str(caught.value)
        assert len(message) < 1000 and "\n" not in message
        for word in words:
            assert word in message

    return test_refuses
