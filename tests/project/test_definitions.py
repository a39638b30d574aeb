"""How often the package defines a projection and a Gauss-Newton loop, and why each stays.

Each is found by the expression that defines it: a new one needs a reason here.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator

from tests.project import source_tree as source

SOLVER_ROOMS = ("solver/", "judge/", "hypotheses/", "network/")

PROJECTIONS = {
    "core/geometry.py:project": "numpy: the definition, NaN behind the camera",
    "core/torch_geometry.py:to_pixels": "torch: the definition, on batches with gradients",
    "solver/kernels.py:project_block": "compiled: inside the fused loop of a block",
    "solver/kernels.py:residual": "compiled: of one pixel",
    "hypotheses/proposals.py:score_poses": "compiled: inside the fused loop of many poses",
    "solver/image_kernels.py:project_pixels": "compiled: with the warp of a patch",
    "solver/plane_kernels.py:linearize_planes": "compiled: of points, not of rays",
    "network/hypothesis_readings.py:_read_flow": "torch: from the rays of a grid, in the "
    "numbers that the network was trained on",
    "network/hypothesis_kernels.py:read_flow_of_hypothesis": "compiled: the same, for inference",
    "lab/evaluation/scores.py:_paper_ego_flow": "the paper's: it divides by |z|",
    "lab/training/pwvo_task.py:project": "of a loss: z is limited, so that it is finite",
    "lab/synthetic/meshes.py:image_points": "of a rasteriser: far outside behind the camera",
}
"""Function -> what is special about its pinhole projection.

The compiled ones but for ``linearize_planes`` share
``refinement.kernels.transform_and_project``; only the last line, focal length times
slope plus centre, is their own.
"""

LOOPS = {
    "solver/robust_fit.py:gauss_newton": "compiled: on the coarse grid, hundreds of times "
    "a pair",
    "solver/newton.py:newton": "on all pixels of a pair, with the curvature of the weights",
    "solver/torch/solve.py:_newton": "the same on a batch, each sample until it converges",
    "solver/torch/solve.py:_anneal": "on a batch, a step for each scale of the kernel",
    "solver/torch/solve.py:solve": "on a batch, a fixed number of steps after each noise",
    "solver/torch/patches.py:patch_poses": "on patches, which are linearised at their fusion",
    "solver/torch/factors.py:fit_pixels": "on given pixels, differentiable step by step",
    "solver/align.py:align": "compiled: on images, with gain and offset beside the motion",
    "judge/consistency.py:contradiction_by_depth": "on depth maps, along the directions "
    "that they determine",
    "hypotheses/proposals.py:fit_minimal": "compiled: on three pixels, without weights",
}
"""Function -> what is special about its loop of steps on a motion."""


def own_nodes(function: ast.FunctionDef) -> Iterator[ast.AST]:
    """Nodes of a function without those of functions inside it."""
    waiting = list(ast.iter_child_nodes(function))
    while waiting:
        node = waiting.pop()
        yield node
        if not isinstance(node, ast.FunctionDef):
            waiting += ast.iter_child_nodes(node)


def is_projection(node: ast.AST) -> bool:
    """Whether an expression adds a principal point to a scaled coordinate, or stands for that."""
    if isinstance(node, ast.Call):
        return "points_with_intrinsics" in ast.unparse(node.func)
    if not isinstance(node, ast.BinOp):
        return False
    right = ast.unparse(node.right)
    if isinstance(node.op, ast.MatMult):
        return bool(re.search(r"(^|\.)K\.T$", right))
    is_scaled = isinstance(node.left, ast.BinOp) and isinstance(
        node.left.op, ast.Mult | ast.Div
    )
    if isinstance(node.op, ast.Add) and is_scaled:
        return bool(re.search(r"(^|\.)cx$|^K\[2\]$", right))
    # without a centre: differences of places alone matter
    left = ast.unparse(node.left)
    return isinstance(node.op, ast.Div) and bool(re.search(r"^focal\[.* \* ", left))


def is_step(node: ast.AST) -> bool:
    """Whether an expression moves a pose by a left perturbation."""
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.MatMult):
        return bool(re.match(r"(se3_exp|exponential)\(", ast.unparse(node.left)))
    if not isinstance(node, ast.Call):
        return False
    name = ast.unparse(node.func).split(".")[-1]
    return name in ("left_update", "gauss_newton_step")


def is_loop_of_steps(node: ast.AST) -> bool:
    return isinstance(node, ast.For | ast.While) and any(
        map(is_step, ast.walk(node))
    )


def functions() -> Iterator[tuple[str, ast.FunctionDef]]:
    for path, tree in source.files().items():
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef):
                yield f"{path}:{node.name}", node


def test_every_projection_has_a_reason() -> None:
    found = {
        name for name, one in functions() if any(map(is_projection, own_nodes(one)))
    }
    assert found == set(PROJECTIONS)


def test_every_gauss_newton_loop_has_a_reason() -> None:
    found = {
        name
        for name, one in functions()
        if name.startswith(SOLVER_ROOMS)
        and any(map(is_loop_of_steps, own_nodes(one)))
    }
    assert found == set(LOOPS)


def test_points_are_moved_by_one_function() -> None:
    # keyframes.py writes it out once
    written_out = {
        name
        for name, one in functions()
        for node in own_nodes(one)
        if isinstance(node, ast.BinOp)
        and re.search(r"@ \w+\[:3, :3\]\.T \+ \w+\[:3, 3\]$", ast.unparse(node))
    }
    assert written_out - {"tracking/keyframes.py:carried_weights"} == {
        "core/geometry.py:transform_points"
    }


def test_definitions_are_found_where_they_are() -> None:
    def expression(text: str) -> ast.AST:
        return ast.parse(text, mode="eval").body

    assert is_projection(expression("camera.fx * x / z + camera.cx"))
    assert is_projection(expression("K[0] * a + K[2]"))
    assert not is_projection(expression("(u - camera.cx) / camera.fx"))
    assert is_step(expression("se3_exp(delta) @ T"))
    assert not is_step(expression("se3_exp(delta)"))
