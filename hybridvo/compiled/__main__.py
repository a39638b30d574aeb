"""Compile the kernels ahead of their first call: ``python -m hybridvo.compiled``."""

from hybridvo.compiled.ahead_of_time import compile_ahead

if __name__ == "__main__":
    compile_ahead()
