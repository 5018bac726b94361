"""The page in a real browser, where one is installed: clicked, typed at, on a phone, in the dark, and never on the network."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))
import chromium

sys.path.pop(0)

pytestmark = pytest.mark.skipif(chromium.PROGRAM is None, reason="no Chromium installed")

WIDTHS = {"phone": 360, "desk": 1280}
CLOCK = "parseFloat(document.getElementById('clock').textContent)"
PLAYING = "document.getElementById('play').textContent == 'Pause'"
PICTURE = """(() => { const c = document.querySelector('#stage canvas'); return c.toDataURL(); })()"""
PRESSED = "document.getElementById('{}').getAttribute('aria-pressed')"


@pytest.fixture(scope="module")
def browser():
    found = chromium.Chromium()
    yield found
    found.close()


@pytest.fixture
def path(tmp_path, page):
    written = tmp_path / "report.html"
    written.write_text(page, encoding="utf-8")
    return written


def assert_quiet(browser, path):
    assert browser.complaints == []
    assert browser.requests == [path.as_uri()]  # the page itself, and nothing else


@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
@pytest.mark.parametrize("width", WIDTHS.values(), ids=WIDTHS)
def test_page_fits_and_follows_the_theme(browser, path, width, dark):
    browser.open(path, width, dark=dark)
    assert browser.run("document.documentElement.scrollWidth <= innerWidth")
    # What is wider than the page scrolls in a box of its own, which the keyboard reaches.
    wide = """[...document.querySelectorAll('table')].filter(t => t.offsetParent && t.scrollWidth > innerWidth).every(t => t.closest('.scroll'))"""
    assert browser.run(wide)
    luminance = "getComputedStyle(document.body).backgroundColor.match(/\\d+/g).map(Number).reduce((a, b) => a + b)"
    assert (browser.run(luminance) < 200) == dark
    browser.click("#theme")
    assert (browser.run(luminance) < 200) != dark
    assert browser.run("document.getElementById('theme').textContent") == ("Dark" if dark else "Light")
    colours = "new Set([...document.querySelectorAll('svg.chart .mark')].map(m => getComputedStyle(m).stroke)).size"
    assert browser.run(colours) == 6  # the paper's four, ours with precedents, and one for all references
    assert_quiet(browser, path)


@pytest.mark.parametrize("width", WIDTHS.values(), ids=WIDTHS)
def test_player_by_mouse(browser, path, width):
    browser.open(path, width)
    assert browser.run("document.querySelectorAll('#stage canvas').length") == 2
    assert browser.run(CLOCK) == 1.3  # opens where every planner is still under way
    browser.click("#restart")
    assert browser.run(CLOCK) == 0
    browser.run(
        "document.getElementById('speed').value = '0.5'; document.getElementById('speed').dispatchEvent(new Event('change'))"
    )
    browser.click("#play")
    browser.wait(f"{PLAYING} && {CLOCK} > 0.2")
    browser.click("#play")
    stopped = browser.run(CLOCK)
    assert not browser.run(PLAYING)
    browser.run("new Promise(done => setTimeout(done, 200))")
    assert browser.run(CLOCK) == stopped < 1.9
    # Twice as fast in half the time, to the end, where it stops by itself.
    browser.run(
        "document.getElementById('speed').value = '8'; document.getElementById('speed').dispatchEvent(new Event('change'))"
    )
    browser.click("#play")
    browser.wait(f"!({PLAYING}) && {CLOCK} == 1.9")
    assert browser.run("document.querySelector('#stage .state').textContent") == "intercepted at 1.5 s"
    browser.click("#scrub", 0.5)
    assert 0.7 <= browser.run(CLOCK) <= 1.2
    for layer in ("belief", "field", "trails"):
        before = browser.run(PICTURE)
        browser.click(f"#{layer}")
        assert browser.run(PRESSED.format(layer)) == "false"
        assert browser.run(PICTURE) != before, layer
        browser.click(f"#{layer}")
        assert browser.run(PICTURE) == before, layer
    browser.click("#groups button:nth-child(2)")
    assert browser.run("document.querySelector('#groups [aria-selected=true]').textContent") == "M5, point, episode 3"
    assert_quiet(browser, path)


def test_player_by_keyboard(browser, path):
    browser.open(path, 1280)
    browser.run("document.getElementById('stage').focus()")
    browser.press("Home")
    assert browser.run(CLOCK) == 0
    browser.press("ArrowRight")
    assert browser.run(CLOCK) == 0.5
    browser.press("ArrowRight", shift=True)
    assert browser.run(CLOCK) == 1.9  # five seconds on, held at the end
    browser.press("ArrowLeft")
    assert browser.run(CLOCK) == 1.4
    browser.press("f")
    assert browser.run(PRESSED.format("field")) == "false"
    browser.press("b")
    assert browser.run(PRESSED.format("belief")) == "false"
    browser.press("+")
    assert browser.run("document.getElementById('speed').value") == "8"
    browser.press("Home")
    browser.press(" ")
    browser.wait(f"{CLOCK} > 0")
    browser.wait(f"!({PLAYING})")
    # Space on a button presses that button and nothing else; tab leads on to the next control.
    browser.run("document.getElementById('restart').focus()")
    browser.press(" ")
    assert browser.run(CLOCK) == 0 and not browser.run(PLAYING)
    browser.press("Tab")
    assert browser.run("document.activeElement.id") == "scrub"
    outline = "getComputedStyle(document.activeElement).outlineStyle"
    assert browser.run(outline) != "none"  # focus can be seen
    assert_quiet(browser, path)


def test_every_control_has_a_name(browser, path):
    browser.open(path, 1280)
    browser.call("Accessibility.enable")
    nodes = browser.call("Accessibility.getFullAXTree")["nodes"]
    browser.call("Accessibility.disable")
    named = [
        (n["role"]["value"], n.get("name", {}).get("value", ""))
        for n in nodes
        if not n["ignored"] and n["role"]["value"] in ("button", "slider", "combobox", "image", "tab", "link", "region")
    ]
    assert len(named) > 30
    assert [role for role, name in named if not name.strip()] == []
    roles = dict(named)
    assert roles.keys() >= {"button", "slider", "combobox", "image", "tab", "link", "region"}


def test_a_planner_is_hidden_everywhere_at_once(browser, path):
    browser.open(path, 1280)
    shown = "[...document.querySelectorAll('svg.chart g.p-s, #stage .p-s')].filter(g => getComputedStyle(g).display != 'none').length"
    assert browser.run(shown) > 5
    browser.click("#results [data-planner=p-s]")
    assert browser.run(shown) == 0
    pressed = "[...document.querySelectorAll('[data-planner=p-s]')].map(b => b.getAttribute('aria-pressed')).join()"
    assert set(browser.run(pressed).split(",")) == {"false"}
    browser.click("#time [data-planner=p-s]")
    assert browser.run(shown) > 5
    assert_quiet(browser, path)


def test_less_motion_means_fewer_pictures(browser, path):
    count = "(() => { window.seen = new Set(); const clock = document.getElementById('clock'); new MutationObserver(() => window.seen.add(clock.textContent)).observe(clock, { childList: true }); })()"
    steps = {}
    for calm in (False, True):
        browser.open(path, 1280, calm=calm)
        browser.run(
            "document.getElementById('speed').value = '2'; document.getElementById('speed').dispatchEvent(new Event('change'))"
        )
        browser.click("#restart")
        browser.run(count)
        browser.click("#play")
        browser.wait(f"!({PLAYING}) && {CLOCK} == 1.9")
        steps[calm] = browser.run("window.seen.size")
    assert steps[True] <= 5 < steps[False]
    browser.run("document.querySelector('nav a').click()")
    assert browser.run("getComputedStyle(document.documentElement).scrollBehavior") == "auto"
