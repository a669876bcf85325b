"""The page in a real browser: the token once, what is shown, and what the buttons do."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from aquaflow.config.service import ListenConfig, ViewerConfig
from aquaflow.live.health import http
from aquaflow.survey.viewer.page import ViewerPage
from tests.browser import Browser, needs_browser
from tests.live.page.scenes import SimulatedDive, with_buttons

pytestmark = [pytest.mark.ci, needs_browser]

TOKEN = "correct-horse-battery"
ESCAPE, ENTER = "\ue00c", "\ue007"
"""As WebDriver names these keys."""
PHONE, DESKTOP = (390, 1800), (1280, 1000)
PICTURES = os.environ.get("AQUAFLOW_PAGE_PICTURES")
"""Folder that gets the screenshots, to look at them."""


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    browser = Browser(tmp_path_factory.mktemp("profile"))
    yield browser
    browser.close()


@pytest.fixture
def dive() -> SimulatedDive:
    return SimulatedDive()


@pytest.fixture
def address(dive: SimulatedDive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Of the real server, with the dive's requests simulated."""
    token = tmp_path / "token"
    token.write_text(TOKEN)
    token.chmod(0o600)
    monkeypatch.setattr(http, "_Answers", with_buttons(http._Answers, dive))
    config = ListenConfig.model_construct(host="127.0.0.1", port=0, token_file=token)
    server = http.HealthServer(config, dive.report, dive.path, coverage=dive)
    yield f"http://127.0.0.1:{server.port}/"
    server.close()


def log_in(browser: Browser, address: str) -> None:
    browser.forget()
    browser.open(address)
    browser.wait("!document.querySelector('#login').hidden")
    browser.type("#token", TOKEN)
    browser.click("#login button")
    browser.wait("!document.querySelector('main').hidden")
    browser.wait("document.querySelector('#plan-frame polyline')")
    browser.wait("document.querySelector('#picture-frame img')")


def keep(browser: Browser, name: str) -> None:
    """A picture for people; only where they ask for it."""
    if PICTURES is not None:
        browser.screenshot(Path(PICTURES) / f"{name}.png")


def test_the_token_is_asked_for_once(browser: Browser, address: str) -> None:
    browser.emulate(*PHONE)
    browser.forget()
    browser.open(address)
    browser.wait("!document.querySelector('#login').hidden")
    browser.type("#token", "wrong-wrong-wrong-wrong")
    browser.click("#login button")
    browser.wait("document.querySelector('#refused').textContent")
    assert "not the token" in browser.text("#refused")
    keep(browser, "login")
    browser.run("document.querySelector('#token').value = ''")
    browser.type("#token", TOKEN)
    browser.click("#login button")
    browser.wait("document.querySelector('#state').textContent === 'Tracking'")
    browser.open(address)
    browser.wait("document.querySelector('#state').textContent === 'Tracking'")
    assert TOKEN not in browser.run("return document.cookie + location.href")


@pytest.mark.parametrize("size", [DESKTOP, PHONE], ids=["desktop", "phone"])
@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
def test_everything_is_shown_and_nothing_is_wider_than_the_screen(
    browser: Browser, address: str, size: tuple[int, int], dark: bool
) -> None:
    browser.emulate(*size, dark=dark)
    log_in(browser, address)
    assert browser.run("return document.documentElement.scrollWidth") <= size[0]
    ground = browser.run("return getComputedStyle(document.body).backgroundColor")
    assert (sum(map(int, ground[4:-1].split(","))) < 200) == dark
    assert browser.text("#reason") == "every frame has a pose"
    assert {"12.37 m", "1.82 m", "214°"} <= set(browser.text("#now").splitlines())
    assert "metres ± 1.8 %, from dvl" in browser.text("#scale")
    assert "nothing heard yet" in browser.text("#devices")
    assert "up: magnetic north" in browser.text("#plan-note")
    assert browser.run("return document.querySelector('#viewer').href").endswith(":8231/")
    keep(browser, f"{size[0]}-{'dark' if dark else 'light'}")


def test_buttons_ask_for_what_is_possible_and_confirm_what_cannot_be_undone(
    browser: Browser, address: str, dive: SimulatedDive
) -> None:
    browser.emulate(*DESKTOP)
    log_in(browser, address)
    possible = "[...document.querySelectorAll('nav button:enabled')].map(b => b.innerText).join()"
    assert browser.run(f"return {possible}") == "Stop,Finish,New dive"
    browser.click("[data-action=stop]")
    browser.wait(f"{possible} === 'Continue,Finish,New dive'")
    browser.click("[data-action=finish]")
    browser.wait("document.querySelector('dialog').open")
    keep(browser, "dialog")
    browser.press(ESCAPE)
    browser.wait("!document.querySelector('dialog').open")
    assert dive.asked == ["stop"]
    browser.run("document.querySelector('[data-action=finish]').focus()")
    browser.press(ENTER)
    browser.wait("document.querySelector('dialog').open")
    browser.click("#agree")
    browser.wait(f"{possible} === 'Start,New dive'")
    assert dive.asked == ["stop", "finish"]


def test_a_question_asked_right_after_another_was_closed_is_answered_for_itself(
    browser: Browser, address: str, dive: SimulatedDive
) -> None:
    log_in(browser, address)
    browser.click("[data-action=finish]")
    browser.run(
        "document.querySelector('dialog').close();"
        "document.querySelector('[data-action=finish]').click()"
    )
    browser.wait("document.querySelector('dialog').open")
    browser.click("#agree")
    browser.until(lambda: dive.asked == ["finish"], "the dive's end")


def test_what_the_vehicle_refuses_is_said(
    browser: Browser, address: str, dive: SimulatedDive
) -> None:
    log_in(browser, address)
    dive.refusal = "the disk is full: 12 MB left"
    browser.click("[data-action=stop]")
    browser.wait("!document.querySelector('#message').hidden")
    assert browser.text("#message") == "The disk is full: 12 MB left"


def test_without_a_dive_to_control_there_are_no_buttons_and_a_silent_server_is_said(
    browser: Browser, address: str, dive: SimulatedDive
) -> None:
    dive.controlled = False
    log_in(browser, address)
    assert browser.run("return document.querySelector('#buttons').hidden")
    browser.run("window.fetch = () => Promise.reject(new Error('no network'))")
    browser.wait("document.querySelector('#state').textContent === 'No answer'")


class OtherPage(BaseHTTPRequestHandler):
    """An empty page of another service."""

    def do_GET(self) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "text/html")
        self.send_header("Content-Length", "0")
        self.end_headers()

    def log_message(self, format: str, *args: object) -> None: ...


def test_who_has_opened_the_page_may_open_the_viewer(
    browser: Browser, address: str, tmp_path: Path
) -> None:
    """Cookies know no ports."""
    page = ViewerPage(ViewerConfig(port=0, token_file=tmp_path / "token"), "the viewer")
    viewer = page.address
    browser.forget()
    browser.open(viewer)
    assert "Give the token" in browser.text("body")
    log_in(browser, address)
    browser.open(viewer)
    browser.wait("document.title === 'the viewer'")
    page.close()


def framed(browser: Browser, address: str, by: str) -> bool:
    """Whether a page of the host ``by`` may show ours in a frame."""
    browser.open(by)
    browser.run(
        """const frame = document.createElement("iframe");
        frame.onload = () => { window.loaded = true; };
        frame.src = arguments[0];
        document.body.replaceChildren(frame);""",
        address,
    )
    browser.wait("window.loaded")
    return "page.js" in browser.in_frame("return document.documentElement.outerHTML")


def test_only_pages_of_the_same_machine_may_frame_it(browser: Browser, address: str) -> None:
    """BlueOS frames its extensions from another port; a page of elsewhere may not."""
    blueos = ThreadingHTTPServer(("127.0.0.1", 0), OtherPage)
    threading.Thread(target=blueos.serve_forever, args=(0.05,), daemon=True).start()
    port = blueos.server_address[1]
    log_in(browser, address)
    assert framed(browser, address, f"http://127.0.0.1:{port}/")
    state = "return document.querySelector('#state').textContent"
    browser.until(lambda: browser.in_frame(state) == "Tracking", "the token's cookie in a frame")
    assert not framed(browser, address, f"http://localhost:{port}/")
    blueos.shutdown()
    blueos.server_close()


def test_the_plan_shows_what_was_seen_and_the_next_line(
    browser: Browser, address: str, dive: SimulatedDive
) -> None:
    dive.cover()
    browser.emulate(*DESKTOP)
    log_in(browser, address)
    browser.wait("document.querySelector('#plan-frame image')")
    assert "seen well:" in browser.text("#coverage-key")
    assert "overlap to the last line" in browser.text("#coverage-note").lower()
    assert browser.text("#hints") == "Too fast for the wanted overlap: 41 %"
    inside = """
        const frame = document.querySelector('#plan-frame').getBoundingClientRect();
        return [...document.querySelectorAll('#plan-frame :is(image, .path, .next)')].map(each => {
            const box = each.getBoundingClientRect();
            return box.left >= frame.left - 1 && box.right <= frame.right + 1
                && box.top >= frame.top - 1 && box.bottom <= frame.bottom + 1;
        });
    """
    assert browser.run(inside) == [True, True, True]
    keep(browser, "coverage")
    browser.emulate(*PHONE, dark=True)
    keep(browser, "coverage_phone_dark")
