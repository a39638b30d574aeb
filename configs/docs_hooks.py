"""Pages of the documentation that are made from the code: one for every public name, and the start page."""

from pathlib import Path

import hybridvo
from mkdocs.structure.files import File

ROOT = Path(__file__).resolve().parents[1]


def on_files(files, config):
    """Add ``index.md`` (the README) and ``api/NAME.md`` for every public name."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8").replace("](docs/", "](")
    pages = {"index.md": readme}
    for name, module in hybridvo._HOME.items():
        pages[f"api/{name}.md"] = f"# {name}\n\n::: {module}.{name}\n"
    for path, text in pages.items():
        files.append(File.generated(config, path, content=text))
    return files
