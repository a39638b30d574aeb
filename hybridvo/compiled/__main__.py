"""Compile kernels ahead of their first call: ``python -m hybridvo.compiled [TABLE ...]``."""

import sys
from pathlib import Path

from hybridvo.compiled.ahead_of_time import compile_ahead

if __name__ == "__main__":
    compile_ahead()
    for table in sys.argv[1:]:
        compile_ahead(path=Path(table))
