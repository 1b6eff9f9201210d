"""What README.md and the pages of docs/ print is true: code runs, commands compose, links lead somewhere."""

import pydoc
import re
import shlex
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.override_parser.overrides_parser import OverridesParser

from torchfovea.cli import COMMANDS
from torchfovea.commands.shared.config import conf_dir
from torchfovea.commands.shared.mistakes import arranged

ROOT = Path(__file__).resolve().parents[1]
PAGES = {
    str(path.relative_to(ROOT)): path.read_text(encoding="utf-8")
    for path in (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md")))
}
# language, what else stands behind it, the block
BLOCK = re.compile(r"^( *)```(\w*)([^\n]*)\n(.*?)^\1```", re.DOTALL | re.MULTILINE)
FILE = re.compile(r"# ([\w./-]+\.(?:py|yaml))$")
MISTAKE = re.compile(r"torchfovea \w+: ")  # what a command says of a mistake
OURS = ("torchfovea ", "bash scripts/run.sh")


def blocks(page: str) -> list[tuple[str, str, str]]:
    """A page's blocks that can run: their language, what stands behind it, and the text."""
    found = []
    for indent, language, behind, text in BLOCK.findall(PAGES[page]):
        if "not run" in behind:
            assert re.search(r'title="not run: .+"', behind), f"{page}: say why and where the reader sees it"
            continue
        found.append((language, behind, "\n".join(line.removeprefix(indent) for line in text.splitlines())))
    return found


def write_files(page: str, folder: Path) -> list[tuple[str, str]]:
    """Write the blocks that are files; the others with their language."""
    others = []
    for language, _, text in blocks(page):
        named = FILE.match(text.partition("\n")[0])
        if named and language in ("python", "yaml"):
            path = folder / named[1]
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")
        else:
            others.append((language, text))
    return others


def commands(page: str, others: list[tuple[str, str]]) -> list[str]:
    """The command lines of a page: in its blocks and, without `...`, in its text."""
    lines = [line for language, text in others if language in ("bash", "") for line in joined(text)]
    prose = BLOCK.sub("", PAGES[page])
    lines += [" ".join(code.split()) for code in re.findall(r"`([^`]+)`", prose) if "..." not in code]
    return [line for line in lines if line.startswith(OURS) and not MISTAKE.match(line)]


def joined(text: str) -> list[str]:
    return [line.strip() for line in text.replace("\\\n", " ").splitlines()]


def check(line: str) -> None:
    """Compose a command as Hydra would; of what is swept, the first value."""
    words = shlex.split(line, comments=True)
    command, arguments = (words[1], words[2:]) if words[0] == "torchfovea" else ("search", words[2:])
    if command in ("COMMAND", "--help", "--version") or "--help" in arguments:
        return
    assert command in COMMANDS, line
    flags = [word for word in arranged(arguments) if word.startswith("-")]
    settings = [word for word in arranged(arguments) if "=" in word and not word.startswith("-")]
    swept = "--multirun" in flags or "-m" in flags or "experiment=" in line
    parser, chosen = OverridesParser.create(), []
    for override in parser.parse_overrides(settings):
        if override.is_sweep_override():
            assert swept, f"{line}: {override.input_line} needs --multirun"
            first = next(iter(override.sweep_string_iterator()))
            chosen.append(f"{override.get_key_element()}={first}")
        else:
            chosen.append(override.input_line)
    if "--config-dir" in arguments:
        folder = Path(arguments[arguments.index("--config-dir") + 1]).absolute()
        if folder.is_dir():  # a page's own; a run's does not exist here
            chosen.append(f"hydra.searchpath=[file://{folder}]")
        else:
            return
    compose(command, chosen, return_hydra_config=True)


@pytest.mark.parametrize("page", PAGES)
def test_what_a_page_prints_runs(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    others = write_files(page, tmp_path)
    with initialize_config_dir(conf_dir(), version_base="1.3"):
        for line in dict.fromkeys(commands(page, others)):
            try:
                check(line)
            except Exception as error:
                raise AssertionError(f"{page}: {line}") from error
    if page == "README.md":  # the next test runs it, and looks at what it found
        return
    names: dict = {"__name__": "__main__"}
    for k, (language, text) in enumerate(others):
        if language == "python":
            exec(compile(text, f"{page}, block {k}", "exec"), names)


def test_the_readme_finds_the_nearest_object(tmp_path, monkeypatch, capsys):
    """Its loop, with the commands' own matcher and budget, ends at the true nearest object."""
    ((_, _, example),) = [block for block in blocks("README.md") if block[0] == "python"]
    names: dict = {}
    exec(compile(example, "README.md", "exec"), names)
    assert "is surely nearest; in truth" in capsys.readouterr().out
    step, world = names["step"], names["world"]
    assert (step.points.mean[names["sure"]] - world.scene.nearest_point_e).norm() < 0.15


def test_the_readme_is_read_in_three_minutes():
    assert len(PAGES["README.md"].splitlines()) <= 150


def test_every_equation_of_the_paper_has_its_code():
    table = PAGES["docs/paper.md"].split("## Each equation\n")[1].split("\n## ")[0]
    assert [int(number) for number in re.findall(r"Eq\. (\d+)", table)] == list(range(1, 56))
    for name in re.findall(r"`(\w+\.[\w.]+)`", table):
        assert pydoc.locate(f"torchfovea.{name}"), name


def test_every_command_is_named():
    for page in ("README.md", "docs/commands.md"):
        assert set(re.findall(r"^\| `(\w+)` \|", PAGES[page], re.MULTILINE)) == set(COMMANDS), page


@pytest.mark.parametrize("name", COMMANDS)
def test_the_examples_of_the_help_compose(name):
    examples = COMMANDS[name].examples
    assert len(examples) == 3
    with initialize_config_dir(conf_dir(), version_base="1.3"):
        for line in examples:
            assert line.startswith(f"torchfovea {name}")
            check(line)


@pytest.mark.parametrize("page", ["README.md", "CONTRIBUTING.md"])  # those of the site are the next test's
def test_links_lead_somewhere(page):
    folder = (ROOT / page).parent
    text = BLOCK.sub("", PAGES[page])
    for target in re.findall(r"\]\((?!\w+://|mailto:)([^)#\s]+)[^)]*\)", text):
        assert (folder / target).exists(), f"{page}: {target}"
