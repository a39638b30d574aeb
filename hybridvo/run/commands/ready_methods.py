"""Which methods can run here."""

from __future__ import annotations

from collections.abc import Iterable

from hybridvo.core.errors import InputError
from hybridvo.network.models import Models, default_models
from hybridvo.pipeline import check_method, method_names, method_of


def methods_to_run(
    names: Iterable[str],
    models: Models | None = None,
    every: Iterable[str] | None = None,
) -> tuple[tuple[str, ...], dict[str, str]]:
    """Check the names of methods.

    Args:
        names: The names; ``all`` alone stands for every method.
        models: The networks; by default the pretrained ones.
        every: What ``all`` stands for, in this order; by default every method there is.

    Returns:
        The methods to run, and why ``all`` leaves some out, with the remedy.

    Raises:
        InputError: A method that was named cannot run here.
    """
    models = models or default_models()
    given = list(names)
    is_all = given == ["all"]
    missing: dict[str, str] = {}
    ready: list[str] = []
    for name in (every or method_names()) if is_all else given:
        try:
            method = check_method(name)
            for network in method_of(method).networks:
                models.path(network)
        except InputError as error:
            if not is_all:
                raise
            missing[name] = str(error)
        else:
            if method not in ready:
                ready.append(method)
    return tuple(ready), missing
