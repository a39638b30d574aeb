"""A network with its description: images in, maps out."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from hybridvo.core.errors import InputError
from hybridvo.core.types import Camera
from hybridvo.io.onnx.description import find_network, read_description
from hybridvo.io.onnx.images import Placement, channels_last, place, tensor
from hybridvo.io.onnx.session import open_session


class Maps(NamedTuple):
    """What a network predicted for an image.

    Attributes:
        outputs: every output, by its name.
        where: where the camera's image lies in the network's.
    """

    outputs: dict[str, np.ndarray]
    where: Placement


class Network:
    """A network that is loaded.

    Args:
        text: ``onnx:FILE`` or ``onnx:FILE@DESCRIPTION``.
        task: depth, flow or mask.

    Attributes:
        name: of the file, for messages.
        what: its description.
        files: the network and its description.

    Raises:
        InputError: a file is missing, or the network does not fit its description.
        FormatError: a file is damaged.

    Example:
        >>> Network("onnx:depth.onnx", "depth").what.unit  # doctest: +SKIP
        'metres'
    """

    def __init__(self, text: str, task: str) -> None:
        found = find_network(text, f"--{task}")
        self.name = found.model.name
        self.files: list[Path] = list(found)
        self.what = read_description(found.description, task)
        self._session = open_session(found.model)
        self._check_names()

    def _check_names(self) -> None:
        """Refuse a description whose names the file does not have."""
        what = self.what
        inputs = self._session.inputs
        outputs = self._session.outputs
        wanted = [*what.inputs, *what.constants, what.intrinsics_input]
        # OpenCV does not list the inputs
        self._check_known("input", wanted, tuple(inputs) or tuple(wanted))
        self._check_known("output", [what.output, what.valid_output], outputs)
        if what.factor_output and not set(what.factor_output) & set(outputs):
            self._check_known("output", list(what.factor_output), outputs)

    def _check_known(
        self, kind: str, wanted: list[str], known: tuple[str, ...]
    ) -> None:
        for name in wanted:
            if name and name not in known:
                raise InputError(
                    f"{self.name}: has no {kind} '{name}' as {self.files[1]} states: it has "
                    f"{', '.join(known)}."
                )

    def run(self, images: list[np.ndarray], camera: Camera) -> Maps:
        """Run the network.

        Args:
            images: (H, W, 3) uint8, as many as it takes.
            camera: of the images.

        Returns:
            The outputs.

        Raises:
            InputError: the file does not take what its description states.
        """
        names = self._image_inputs(len(images))
        inputs = self._session.inputs
        spec = inputs.get(names[0])
        where = place(images[0].shape[:2], self.what, spec)
        feeds = {
            name: tensor(image, where, self.what)
            for name, image in zip(names, images, strict=True)
        }
        for name, number in self.what.constants.items():
            rank = len(inputs[name].shape) if name in inputs else 1
            feeds[name] = np.full((1,) * rank, number)
        if self.what.intrinsics_input:
            K = where.camera(camera).K
            feeds[self.what.intrinsics_input] = K[None].astype(np.float32)
        for name, known in inputs.items():
            if name in feeds and known.type is not None:
                feeds[name] = feeds[name].astype(known.type)
        return Maps(self._session.run(feeds), where)

    def _image_inputs(self, count: int) -> tuple[str, ...]:
        """The names of the inputs that take images."""
        given = self.what.inputs
        if not given and not self._session.inputs and count == 1:
            # OpenCV's name of a network's only input
            return ("",)
        names = given or tuple(self._session.inputs)[:count]
        if len(names) != count:
            raise InputError(
                f"{self.name}: takes {count} images: expected 'inputs' with {count} names in "
                f"{self.files[1]}, got {len(names)}."
            )
        return names

    def main_map(self, maps: Maps) -> np.ndarray:
        """Return the output that the description names, (h, w, channels) float32."""
        name = self.what.output or next(iter(maps.outputs))
        return channels_last(maps.outputs[name], self.what, self.name)
