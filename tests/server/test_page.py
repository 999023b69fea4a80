"""The page in a real browser: who sees and does what, by pointer, keyboard and touch, live, and readable for everybody.

`make browser` installs a Chromium, and fetches axe-core; any Chromium on the path will do, or `CHROMIUM=/path/to/it`.
Without one these tests are skipped. `PICTURES=FOLDER` keeps the screenshots.
"""

from __future__ import annotations

import base64
import fcntl
import io
import json
import os
import re
import shutil
import signal
import threading
import time
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import pytest

pytest.importorskip("fastapi", reason="a server needs evermap[server]")
pytest.importorskip("httpx", reason="needs httpx: pip install 'evermap[dev]'")

import httpx
import uvicorn

from evermap.config import Config
from evermap.io import write_native
from evermap.runs.sessions import enter_session
from evermap.server.app import create_app
from evermap.server.database import Database, Role
from evermap.server.sites import SiteStores
from evermap.server.state import Server
from evermap.server.uploads import UploadLimits, check_digest
from evermap.server.worker import Worker
from evermap_studies.sim import BuildingConfig, simulate_building

NAMES = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome")
AXE = Path(__file__).resolve().parents[2] / "out/browser/axe_playwright_python/axe.min.js"
CLASSES = ("cart", "chair", "door", "fixture", "pallet", "shelf")
HOSTILE = "<img src=x onerror=\"document.title='broken'\">"
WAIT_S = 60.0
ON_SCREEN = (
    "(one) => { const p = new DOMPoint(one.x_m, -one.y_m).matrixTransform(document.getElementById('map')"
    ".getScreenCTM()); return [p.x, p.y]; }"
)
"""Where a landmark is in the window."""
PIXEL = (
    "(() => { const [x, y] = placed.map(ON_SCREEN)[0], canvas = document.getElementById('marks');"
    " const { left, top } = canvas.getBoundingClientRect();"
    " return [...canvas.getContext('2d').getImageData(Math.round(x - left), Math.round(y - top), 1, 1).data]; })()"
).replace("ON_SCREEN", ON_SCREEN)
"""What the first landmark is drawn with in its middle: red, green, blue and opacity."""
MANY = (
    "Array.from({ length: 2000 }, (_, k) => ({ landmark: k, label: `chair K${k}`, class: 'abcdefgh'[k % 8],"
    " x_m: k % 50, y_m: Math.floor(k / 50), p_exists: (k % 101) / 100, deleted: false }))"
)
LOOKS = {
    "light": (1280, 900, "light", False),
    "dark": (1280, 900, "dark", False),
    "phone": (375, 760, "light", True),
    "phone-dark": (375, 760, "dark", True),
}
"""Width and height of the window, colours, and whether it is touched."""


@pytest.fixture(scope="session")
def chromium() -> str:
    for name in (os.environ.get("CHROMIUM"), *NAMES):
        if name and (found := shutil.which(name)):
            return found
    pytest.skip("no Chromium: make browser, or CHROMIUM=/path/to/it")


@dataclass
class Browser:
    """A page in a headless Chromium, told what to do by its DevTools protocol over a pair of pipes."""

    process: int
    commands: BinaryIO
    answers: Iterator[dict[str, Any]]
    session: str = ""
    number: int = 0
    faults: list[str] = field(default_factory=list)

    @classmethod
    def opened(cls, program: str, folder: Path) -> Browser:
        ends = [fcntl.fcntl(end, fcntl.F_DUPFD_CLOEXEC, 10) for end in (*os.pipe(), *os.pipe())]
        asked, asks, told, tells = ends
        options = ["--headless", "--no-sandbox", "--remote-debugging-pipe", f"--user-data-dir={folder}"]
        options += ["--disable-gpu", "--disable-dev-shm-usage", "--no-zygote", "--hide-scrollbars"]
        quiet = (os.POSIX_SPAWN_OPEN, 2, str(folder / "chromium.log"), os.O_WRONLY | os.O_CREAT, 0o600)
        pipes = [(os.POSIX_SPAWN_DUP2, asked, 3), (os.POSIX_SPAWN_DUP2, tells, 4), quiet]
        process = os.posix_spawn(program, [program, *options], os.environ, file_actions=pipes, setpgroup=0)
        os.close(asked)
        os.close(tells)
        browser = cls(process, os.fdopen(asks, "wb", buffering=0), messages(os.fdopen(told, "rb", buffering=0)))
        target = browser("Target.createTarget", url="about:blank")["targetId"]
        browser.session = browser("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Inspector"):
            browser(f"{domain}.enable")
        return browser

    def __call__(self, method: str, **params: Any) -> dict[str, Any]:
        self.number += 1
        sent = {"id": self.number, "method": method, "params": params}
        self.commands.write(json.dumps(sent | ({"sessionId": self.session} if self.session else {})).encode() + b"\0")
        for message in self.answers:
            assert message.get("method") != "Inspector.targetCrashed", "the page has crashed"
            if message.get("id") == self.number:
                assert "error" not in message, (method, message)
                answer: dict[str, Any] = message["result"]
                return answer
            if message.get("method") == "Runtime.exceptionThrown" or (
                message.get("method") == "Log.entryAdded"
                and message["params"]["entry"]["level"] == "error"
                and message["params"]["entry"].get("source") != "network"
            ):
                self.faults.append(json.dumps(message["params"])[:500])
        raise AssertionError("the browser has ended")

    def close(self) -> None:
        os.killpg(self.process, signal.SIGKILL)
        os.waitpid(self.process, 0)
        self.commands.close()

    def value(self, expression: str) -> Any:
        told = self("Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in told, told
        return told["result"].get("value")

    def wait(self, expression: str) -> None:
        end = time.monotonic() + WAIT_S
        while not self.value(f"Boolean({expression})"):
            shown = self.value("document.body?.innerText")
            assert time.monotonic() < end, f"{expression} is never true; the page says\n{shown}"
            time.sleep(0.05)

    def painted(self) -> None:
        """Wait for the frames that are asked for: what moves the map is drawn with the next one."""
        self.value("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => done())))")

    def text(self, which: str) -> str:
        return str(self.value(f"document.querySelector({which!r}).textContent"))

    def press(self, key: str, text: str = "") -> None:
        code = {"Tab": 9, "Enter": 13, "ArrowLeft": 37, "ArrowRight": 39}.get(key, 0)
        text = {"Enter": "\r"}.get(key, text)
        told = {"key": key, "code": key, "windowsVirtualKeyCode": code}
        self("Input.dispatchKeyEvent", type="keyDown", **told, **({"text": text} if text else {}))
        self("Input.dispatchKeyEvent", type="keyUp", **told)

    def tab_to(self, wanted: str) -> None:
        """Press the tabulator until something has the focus."""
        for _ in range(200):
            self.press("Tab")
            if self.value(f"document.activeElement.matches({wanted!r})"):
                assert self.value("getComputedStyle(document.activeElement).outlineStyle") != "none"
                return
        raise AssertionError(f"the keyboard does not get to {wanted}")

    def show(self, width: int, height: int, colours: str, touched: bool) -> None:
        self(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=2 if touched else 1,
            mobile=touched,
        )  # fmt: skip
        self("Emulation.setTouchEmulationEnabled", enabled=touched)
        self("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": colours}])

    def picture(self, name: str) -> None:
        folder = os.environ.get("PICTURES")
        if folder:
            data = self("Page.captureScreenshot", captureBeyondViewport=True)["data"]
            Path(folder).mkdir(parents=True, exist_ok=True)
            Path(folder, f"{name}.png").write_bytes(base64.b64decode(data))

    def log_in(self, address: str, token: str) -> None:
        self("Page.navigate", url=address)
        self.wait("document.readyState === 'complete' && document.getElementById('token')")
        self.value("document.getElementById('token').focus()")
        self("Input.insertText", text=token)
        self.press("Enter")
        self.wait("document.getElementById('state').textContent === 'live'")


def messages(pipe: BinaryIO) -> Iterator[dict[str, Any]]:
    waiting = b""
    while part := pipe.read(1 << 16):
        *whole, waiting = (waiting + part).split(b"\0")
        yield from map(json.loads, whole)


@pytest.fixture
def browser(chromium: str, tmp_path: Path) -> Iterator[Browser]:
    opened = Browser.opened(chromium, tmp_path)
    yield opened
    opened.close()
    assert not opened.faults


@dataclass
class Site:
    """A server at an address, with what an operator may do beside the page."""

    server: Server
    tokens: dict[str, str]
    port: int = 0

    def start(self) -> None:
        config = uvicorn.Config(create_app(self.server), port=self.port, log_level="error", timeout_graceful_shutdown=1)
        self.served = uvicorn.Server(config)
        self.thread = threading.Thread(target=self.served.run)
        self.thread.start()
        while not self.served.started:
            time.sleep(0.01)
        self.port = self.served.servers[0].sockets[0].getsockname()[1]
        self.address = f"http://127.0.0.1:{self.port}"

    def stop(self) -> None:
        self.served.should_exit = True
        self.thread.join()

    def __call__(self, method: str, path: str, role: str = "admin", **what: Any) -> httpx.Response:
        headers = {"Authorization": f"Bearer {self.tokens[role]}"}
        answer = httpx.request(method, self.address + path, headers=headers, timeout=60.0, **what)
        assert answer.status_code < 300, answer.text
        return answer


@pytest.fixture(scope="module")
def stored(chromium: str, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, str]]:
    """A store, with its tokens: four sessions of two robots, of which the second is approved; a robot is behind."""
    assert chromium
    folder = tmp_path_factory.mktemp("page")
    database, sites = Database(folder / "maps"), SiteStores(str(folder / "maps"))
    for number, recording in enumerate(simulate_building(BuildingConfig(days=4, patrol_s=60.0), 3).sessions):
        write_native(recording, folder / f"day{number}")
        buffer = io.BytesIO()
        with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
            for path in sorted((folder / f"day{number}").iterdir()):
                archive.write(path, path.name)
        data = buffer.getvalue()
        database.enqueue("ward", check_digest(data, UploadLimits()), data, f"robot-{7 + number % 2}")
    worker = Worker(database, sites, Config())
    while worker.step():
        pass
    database.approve("ward", 2, "admin")
    for robot, version in (("robot-7", "2"), ("robot-8", "1"), ("robot-9", "2")):
        database.hold(robot, [{"mapId": "ward", "mapVersion": version, "mapStatus": "ENABLED"}])
    tokens = {role.name.lower(): database.add_token(role.name.lower(), role) for role in Role}
    database.close()
    return folder / "maps", tokens


@pytest.fixture
def site(stored: tuple[Path, dict[str, str]], tmp_path: Path) -> Iterator[Site]:
    """A server of a copy of that."""
    shutil.copytree(stored[0], tmp_path / "maps")
    database = Database(tmp_path / "maps")
    site = Site(Server(database, SiteStores(str(tmp_path / "maps"))), stored[1])
    site.start()
    yield site
    site.stop()
    database.close()


def test_an_operator_approves_by_keyboard_and_sees_it_live(site: Site, browser: Browser) -> None:
    browser.show(*LOOKS["light"])
    browser.log_in(site.address, site.tokens["approve"])
    assert browser.text("#approved").startswith("Revision 2 is approved (by admin")
    assert browser.value("[...document.querySelectorAll('#candidates button')].map((one) => one.textContent)") == [
        "Revision 4",
        "Revision 3",
    ]
    assert re.search("revision 4, the newest$", browser.text("#when"))
    assert browser.text("#other").endswith("revision 2")
    difference = site("GET", "/maps/ward/diff?a=2&b=4").json()
    assert browser.value("document.querySelectorAll('#changes button').length") == len(difference["changes"])
    assert f"seen for the first time, {len(difference['grown'])}: " in browser.text("#changes li:last-child")
    browser.tab_to("#candidates li:nth-child(2) button")
    browser.press("Enter")
    browser.wait("document.getElementById('when').textContent.endsWith('revision 3')")
    browser.tab_to("#approve-note")
    browser("Input.insertText", text="looked at it")
    browser.press("Enter")
    browser.wait("document.getElementById('said').textContent === 'revision 3 is approved'")
    assert site("GET", "/maps").json()[0]["approved"]["who"] == "approve"
    assert "looked at it" in site("GET", "/audit").json()[0]["what"]
    browser.wait("document.getElementById('approved').textContent.startsWith('Revision 3 is approved')")
    # what others do is seen without a word to the page
    site("POST", "/maps/ward/approve", json={"revision": 4})
    browser.wait("document.getElementById('approved').textContent.startsWith('Revision 4 is approved')")
    held = [{"mapId": "ward", "mapVersion": "4", "mapStatus": "ENABLED"}]
    site("PUT", "/robots/robot-7/maps", json=held)
    browser.wait("document.getElementById('holders').textContent.startsWith('1 of 3 use revision 4')")


def test_an_operator_deletes_with_the_evidence_before_them(site: Site, browser: Browser) -> None:
    browser.show(*LOOKS["light"])
    browser.log_in(site.address, site.tokens["approve"])
    name = site("GET", "/maps/ward/landmarks").json()["landmarks"][0]["label"]
    browser.tab_to("#name")
    browser("Input.insertText", text=name)
    browser.press("Enter")
    browser.wait("document.querySelector('#why svg')")
    browser.wait("document.activeElement.id === 'why-head'")
    assert browser.value("document.querySelectorAll('#why .there, #why .vanished').length") > 1
    browser.tab_to("#word-note")
    browser("Input.insertText", text=HOSTILE)
    browser.tab_to("#deletes")
    browser.press("Enter")
    browser.wait("document.getElementById('deletes').textContent.startsWith('Undelete')")
    assert HOSTILE in site("GET", "/maps/ward/revisions").json()[-1]["note"]
    browser.wait("document.getElementById('when').textContent.endsWith('revision 5, the newest')")
    browser.wait(f"document.getElementById('about').textContent.includes({json.dumps(HOSTILE)})")
    assert browser.value("document.title") == "evermap"
    assert browser.value("document.querySelectorAll('main img').length") == 0
    browser.value("document.getElementById('deletes').click()")
    browser.wait("document.getElementById('deletes').textContent.startsWith('Delete')")
    browser.value("document.querySelector('#candidates li:last-child button').click()")
    browser.wait("document.getElementById('when').textContent.endsWith('revision 3')")
    browser.value("document.getElementById('reverts').click()")
    browser.wait("document.getElementById('said').textContent === 'revision 7 restores revision 3'")


def test_what_an_operator_chooses_is_kept_while_the_page_reads_the_newest(site: Site, browser: Browser) -> None:
    browser.show(*LOOKS["light"])
    browser.log_in(site.address, site.tokens["approve"])
    browser.value(
        "(() => { const plain = fetch, gate = new Promise((go) => { window.release = go; });"
        " window.fetch = async (...what) => { const answer = await plain(...what); await gate; return answer; };"
        " window.refreshed = refresh(true);"
        " document.querySelector('#candidates li:last-child button').click(); })()"
    )
    assert browser.text("#when").endswith("revision 3")
    browser.value("release()")
    browser.value("refreshed.then(() => 0)")
    assert browser.text("#when").endswith("revision 3")
    browser.wait("document.getElementById('time').value === '3'")


def test_who_only_reads_has_no_buttons_that_change(site: Site, browser: Browser) -> None:
    browser.show(*LOOKS["light"])
    browser.log_in(site.address, site.tokens["read"])
    browser.value("document.querySelector('#changes button, #find button').click()")
    browser.value("why(document.querySelector('#names option').value)")
    browser.wait("document.querySelector('#why svg')")
    assert browser.value("[...document.querySelectorAll('.operator')].every((one) => !one.offsetParent)")
    assert browser.value("document.querySelectorAll('#candidates button').length") == 2


def test_the_map_is_moved_and_asked_by_finger_and_by_key(site: Site, browser: Browser) -> None:
    browser.show(*LOOKS["phone"])
    browser.log_in(site.address, site.tokens["read"])
    assert browser.value("[document.documentElement.scrollWidth, innerWidth]") == [375, 375], (
        "the phone scrolls sideways"
    )
    width = "Number(document.getElementById('map').getAttribute('viewBox').split(' ')[2])"
    whole = browser.value(width)
    browser.value("document.getElementById('map').scrollIntoView({ block: 'center' })")
    middle = browser.value(
        "(({ x, y, width, height }) => [x + width / 2, y + height / 2])"
        "(document.getElementById('map').getBoundingClientRect())"
    )

    def touch(kind: str, *fingers: tuple[float, float]) -> None:
        points = [{"x": x, "y": y, "id": number} for number, (x, y) in enumerate(fingers)]
        browser("Input.dispatchTouchEvent", type=kind, touchPoints=points)

    x, y = middle
    touch("touchStart", (x - 30, y), (x + 30, y))
    for step in range(31, 100, 3):
        touch("touchMove", (x - step, y), (x + step, y))
    touch("touchEnd")
    browser.wait(f"{width} < {whole} / 2.5")
    browser.painted()
    mark = browser.value(
        f"(() => {{ const far = ([x, y]) => Math.hypot(x - innerWidth / 2, y - innerHeight / 2);"
        f" return placed.map({ON_SCREEN}).sort((a, b) => far(a) - far(b))[0]; }})()"
    )
    touch("touchStart", (mark[0] + 8, mark[1]))  # a finger is not exact
    touch("touchEnd")
    browser.wait("document.querySelector('#why svg')")
    browser.value("document.getElementById('map').focus()")
    browser.press("0", "0")
    browser.wait(f"Math.abs({width} - {whole}) < 1e-6")
    browser.press("+", "+")
    browser.wait(f"{width} < {whole}")
    left = "Number(document.getElementById('map').getAttribute('viewBox').split(' ')[0])"
    before = browser.value(left)
    browser.press("ArrowRight")
    browser.wait(f"{left} > {before}")


def test_classes_have_shapes_and_colours_that_a_legend_explains(site: Site, browser: Browser) -> None:
    browser.show(*LOOKS["light"])
    browser.log_in(site.address, site.tokens["read"])
    known = site("GET", "/maps/ward/landmarks").json()["landmarks"]
    counts = {name: sum(one["class"] == name and one["p_exists"] >= 0.5 for one in known) for name in CLASSES}
    told = browser.value("[...document.querySelectorAll('#classes span')].map((one) => one.textContent.trim())")
    assert told == [f"{name}, {count}" for name, count in counts.items()]
    looks = browser.value(
        "[...document.querySelectorAll('#classes path')].map((one) =>"
        " [one.getAttribute('d'), getComputedStyle(one).fill])"
    )
    assert len({d for d, _ in looks}) == len(counts)
    # a landmark has on the map the colour that its class has in the legend
    browser.value("draw([placed.find((one) => one.class === 'cart' && one.p_exists > 0.99)], [])")
    browser.painted()
    assert f"rgb({', '.join(map(str, browser.value(PIXEL)[:3]))})" == looks[0][1]
    browser.show(*LOOKS["dark"])
    browser.painted()
    dark = browser.value("getComputedStyle(document.querySelector('#classes path')).fill")
    assert dark != looks[0][1]
    assert f"rgb({', '.join(map(str, browser.value(PIXEL)[:3]))})" == dark
    browser.value("kinds = Array.from({ length: 35 }, (_, k) => `class ${k}`)")
    assert browser.value("new Set(kinds.map((one) => String(looks(one)))).size") == 35
    assert browser.value("SHAPES.length * COLOURS") == 35


def test_what_probably_does_not_exist_is_faint_whatever_is_told_of_it(site: Site, browser: Browser) -> None:
    browser.show(*LOOKS["light"])
    browser.log_in(site.address, site.tokens["read"])

    def drawn(p: float, kind: str) -> tuple[float, bool, float | None, int]:
        """How opaque a landmark is and whether it is filled, the opacity of the frame around it, that of its middle."""
        one = {"landmark": 1, "label": "1", "class": "cart", "x_m": 1.0, "y_m": 2.0, "p_exists": p, "deleted": False}
        told = {"kind": kind, "landmarks": [1], "displacement_m": [None, None], "rotation_rad": 0.0, "probability": 0.9}
        browser.value(f"draw([{json.dumps(one)}], [{json.dumps(told)}])")
        browser.painted()
        opacity, there = browser.value("[marks[0].opacity, marks[0].there]")
        frame = browser.value("document.querySelector('#map .new')?.getAttribute('opacity') ?? null")
        return opacity, there, None if frame is None else float(frame), browser.value(PIXEL)[3]

    assert drawn(0.29, "returned") == (0.29, False, 0.29, 0)
    assert drawn(0.6, "returned") == (0.6, True, 0.6, 153)
    assert drawn(1.0, "appeared") == (1.0, True, 1.0, 255)
    assert drawn(0.9, "vanished")[1:] == (False, None, 0)
    assert drawn(0.001, "moved")[0] == 0.2  # still to be found


def test_an_arrow_ends_beside_the_landmark_that_moved(site: Site, browser: Browser) -> None:
    browser.show(*LOOKS["light"])
    browser.log_in(site.address, site.tokens["read"])
    one = {"landmark": 1, "label": "1", "class": "cart", "x_m": 1.0, "y_m": 2.0, "p_exists": 1.0, "deleted": False}
    other = {**one, "landmark": 2, "label": "2", "x_m": 9.0}
    told = {"kind": "moved", "landmarks": [1], "displacement_m": [3.0, 4.0], "rotation_rad": 0.0, "probability": 0.99}
    browser.value(f"draw([{json.dumps(one)}, {json.dumps(other)}], [{json.dumps(told)}])")
    browser.painted()
    browser.value("paint()")  # at the size that the page has with its legend
    d = browser.value("document.querySelector('#map .moved').getAttribute('d')")
    begin, end = (np.array(part.split(), dtype=float) for part in d.removeprefix("M").split("M")[0].split("L"))
    np.testing.assert_allclose(begin, [-2.0, 2.0])  # y of the screen points down
    away = end - [1.0, -2.0]
    np.testing.assert_allclose(away / np.linalg.norm(away), [-0.6, 0.8], atol=1e-9)
    assert np.linalg.norm(away) == pytest.approx(1.5 * browser.value("RADIUS * metre()"))


def test_landmarks_are_named_under_the_pointer_and_as_their_names_are_typed(site: Site, browser: Browser) -> None:
    browser.show(*LOOKS["light"])
    browser.log_in(site.address, site.tokens["read"])
    names = "[...document.querySelectorAll('#map .name')].map((one) => one.textContent)"
    assert browser.value(names) == []
    x, y = browser.value(f"placed.slice(0, 1).map({ON_SCREEN})[0]")
    browser("Input.dispatchMouseEvent", type="mouseMoved", x=x + 3, y=y)
    browser.painted()
    first = site("GET", "/maps/ward/landmarks").json()["landmarks"][0]
    (label,) = browser.value(names)
    assert label.startswith(f"{first['label']} {first['class']}, ")
    browser("Input.dispatchMouseEvent", type="mouseMoved", x=5, y=5)
    browser.painted()
    assert browser.value(names) == []
    browser.tab_to("#name")
    browser("Input.insertText", text="CHAI")
    browser.painted()
    chairs = browser.value("placed.filter((one) => one.class === 'chair').map((one) => one.label)")
    assert sorted(browser.value(names)) == sorted(chairs)
    assert chairs
    browser.value(f"document.getElementById('name').value = {json.dumps(first['label'])}, search()")
    browser.painted()
    assert first["label"] in browser.value(names)  # by its own name
    browser.value("document.getElementById('name').value = '', draw(placed.slice(0, 5), [])")
    browser.painted()
    assert len(browser.value(names)) == 5  # few enough to name all


def test_thousands_of_landmarks_are_drawn_without_an_element_each(site: Site, browser: Browser) -> None:
    """Frames a second are measured by `benchmarks.page`."""
    browser.show(*LOOKS["light"])
    browser.log_in(site.address, site.tokens["read"])
    browser.value(f"draw({MANY}, [])")
    browser.painted()
    assert browser.value("marks.length") == 2000
    assert browser.value("document.querySelectorAll('#map *').length") < 20
    browser.value("look(0.2)")
    browser.painted()
    assert 20 < browser.value("marks.length") < 200


def test_uploads_are_a_table_with_their_verdicts(site: Site, browser: Browser) -> None:
    browser.show(*LOOKS["phone"])
    browser.log_in(site.address, site.tokens["read"])
    rows = browser.value(
        "[...document.querySelectorAll('#jobs tbody tr')].map((one) => [...one.cells].map((cell) => cell.textContent))"
    )
    jobs = site("GET", "/jobs?site=ward").json()
    assert [(row[0], row[1], row[3], row[4]) for row in rows] == [
        (str(job["id"]), job["robot"], f"✓ entered, revision {job['revision']}", "sound") for job in jobs
    ]
    assert [row[5] for row in rows] == [job["reason"] or "–" for job in jobs]
    refused = {**jobs[0], "state": "aside", "verdict": "lost", "reason": HOSTILE, "revision": 3}
    browser.value(f"tableOfJobs([{json.dumps(refused)}])")
    assert browser.text("#jobs tbody td:nth-child(4)") == "△ set aside"
    assert browser.text("#jobs tbody td:nth-child(6)") == HOSTILE
    # on a phone each row is a card: nothing is cut, and what a number means is said beside it
    for name in ("robots", "jobs"):
        inside = browser.value(
            f"[...document.querySelectorAll('#{name} td')].every((one) => one.scrollWidth <= one.clientWidth"
            " && one.getBoundingClientRect().right <= innerWidth)"
        )
        assert inside, name
        heads = f"[...document.querySelectorAll('#{name} tbody tr:first-child td')].map((one) => one.dataset.head)"
        assert browser.value(heads) == browser.value(
            f"[...document.querySelectorAll('#{name} th')].map((one) => one.textContent)"
        )
        shown = f"getComputedStyle(document.querySelector('#{name} td'), '::before').content"
        assert browser.value(shown) == '"' + browser.value(heads)[0] + '"'
    browser.value("tableOfJobs([])")
    assert browser.text("#uploads") == "None yet."


def test_a_landmark_is_renamed_on_the_page(site: Site, browser: Browser) -> None:
    browser.show(*LOOKS["light"])
    browser.log_in(site.address, site.tokens["approve"])
    label = browser.value("placed[0].label")
    browser.value(f"goTo({json.dumps(label)})")
    browser.wait("document.querySelector('#why svg')")
    browser.tab_to("#word-name")
    browser.value("document.getElementById('word-name').select()")
    browser("Input.insertText", text="chair at the door")
    browser.tab_to("#renames")
    browser.press("Enter")
    browser.wait("document.getElementById('pins').textContent === 'Pin chair at the door'")
    assert "chair at the door" in browser.value(
        "[...document.querySelectorAll('#map .name')].map((one) => one.textContent)"
    )
    assert "renamed landmark" in browser.text("#said")
    assert site("GET", "/maps/ward/landmarks/chair at the door/why").json()["label"] == "chair at the door"


def test_robots_are_on_the_map_where_they_were_last_and_where_they_are_next(site: Site, browser: Browser) -> None:
    browser.show(*LOOKS["light"])
    browser.log_in(site.address, site.tokens["read"])
    told = site("GET", "/maps/ward/poses").json()["robots"]
    assert [(one["robot"], one["revision"]) for one in told] == [("robot-7", 3), ("robot-8", 4)]
    names = "[...document.querySelectorAll('#map .label')].map((one) => one.textContent)"
    assert browser.value(names)[:2] == ["robot-7", "robot-8"]
    assert re.fullmatch(r"\d+ c?m", browser.value(names)[2])  # the scale
    drawn = (
        "[...document.querySelectorAll('#map .robot')].map((one) => one.getBBox())"
        ".map((box) => [box.x + box.width / 2, box.y + box.height / 2])"
    )
    for (x, y), one in zip(browser.value(drawn), told, strict=True):
        assert (x, -y) == pytest.approx((one["x_m"], one["y_m"]), abs=0.3)
    assert f"{told[1]['x_m']:.1f}, {told[1]['y_m']:.1f} m at " in browser.text("#robots")
    pixels = browser.value(
        "(() => { const bar = document.querySelector('#map .scale'); return bar.getBoundingClientRect().width; })()"
    )
    metre = browser.value("metre()")
    label = browser.value(names)[2].split()
    assert pixels * metre == pytest.approx(float(label[0]) / (100.0 if label[1] == "cm" else 1.0), rel=0.1)
    browser.value("point('time', 2), show()")
    browser.wait("document.getElementById('when').textContent.endsWith('revision 2')")
    earlier = site("GET", "/maps/ward/poses?revision=2").json()["robots"]
    browser.wait(f"document.getElementById('robots').textContent.includes('{earlier[1]['x_m']:.1f}, ')")
    assert browser.value(drawn)[1][0] == pytest.approx(earlier[1]["x_m"], abs=0.3)
    browser.value("point('time', 4), show()")
    browser.wait("document.getElementById('when').textContent.includes('revision 4')")
    # another session arrives
    recording = simulate_building(BuildingConfig(days=5, patrol_s=60.0), 3).sessions[4]
    with site.server.sites.store("ward") as store:
        enter_session(store, replace(recording, robot="robot-9")).commit(store)
    browser.wait("[...document.querySelectorAll('#map .label')].some((one) => one.textContent === 'robot-9')")


def test_what_is_late_or_reverted_is_told_in_the_order_of_the_world(site: Site, browser: Browser) -> None:
    sessions = simulate_building(BuildingConfig(days=4, patrol_s=60.0), 3).sessions
    with site.server.sites.store("late", create=True) as store:
        for number in (0, 2, 1):
            enter_session(store, replace(sessions[number], robot="robot-7")).commit(store)
        store.revert(1)
    browser.show(*LOOKS["light"])
    browser.log_in(site.address, site.tokens["approve"])
    browser.value("document.getElementById('site').value = 'late', choose()")
    browser.wait("document.getElementById('when').textContent.endsWith('revision 4, the newest')")
    assert browser.value("order.map((one) => one.revision)") == [1, 4, 2, 3]
    assert browser.value("document.getElementById('time').value") == "2"
    assert browser.text("#other").endswith("revision 3")
    assert browser.text("#changes li") == "revision 4 goes back to revision 1"
    told = browser.value("[...document.querySelectorAll('#candidates li')].map((one) => one.textContent)")
    assert told[0].endswith(": goes back to revision 1")
    assert all("seen for the first time" in line or "moved" in line for line in told[1:])
    browser.value("compare(3, 2)")
    browser.wait("document.getElementById('about').textContent.includes('which came late')")


def test_lifetimes_are_told_by_class_and_by_place(site: Site, browser: Browser) -> None:
    browser.show(*LOOKS["light"])
    browser.log_in(site.address, site.tokens["read"])
    learned = site("GET", "/maps/ward/lifetimes").json()["lifetimes"]
    assert browser.value("document.querySelectorAll('#lives tbody tr').length") == len(learned)
    told = {**learned[0], "half_gone_s": 7200.0, "stays": 5, "stays_that_ended": 2, "class": "cart"}
    browser.value(f"stays([{json.dumps({**told, 'chunk': [1, -2], 'chunk_m': 10.0})}])")
    row = "[...document.querySelectorAll('#lives td')].map((one) => one.textContent)"
    assert browser.value(row) == ["cart", "10 to 20 m, -20 to -10 m", "2.0 h", "5, 2"]
    browser.value("document.querySelector('#lives button').click()")
    drawn = browser.value(
        "['x', 'y', 'width', 'height'].map((one) => document.querySelector('.tile').getAttribute(one))"
    )
    assert drawn == ["10", "10", "10", "10"]  # y of the picture falls


@pytest.mark.parametrize(
    "look", [pytest.param(one, marks=pytest.mark.slow) if one == "phone-dark" else one for one in LOOKS]
)
def test_everybody_can_read_it(site: Site, browser: Browser, look: str) -> None:
    axe = Path(os.environ.get("AXE", AXE))
    browser.show(*LOOKS[look])
    browser.log_in(site.address, site.tokens["approve"])
    browser.value("goTo(document.querySelector('#names option').value)")
    browser.wait("document.querySelector('#why svg')")
    browser.value("scrollTo(0, 0)")
    browser.picture(look)
    if look == "light":
        for kind in ("deuteranopia", "achromatopsia"):
            browser("Emulation.setEmulatedVisionDeficiency", type=kind)
            browser.picture(kind)
        browser("Emulation.setEmulatedVisionDeficiency", type="none")
    if not axe.is_file():
        pytest.skip("no axe-core: make browser, or AXE=/path/to/axe.min.js")
    browser.value(axe.read_text(encoding="utf-8") + ";0")
    found = browser.value(
        "axe.run().then((told) => told.violations.map((one) =>"
        " `${one.impact} ${one.id}: ${one.nodes.map((node) => node.html).join(' ')}`))"
    )
    assert not found


def test_a_server_that_comes_back_is_followed_again(site: Site, browser: Browser) -> None:
    browser.show(*LOOKS["light"])
    browser.log_in(site.address, site.tokens["read"])
    site.stop()
    browser.wait("document.getElementById('state').textContent.startsWith('the server does not answer')")
    site.start()
    site("POST", "/maps/ward/approve", json={"revision": 4})
    browser.wait("document.getElementById('state').textContent === 'live'")
    browser.wait("document.getElementById('approved').textContent.startsWith('Revision 4 is approved')")
