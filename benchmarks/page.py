"""Frames a second of the server's page, in a real browser, while the map is moved and zoomed.

    python -m benchmarks.page 2000     # landmarks; a tenth of them have moved

A headless Chromium draws by software, on however many cores are free: a page that reaches 30 frames a second here
reaches them on a phone, which draws by hardware. The time of the script alone is said, too.
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path
from typing import Any

from tests.server.test_page import LOOKS, NAMES, Browser

PAGE = Path(__file__).resolve().parents[1] / "src/evermap/server"
DRAW = """(() => {
  let s = 1; const r = () => (s = (s * 16807) % 2147483647) / 2147483647;
  const many = Array.from({ length: COUNT }, (_, k) => ({ landmark: k, label: `chair K${k}`,
    class: ["chair", "cart", "door", "shelf", "pallet", "fixture"][k % 6], x_m: 100 * r(), y_m: 60 * r(), p_exists: r(),
    deleted: false }));
  document.querySelector("main").hidden = false;
  draw(many, many.slice(0, COUNT / 10).map((one) => ({ kind: "moved", landmarks: [one.landmark],
    displacement_m: [1, 1], rotation_rad: 0, probability: 0.9 })));
})()"""
MOVE = """new Promise((done) => {
  const frames = []; let last = performance.now(), n = 0;
  const step = () => {
    frames.push(performance.now() - last); last = performance.now();
    if (n++ < 90) { look(n % 20 < 10 ? 0.97 : 1 / 0.97); requestAnimationFrame(step); return; }
    const begun = performance.now();
    for (let k = 0; k < 20; k++) paint();
    const script = (performance.now() - begun) / 20;
    frames.sort((a, b) => a - b);
    done([frames[45], frames[85], script]);
  };
  requestAnimationFrame(step);
})"""


def measure(count: int, look: str) -> dict[str, Any]:
    """Return milliseconds of a frame, the median and that which one in twenty exceeds, and of the script in one."""
    import shutil

    program = next(found for name in NAMES if (found := shutil.which(name)))
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        page = (PAGE / "page.html").read_text(encoding="utf-8").replace('"/page.', '"page.')
        for name in ("page.css", "page.js"):
            Path(folder, name).write_bytes((PAGE / name).read_bytes())
        Path(folder, "page.html").write_text(page, encoding="utf-8")
        browser = Browser.opened(program, Path(folder))
        try:
            browser.show(*LOOKS[look])
            browser("Page.navigate", url=f"file://{folder}/page.html")
            browser.wait("document.readyState === 'complete' && window.looks !== 0 && typeof draw === 'function'")
            browser.value(DRAW.replace("COUNT", str(count)))
            median, slow, script = browser.value(MOVE)
        finally:
            browser.close()
    return {"landmarks": count, "look": look, "frame_ms": median, "slow_frame_ms": slow, "script_ms": script}


if __name__ == "__main__":
    for look in ("light", "phone-dark"):
        print(json.dumps(measure(int(sys.argv[1]) if sys.argv[1:] else 2000, look)))
