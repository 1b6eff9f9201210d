"""MkDocs hooks: the first page and the changes from the repository's own files, the reference from docstrings."""

import ast
import json
import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "torchfovea"
OVERVIEW = "reference/index.md"


def on_config(config: MkDocsConfig) -> None:
    """Name the pages of docs/ that the navigation does not, and those of the reference."""
    known = re.findall(r"[\w/-]+\.md", str(config.nav))
    arrived = sorted(path.name for path in Path(config.docs_dir).glob("*.md") if path.name not in known)
    for section in config.nav or []:
        if "Guides" in section:
            section["Guides"] += arrived
        if "Reference" in section:
            section["Reference"] = [OVERVIEW, *(f"reference/{name}.md" for name in rooms())]
        if "Examples" in section:
            section["Examples"] = [f"examples/{path.stem}.md" for path in examples()]


def on_files(files: Files, config: MkDocsConfig) -> None:
    """Make the pages that are not written but follow."""
    made = {"index.md": of_the_site("README.md"), "changes.md": of_the_site("CHANGELOG.md"), OVERVIEW: front_door()}
    made |= {f"reference/{name}.md": page_of(name, modules) for name, modules in rooms().items()}
    made |= {f"examples/{path.stem}.md": shown(path) for path in examples()}
    for uri, text in made.items():
        files.append(File.generated(config, uri, content=text))


def on_page_markdown(markdown: str, **_: object) -> str:
    """Lead to the site's own page of an example, and from a picture to itself at full size."""
    markdown = re.sub(r"\]\((?:\.\./)*examples/(\w+)\.(?:py|ipynb)\)", r"](examples/\1.md)", markdown)
    return re.sub(r"^(!\[[^]]+\]\(([^)]+)\))$", r"[\1](\2)", markdown, flags=re.MULTILINE)


def examples() -> list[Path]:
    """The example files, scripts and notebooks."""
    return sorted(path for path in (ROOT / "examples").iterdir() if path.suffix in (".py", ".ipynb"))


def shown(path: Path) -> str:
    """An example as a page."""
    text = path.read_text(encoding="utf-8")
    cells = json.loads(text)["cells"] if path.suffix == ".ipynb" else [{"cell_type": "code", "source": text}]
    parts = ((cell["cell_type"], "".join(cell["source"]).rstrip()) for cell in cells)
    # a notebook's own headline is one too many
    shown = (f"```python\n{part}\n```" if kind == "code" else re.sub(r"^# ", "## ", part) for kind, part in parts)
    return "\n\n".join([f"# {path.name}", f"`examples/{path.name}`", *shown]) + "\n"


def of_the_site(name: str) -> str:
    """A page of the repository's root whose links lead into the site."""
    text = (ROOT / name).read_text(encoding="utf-8").replace("](docs/", "](")
    text = text.replace("](CHANGELOG.md)", "](changes.md)")
    return re.sub(r"\[([^]]+)\]\((?:CONTRIBUTING\.md|CITATION\.cff)\)", r"\1", text)


def rooms() -> dict[str, list[str]]:
    """The package's folders, what stands beside them being one too, and their public modules."""
    found: dict[str, list[str]] = {"torchfovea": []}
    for path in sorted(PACKAGE.rglob("*.py")):
        module = path.relative_to(ROOT).with_suffix("").parts
        if module[-1].startswith("_") or module[1] == "commands":
            continue
        room = module[1] if len(module) > 2 else "torchfovea"
        found.setdefault(room, []).append(".".join(module))
    return found


def page_of(name: str, modules: list[str]) -> str:
    """The reference of a folder."""
    title = "torchfovea" if name == "torchfovea" else f"torchfovea.{name}"
    return "\n\n".join([f"# {title}", *(f"::: {module}" for module in modules)])


def front_door() -> str:
    """What `import torchfovea` offers, each name leading to where it is documented."""
    tree = ast.parse((PACKAGE / "__init__.py").read_text(encoding="utf-8"))
    names = {
        alias.name: node.module
        for node in tree.body
        if isinstance(node, ast.ImportFrom) and node.module
        for alias in node.names
    }
    lines = [f"| [`tf.{name}`][{module}.{name}] | `{module}` |" for name, module in sorted(names.items())]
    text = (ast.get_docstring(tree) or "").replace("\n\n", " ")
    head = ["# Reference", "", f"`import torchfovea as tf`. {text}", "", "| name | from |", "|---|---|"]
    return "\n".join([*head, *lines])
