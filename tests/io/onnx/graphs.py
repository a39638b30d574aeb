"""Small networks that compute something known, written as ONNX files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

OPSET = 13
Shape = tuple[Any, ...]


def write(
    path: Path,
    nodes: list[Any],
    inputs: dict[str, Shape],
    outputs: dict[str, Shape],
    constants: dict[str, np.ndarray] | None = None,
    types: dict[str, int] | None = None,
) -> Path:
    """Write a graph; ``types`` are those of inputs that are not float32."""
    kinds = types or {}

    def infos(shapes: dict[str, Shape]) -> list[Any]:
        return [
            helper.make_tensor_value_info(
                name, kinds.get(name, TensorProto.FLOAT), list(shape)
            )
            for name, shape in shapes.items()
        ]

    initial = [numpy_helper.from_array(v, k) for k, v in (constants or {}).items()]
    graph = helper.make_graph(
        nodes, "known", infos(inputs), infos(outputs), initializer=initial
    )
    opsets = [helper.make_opsetid("", OPSET)]
    model = helper.make_model(graph, opset_imports=opsets, ir_version=8)
    onnx.checker.check_model(model)
    path.write_bytes(model.SerializeToString())
    return path


def node(kind: str, inputs: str, output: str, **attributes: Any) -> Any:
    return helper.make_node(kind, inputs.split(), [output], **attributes)


def number(value: float) -> np.ndarray:
    return np.array([value], np.float32)


def depth_network(
    path: Path, factor: float = 1.0, size: Shape = ("h", "w"), output: str = "depth"
) -> Path:
    """Depth is the mean of the three channels, as the network gets them, times a factor."""
    nodes = [
        node("ReduceMean", "image", "grey", axes=[1], keepdims=1),
        node("Mul", "grey factor", output),
    ]
    shape = (1, 3, *size)
    return write(
        path,
        nodes,
        {"image": shape},
        {output: (1, 1, *size)},
        {"factor": number(factor)},
    )


def flow_network(
    path: Path, u: float, v: float, size: Shape = ("h", "w"), slope: float = 0.0
) -> Path:
    """Flow is (u, v), plus ``slope`` times the difference of the images' mean grey."""
    nodes = [
        node("Sub", "second first", "difference"),
        node("ReduceMean", "difference", "change", axes=[1], keepdims=1),
        node("Mul", "change slope", "grown"),
        node("Concat", "grown grown", "both", axis=1),
        node("Add", "both shift", "flow"),
    ]
    shift = np.array([u, v], np.float32).reshape(1, 2, 1, 1)
    shape = (1, 3, *size)
    return write(
        path,
        nodes,
        {"first": shape, "second": shape},
        {"flow": (1, 2, *size)},
        {"shift": shift, "slope": number(slope)},
    )


def mask_network(path: Path) -> Path:
    """Two classes: 1 - red and red, so that red above one half is the second."""
    nodes = [
        node("Slice", "image start end axis", "red"),
        node("Sub", "one red", "other"),
        node("Concat", "other red", "classes", axis=1),
    ]
    index = {
        "start": np.array([0], np.int64),
        "end": np.array([1], np.int64),
        "axis": np.array([1], np.int64),
    }
    return write(
        path,
        nodes,
        {"image": (1, 3, "h", "w")},
        {"classes": (1, 2, "h", "w")},
        {**index, "one": number(1.0)},
    )


def constant_network(
    path: Path, outputs: dict[str, np.ndarray], inputs: dict[str, Shape]
) -> Path:
    """Outputs that do not depend on the image; every further input is taken and ignored."""
    nodes = [node("ReduceMean", "image", "mean", keepdims=0)]
    nodes.append(node("Sub", "mean mean", "nothing"))
    for name in outputs:
        nodes.append(node("Add", f"c_{name} nothing", name))
    shapes = {name: value.shape for name, value in outputs.items()}
    constants = {
        f"c_{name}": value.astype(np.float32) for name, value in outputs.items()
    }
    types = {"num_tokens": TensorProto.INT64}
    return write(path, nodes, inputs, shapes, constants, types)


def describe(model: Path, text: str) -> str:
    """Write a description beside a network, and return what names both."""
    model.with_suffix(".yaml").write_text(text)
    return f"onnx:{model}"
