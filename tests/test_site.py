"""The documentation builds without a warning, asks no network, and has a page for every module."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(folder)],
        capture_output=True,
        text=True,
        cwd=ROOT,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
        timeout=280,
    )
    assert (done.returncode, done.stdout + done.stderr) == (0, "")
    return {path.relative_to(folder).as_posix(): path.read_text(encoding="utf-8") for path in folder.rglob("*.html")}


def test_pages_load_nothing_from_elsewhere(site):
    for name, text in site.items():
        loaded = re.findall(r'<(?:script|img|link|iframe)\b[^>]*?(?:src|href)="?(https?:|//)[^">\s]*', text)
        assert not loaded, f"{name}: {loaded}"


def test_every_module_is_documented(site):
    reference = "".join(text for name, text in site.items() if name.startswith("reference/"))
    missing = [
        module
        for path in (ROOT / "torchfovea").rglob("*.py")
        if not path.name.startswith("_") and "commands" not in path.parts
        for module in [".".join(path.relative_to(ROOT).with_suffix("").parts)]
        if f'id="{module}"' not in reference
    ]
    assert not missing


def test_every_page_is_in_the_navigation(site):
    for path in (ROOT / "docs").rglob("*.md"):
        page = path.relative_to(ROOT / "docs").with_suffix(".html").as_posix()
        assert f'href="{page}"' in site["index.html"].replace('href="./', 'href="'), page


def test_the_front_door_leads_to_every_name(site):
    import torchfovea

    for name in torchfovea.__all__:
        assert f">tf.{name}</code></a>" in site["reference/index.html"], name
