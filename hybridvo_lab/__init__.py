"""hybridvo's laboratory: scenes, training, the paper's networks, methods to compare with, scores.

hybridvo finds it by the entry points in its pyproject.toml, and never imports it.
"""

from pathlib import Path

WEIGHTS = Path(__file__).parent / "weights"
"""The folder of the weights of the paper's networks."""
KERNELS = Path(__file__).with_name("signatures.json")
"""The types of its kernels, for :func:`hybridvo.compiled.ahead_of_time.compile_ahead`."""
