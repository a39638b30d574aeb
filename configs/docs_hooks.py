"""Make pages: one for every public name, the start page from the README, and the examples."""

import re
from pathlib import Path

from griffe import Extension
from mkdocs.structure.files import File

import hybridvo

ROOT = Path(__file__).resolve().parents[1]


class Doctests(Extension):
    """Shows doctests as code; Markdown would take their ``>>>`` for quotes in quotes.

    References in Sphinx's form become names, for Markdown does not know that form.
    """

    def on_instance(self, *, obj, **_):
        """Put fences around the doctests of an object's docstring before it is parsed."""
        if obj.docstring is not None:
            obj.docstring.value = without_roles(fenced(obj.docstring.value))


def without_roles(text):
    """Return a docstring with names in place of references such as ``:class:`~a.b.Name```."""
    shown = re.sub(r":[a-z]+:`~(?:\w+\.)*(\w+)`", r"`\1`", text)
    return re.sub(r":[a-z]+:`([^`]+)`", r"`\1`", shown)


def fenced(text):
    """Return a docstring with fences around its doctests, without doctest's own comments."""
    text = re.sub(r" +# doctest: .*$", "", text, flags=re.MULTILINE)
    block = r"^( *)>>> .*(?:\n.*\S.*)*"  # up to an empty line
    return re.sub(block, r"\1```pycon\n\g<0>\n\1```", text, flags=re.MULTILINE)


def examples():
    """The list of the examples, with the code of each below it."""
    folder = ROOT / "examples"
    text = (folder / "README.md").read_text(encoding="utf-8")
    # links between the files become links to the code below
    text = re.sub(r"\[(\w+)\.py\]\(\w+\.py\)", r"[\1.py](#\1py)", text)
    text = re.sub(r"\[(\w+\.ipynb)\]\(\w+\.ipynb\)", r"`\1`", text)
    for path in sorted(folder.glob("*.py")):
        code = path.read_text(encoding="utf-8")
        text += f"\n## {path.name}\n\n```python\n{code}```\n"
    return text


def on_page_markdown(markdown, **_):
    """Return a page whose link to the list of the examples leads to their page here."""
    return markdown.replace("](../examples/README.md)", "](examples.md)")


def on_files(files, config):
    """Add ``index.md`` (the README) and ``api/NAME.md`` for every public name."""
    readme = (
        (ROOT / "README.md")
        .read_text(encoding="utf-8")
        .replace("](docs/", "](")
        .replace("](examples/README.md)", "](examples.md)")
    )
    names = "".join(f"- [`{name}`]({name}.md)\n" for name in hybridvo._HOME)
    pages = {
        "index.md": readme,
        "examples.md": examples(),
        "api/index.md": f"# API reference\n\n{names}",
    }
    for name, module in hybridvo._HOME.items():
        pages[f"api/{name}.md"] = f"# {name}\n\n::: hybridvo.{module}.{name}\n"
    for path, text in pages.items():
        files.append(File.generated(config, path, content=text))
    return files
