"""Make documentation pages: one for every public name, and the start page from the README."""

from pathlib import Path

from mkdocs.structure.files import File

import hybridvo

ROOT = Path(__file__).resolve().parents[1]


def on_files(files, config):
    """Add ``index.md`` (the README) and ``api/NAME.md`` for every public name."""
    readme = (
        (ROOT / "README.md").read_text(encoding="utf-8").replace("](docs/", "](")
    )
    names = "".join(f"- [`{name}`]({name}.md)\n" for name in hybridvo._HOME)
    pages = {"index.md": readme, "api/index.md": f"# API reference\n\n{names}"}
    for name, module in hybridvo._HOME.items():
        pages[f"api/{name}.md"] = f"# {name}\n\n::: hybridvo.{module}.{name}\n"
    for path, text in pages.items():
        files.append(File.generated(config, path, content=text))
    return files
