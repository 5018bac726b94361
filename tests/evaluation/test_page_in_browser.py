"""The page's script in a real browser, where one is installed: it runs without an error and draws what it should."""

import re
import shutil
import subprocess

import pytest

from tab_marl.evaluation.report import page as report

BROWSER = next(
    (path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), None
)

pytestmark = pytest.mark.skipif(BROWSER is None, reason="no Chromium installed")

# Reports what the script made of the page, by way of the document's title.
PROBE = """<script>addEventListener("load", () => {
  const canvas = document.querySelector("#stage canvas"), data = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
  const colours = new Set(); for (let i = 0; i < data.length; i += 4) colours.add(data[i] << 16 | data[i + 1] << 8 | data[i + 2]);
  const before = document.getElementById("clock").textContent;
  const press = key => document.getElementById("stage").dispatchEvent(new KeyboardEvent("keydown", { key, bubbles: true, cancelable: true }));
  document.getElementById("restart").click(); const start = document.getElementById("clock").textContent;
  press("ArrowRight"); const stepped = document.getElementById("clock").textContent;
  for (let i = 0; i < 10; i++) press("ArrowRight");
  document.getElementById("theme").click();
  document.title = JSON.stringify({ panels: document.querySelectorAll("#stage canvas").length, colours: colours.size > 20, before, start, stepped,
    end: document.getElementById("clock").textContent, state: document.querySelector("#stage .state").textContent,
    theme: document.documentElement.dataset.theme, overflow: document.documentElement.scrollWidth > innerWidth });
});</script></body>"""


def open_page(path, width):
    return subprocess.run(
        [
            BROWSER, "--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking", "--enable-logging=stderr",
            f"--window-size={width},900", "--virtual-time-budget=3000", "--dump-dom", path.as_uri(),
        ],
        check=False, capture_output=True, text=True, timeout=120,
    )  # fmt: skip


@pytest.mark.parametrize("width", [1280, 500])
def test_script_runs_and_draws(tmp_path, data, width):
    page = report.render(data)
    path = tmp_path / "report.html"
    path.write_text(page.replace("</body>", PROBE), encoding="utf-8")
    done = open_page(path, width)
    assert not re.search(r"CONSOLE.*(Uncaught|Error|Refused)", done.stderr), done.stderr
    import json
    from html import unescape

    found = json.loads(unescape(re.search(r"<title>(\{.*?\})</title>", done.stdout)[1]))
    assert found == {
        "panels": 2,
        "colours": True,
        "before": "1.3 s",  # opens at 70 % of the shorter episode, so that there is something to see
        "start": "0.0 s",
        "stepped": "0.5 s",
        "end": "1.9 s",
        "state": "intercepted at 1.5 s",
        "theme": "dark",
        "overflow": False,
    }
