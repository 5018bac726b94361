"""The documentation site: built strictly, complete, and nothing in it is fetched from elsewhere."""

from __future__ import annotations

import importlib.util
import os
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import pettingzoo
import pytest
import yaml

from tab_marl.envs.registration import BATCHED_IDS, ENVIRONMENTS

ROOT = Path(__file__).parent.parent.parent
PICTURE_BYTES, ANIMATION_BYTES = 150_000, 300_000


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("site")
    subprocess.run([sys.executable, ROOT / "scripts" / "link_typecheck.py"], check=True, cwd=ROOT)
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(out)]
    done = subprocess.run(
        command, check=False, cwd=ROOT, env={**os.environ, "NO_MKDOCS_2_WARNING": "1"}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return out


class _Fetched(HTMLParser):
    """What a browser would fetch to show a page."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []
        self.classes: set[str] = set()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value or "" for name, value in attrs}
        self.classes |= set(given.get("class", "").split())
        if tag == "link" and given.get("rel") in ("canonical", "prev", "next", "alternate"):
            return
        if tag in ("script", "img", "iframe", "source", "video", "link", "object", "embed"):
            self.found += [given[name] for name in ("src", "href", "srcset", "data") if given.get(name)]


def test_nothing_comes_from_the_network(site: Path) -> None:
    pages = sorted(site.rglob("*.html"))
    assert len(pages) > 40
    for page in pages:
        parser = _Fetched()
        text = page.read_text()
        parser.feed(text)
        outside = [url for url in parser.found if re.match(r"(?:[a-z]+:)?//", url)]
        assert not outside, f"{page.name} fetches {outside}"
        assert "mermaid" not in parser.classes, "the theme would fetch a script for it"
    for sheet in site.rglob("*.css"):
        assert not re.search(r"(?:url\(|@import)\s*['\"]?(?:https?:)?//", sheet.read_text()), sheet


def test_the_reference_shows_what_it_should(site: Path) -> None:
    """The folders that import as tab_marl.envs and tab_marl.agents are found, and docstrings are in."""
    envs, agents = ((site / "api" / f"{name}.html").read_text() for name in ("envs", "agents"))
    for name in ("tab_marl.envs.intercept.InterceptEnv", "tab_marl.envs.batched_arenas.BatchedArenas"):
        assert f'id="{name}"' in envs
    assert 'id="tab_marl.agents.policies.zoo.find_policy"' in agents
    assert "Advance by one control step" in envs
    assert "tab_marl.envs.motion_kernels.drive" not in envs, "compiled loops are not for users"


def test_every_environment_has_its_page_in_the_menu() -> None:
    nav = yaml.safe_load(re.sub(r"!!python/\S+", "", (ROOT / "mkdocs.yml").read_text()))["nav"]
    listed = set(re.findall(r"environments/([\w-]+)\.md", str(nav)))
    assert listed >= {e.name for e in ENVIRONMENTS} | {"index", "batched", "training", "rendering", "speed"}
    images = ROOT / "docs" / "images" / "environments"
    for e in ENVIRONMENTS:
        assert 5_000 < (images / f"{e.name}.png").stat().st_size < PICTURE_BYTES, e.name
        assert 5_000 < (images / f"{e.name}.webp").stat().st_size < ANIMATION_BYTES, e.name
    batched = (ROOT / "docs" / "environments" / "batched.md").read_text()
    assert all(name in batched for name in BATCHED_IDS)


@pytest.fixture(scope="module")
def writer():
    spec = importlib.util.spec_from_file_location("environment_pages", ROOT / "scripts" / "environment_pages.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_pages_are_what_the_code_says(writer) -> None:
    for name, text in writer.pages().items():
        found = (ROOT / "docs" / "environments" / name).read_text()
        assert found == text, f"docs/environments/{name} is out of date: run python scripts/environment_pages.py"


def rows_of(page: str, heading: str) -> list[list[str]]:
    """Cells of the first table below a heading."""
    table = page.split(f"\n## {heading}\n")[1].split("\n## ")[0]
    lines = [line for line in table.splitlines() if line.startswith("| ")]
    return [
        [cell.strip() for cell in line.strip("|").split(" | ")] for line in lines[1:] if not line.startswith("| ---")
    ]


def expanded(rows: list[list[str]]) -> list[tuple[str, float, float]]:
    """(name, min, max) per index, in order; the indices must count up from 0."""
    found = []
    for row in rows:
        first, _, last = row[0].partition(" to ")
        for i in range(int(first), int(last or first) + 1):
            assert i == len(found), f"row {row[0]} does not follow {len(found) - 1}"
            found.append((row[1], float(row[-2]), float(row[-1])))
    return found


@pytest.mark.parametrize("name", ["intercept", "intercept-U5", "avoidance", "surveillance-random", "team"])
def test_tables_against_the_spaces(name) -> None:
    """Read back from the page: one row per entry, with the bounds of the space that the environment declares."""
    (environment,) = (e for e in ENVIRONMENTS if e.name == name)
    page = (ROOT / "docs" / "environments" / f"{name}.md").read_text()
    env = pettingzoo.make("parallel", environment.pettingzoo_id)
    spaces = {
        "What the ego observes": env.observation_space("ego_0"),
        "What the adversary observes": env.observation_space("adversary_0"),
        "State for centralised critics": env.unwrapped.state_space,
    }
    for heading, space in spaces.items():
        entries = expanded(rows_of(page, heading))
        assert [low for _, low, _ in entries] == pytest.approx(space.low.tolist(), abs=1e-5), heading
        assert [high for _, _, high in entries] == pytest.approx(space.high.tolist(), rel=1e-5), heading
    for made in environment.gymnasium_ids:
        assert f"`{made}`" in page
