"""A page in headless Chromium, without a network: what a script finds in it, and how it looks."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

CHROMIUM = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), ""
)
needs_chromium = pytest.mark.skipif(not CHROMIUM, reason="no Chromium is installed")

# Before anything of the page runs: collect what goes wrong.
WATCH = """<script>
window.wrong = [];
addEventListener("error", (e) => {
  wrong.push("error: " + (e.message || e.target.outerHTML.slice(0, 200)));
}, true);
addEventListener("unhandledrejection", (e) => wrong.push("rejected: " + e.reason));
addEventListener("securitypolicyviolation", (e) => wrong.push("blocked: " + e.blockedURI));
console.error = console.warn = (...text) => wrong.push("console: " + text.join(" "));
</script>"""

# After the page: run the test's script, and write what it returns into the page.
PROBE = """<script>
addEventListener("load", async () => {
  let found = null;
  try { found = await (() => { %s })(); } catch (e) { wrong.push("probe: " + e); }
  const all = performance.getEntriesByType("resource").map((entry) => entry.name);
  const requests = all.filter((name) => !name.startsWith("data:"));
  const report = document.createElement("pre");
  report.id = "probe-result";
  report.textContent = JSON.stringify({ found, wrong, requests });
  document.documentElement.append(report);
  if (parent !== window) parent.postMessage(report.textContent, "*");
});
</script>"""
NARROWEST = 500  # px, of a window; a narrower page is a frame in it
FRAME = """<!DOCTYPE html><html><head></head><body style="margin: 0">
<iframe src="%s" style="width: %dpx; height: 1000px; border: 0"></iframe>
<script>
addEventListener("message", (e) => {
  const report = document.createElement("pre");
  report.id = "probe-result";
  report.textContent = e.data;
  document.body.append(report);
});
</script></body></html>"""


@dataclass
class Seen:
    """What the script returned, what went wrong in the page, and addresses that were asked for."""

    found: Any
    wrong: list[str]
    requests: list[str]


def _run(page: Path, *options: str) -> str:
    done = subprocess.run(
        [
            CHROMIUM,
            "--headless",
            "--no-sandbox",  # the tests may run as root, on pages that they made
            "--disable-gpu",
            "--enable-unsafe-swiftshader",  # WebGL without a graphics card
            "--disable-dev-shm-usage",
            "--hide-scrollbars",
            "--no-first-run",
            "--disable-background-networking",
            "--proxy-server=http://127.0.0.1:9",  # nobody answers there
            f"--user-data-dir={page.parent / 'profile'}",
            *options,
            page.as_uri(),
        ],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        timeout=120,
        check=True,
    )
    return done.stdout.decode("utf-8")


def look(page: Path, folder: Path, script: str, width: int = 1280) -> Seen:
    """Open a copy of the page in ``folder`` and run the body of a function in it."""
    text = page.read_text(encoding="utf-8")
    assert text.count("<head>") == text.count("</body>") == 1
    text = text.replace("<head>", f"<head>{WATCH}").replace("</body>", f"{PROBE % script}</body>")
    copy = folder / "probed.html"
    copy.write_text(text, encoding="utf-8")
    if width < NARROWEST:
        framed = folder / "framed.html"
        framed.write_text(FRAME % (copy.as_uri(), width), encoding="utf-8")
        copy = framed
    size = f"--window-size={max(width, NARROWEST)},1000"
    dom = _run(copy, size, "--virtual-time-budget=20000", "--dump-dom")
    result = re.search(r'<pre id="probe-result">(.*?)</pre>', dom, flags=re.DOTALL)
    assert result, "the page's script did not end"
    plain = result[1].replace("&lt;", "<").replace("&gt;", ">").replace("&amp;", "&")
    return Seen(**json.loads(plain))


def as_printed(page: Path, file: Path) -> Path:
    """A copy of the page that has on the screen the style that it has on paper."""
    text = page.read_text(encoding="utf-8")
    file.write_text(text.replace("@media print", "@media screen"), encoding="utf-8")
    return file


def screenshot(page: Path, file: Path, width: int, height: int) -> Path:
    """A PNG of the page's first ``height`` px; a window narrower than 500 px is not to be had."""
    _run(page, f"--window-size={width},{height}", f"--screenshot={file}")
    return file
