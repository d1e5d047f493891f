"""A page in a headless browser: what it measures at a width, and a picture of it."""

from __future__ import annotations

import html
import json
import re
import shutil
import subprocess
import tempfile
from pathlib import Path

BROWSER = next(
    filter(None, map(shutil.which, ("chromium", "google-chrome", "chromium-browser"))), None
)
FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
    "--disable-dev-shm-usage", "--hide-scrollbars", "--virtual-time-budget=10000",
)  # fmt: skip
# A frame as wide as the screen is to be: a browser's own window has a least width.
FRAME = """<!DOCTYPE html><meta charset="utf-8"><body style="margin:0">
<iframe id="page" style="border:0" width="{width}" height="{height}" srcdoc="{page}"></iframe>
<pre id="measured"></pre>
<script>
window.ran = [];
const frame = document.getElementById("page");
frame.addEventListener("load", () => setTimeout(() => {{
  const page = frame.contentDocument, root = page.documentElement, wide = [], narrow = [];
  const fixed = (node) => node.closest(".wide") !== null;
  for (const node of page.body.querySelectorAll("*")) {{
    const box = node.getBoundingClientRect();
    if (box.width && box.right > {width} + 0.5 && !fixed(node))
      wide.push([node.tagName, Math.round(box.right), node.textContent.slice(0, 60)]);
  }}
  const ruler = page.createElement("span");
  ruler.style.whiteSpace = "nowrap";
  ruler.style.position = "absolute";
  page.body.append(ruler);
  for (const cell of page.querySelectorAll("th, td")) {{
    const own = page.defaultView.getComputedStyle(cell);
    for (const kind of ["fontFamily", "fontSize", "fontWeight", "fontVariantNumeric"])
      ruler.style[kind] = own[kind];
    const room = cell.clientWidth - parseFloat(own.paddingLeft) - parseFloat(own.paddingRight);
    const words = cell.textContent.trim();
    ruler.textContent = "0".repeat(8);
    const eight = ruler.getBoundingClientRect().width;
    let enough = 0;
    for (const line of cell.innerText.split("\\n")) {{
      ruler.textContent = line.trim();
      enough = Math.max(enough, Math.min(eight, ruler.getBoundingClientRect().width));
    }}
    if (room + 1 < enough) narrow.push([cell.tagName, Math.round(room), words.slice(0, 60)]);
  }}
  ruler.remove();
  const cut = [...page.querySelectorAll(".wide")].filter(
    (node) => page.defaultView.getComputedStyle(node).overflowX !== "auto").length;
  const measured = {{
    width: root.scrollWidth, height: root.scrollHeight, wide, narrow, cut, ran: window.ran,
    tables: page.querySelectorAll("table").length, images: page.querySelectorAll("img").length,
    broken: [...page.images].filter((image) => !image.naturalWidth).length,
    injected: page.querySelectorAll("script, b, iframe, marquee").length,
  }};
  document.getElementById("measured").textContent = "measured " + JSON.stringify(measured);
}}, 300));
</script>"""


def _run(*arguments):
    assert BROWSER is not None
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        command = [BROWSER, *FLAGS, f"--user-data-dir={profile}", *arguments]
        return subprocess.run(command, capture_output=True, text=True, timeout=90).stdout


def measured(page, width):
    """What a browser makes of a page (text) on a screen so wide (pixels)."""
    source = FRAME.format(width=width, height=900, page=html.escape(page, quote=True))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "frame.html"
        path.write_text(source, encoding="utf-8")
        dom = _run("--dump-dom", path.as_uri())
    found = re.search(r'<pre id="measured">measured (.*?)</pre>', dom, re.S)
    assert found is not None, dom[-500:]
    return json.loads(html.unescape(found[1]))


def photographed(page, width, height, path):
    """Write a picture of the first so many pixels of a page."""
    source = FRAME.format(width=width, height=height, page=html.escape(page, quote=True))
    with tempfile.TemporaryDirectory() as folder:
        frame = Path(folder) / "frame.html"
        frame.write_text(source, encoding="utf-8")
        _run(f"--screenshot={path}", f"--window-size={max(width, 500)},{height}", frame.as_uri())
