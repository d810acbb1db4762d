"""A page in a real headless browser: what loaded, what failed, how wide it is."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path

_NAMES = ("chromium", "chromium-browser", "google-chrome")
BROWSER = next((found for name in _NAMES if (found := shutil.which(name))), None)

# Measures when everything has loaded and leaves the answer in the document.
_PROBE = """<script>
const errors = [];
window.addEventListener("error", e => errors.push(String(e.message || e.target.src)), true);
window.addEventListener("load", () => {
  const out = document.createElement("pre");
  out.id = "probe";
  out.textContent = JSON.stringify({
    errors,
    pictures: [...document.images].map(i => [i.alt, i.naturalWidth, i.complete]),
    width: document.documentElement.scrollWidth,
    window: window.innerWidth,
    cut: [...document.querySelectorAll(".scroll")].filter(d => d.scrollWidth > d.clientWidth)
      .map(d => d.textContent.slice(0, 60)),
    headings: [...document.querySelectorAll("h1, h2")].map(h => h.textContent),
  });
  document.body.append(out);
});
</script>"""


def look_at(page: Path, width_px: int, folder: Path) -> dict[str, object]:
    """Open a copy of the page that measures itself; `width_px` is that of the window."""
    probed = folder / f"probed-{width_px}.html"
    text = page.read_text(encoding="utf-8")
    frame = folder / f"frame-{width_px}.html"
    probed.write_text(text.replace("<head>", f"<head>{_PROBE}", 1), encoding="utf-8")
    # a window is at least 500 px wide; a frame inside may be a phone
    frame.write_text(
        f'<iframe src="{probed.name}" style="width:{width_px}px;height:800px;border:0"></iframe>'
        "<script>addEventListener('load', () => { const f = document.querySelector('iframe');"
        "document.body.append(f.contentDocument.querySelector('#probe').cloneNode(true)); });"
        "</script>"
    )
    found = subprocess.run(
        [
            str(BROWSER),
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--disable-quic",
            "--no-first-run",
            "--disable-background-networking",
            "--disable-component-update",
            "--disable-sync",
            "--allow-file-access-from-files",
            f"--user-data-dir={folder / 'profile'}",
            "--virtual-time-budget=5000",
            "--dump-dom",
            frame.as_uri(),
        ],
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    inner = re.search(r'<pre id="probe">(.*?)</pre>', found.stdout, re.DOTALL)
    assert inner is not None, found.stderr[-2000:]
    unescaped = inner[1].replace("&quot;", '"').replace("&lt;", "<").replace("&gt;", ">")
    answer: dict[str, object] = json.loads(unescaped.replace("&amp;", "&"))
    return answer
