"""Look at the pages of the site in a browser: `python -m benchmarks.browser [FOLDER]`, by default out/site.

A headless Chromium or Chrome opens every page at the widths of a desktop and of a telephone, and reports formulas that are not
set, pictures that are not shown, and pages that are wider than the window. `make docs` fails where it reports any.
"""

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

WIDTHS = (1280, 400)
_BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
_SECONDS = 600
# Opens the pages one after another in frames of each width, and sends what is wrong to the server.
_SCRIPT = """<!doctype html><body><script>
const pages = PAGES, widths = WIDTHS, faults = [];
const pause = (ms) => new Promise((done) => setTimeout(done, ms));
const short = (text) => text.replace(/\\s+/g, " ").trim().slice(0, 80);
async function look(page, width) {
  const frame = document.createElement("iframe");
  frame.style = `width:${width}px;height:900px;border:0`;
  const loaded = new Promise((done) => (frame.onload = done));
  frame.src = page;
  document.body.append(frame);
  await loaded;
  const inside = frame.contentDocument, formulas = [...inside.querySelectorAll(".arithmatex")];
  const unset = () => formulas.filter((one) => !one.querySelector(".katex"));
  for (let i = 0; i < 200 && unset().length; i++) await pause(50);
  const report = (what) => faults.push(`${page} at ${width} pixels: ${what}`);
  unset().forEach((one) => report(`formula is not set: ${short(one.textContent)}`));
  inside.querySelectorAll(".katex-error").forEach((one) => report(`formula is wrong: ${one.title}`));
  const text = inside.querySelector("article")?.innerText ?? "";
  (text.match(/\\\\(frac|dot|tfrac|begin)\\b.{0,40}/g) ?? []).forEach((one) => report(`source of a formula: ${short(one)}`));
  for (const image of inside.images) {
    image.loading = "eager";
    await image.decode().catch(() => report(`picture is not shown: ${image.getAttribute("src")}`));
  }
  const page_width = inside.documentElement.scrollWidth;
  if (page_width > width) {
    const wide = [...inside.querySelectorAll("article *")].filter((one) => one.getBoundingClientRect().right > width + 1);
    report(`page is ${page_width} pixels wide: ${wide[0]?.tagName} ${short(wide[0]?.textContent ?? "")}`);
  }
  frame.remove();
}
(async () => {
  for (const page of pages) for (const width of widths) await look(page, width);
  await fetch("/faults", { method: "POST", body: JSON.stringify(faults) });
})();
</script>"""


class _Server(SimpleHTTPRequestHandler):
    """Files of the site, the page that opens them, and its report."""

    start, report, done = b"", "", threading.Event()

    def do_GET(self):
        """The page of frames, or a file."""
        if self.path != "/look":
            return super().do_GET()
        self.send_response(200)
        self.send_header("Content-Type", "text/html; charset=utf-8")
        self.end_headers()
        return self.wfile.write(self.start)

    def do_POST(self):
        """Take the report."""
        type(self).report = self.rfile.read(int(self.headers["Content-Length"])).decode()
        self.send_response(204)
        self.end_headers()
        self.done.set()

    def log_message(self, format, *args):
        """Print nothing."""


def browser() -> str | None:
    """Path of a browser that can be run without a screen; None where there is none."""
    return next(filter(None, map(shutil.which, _BROWSERS)), None)


def faults(site: Path, widths=WIDTHS) -> list[str]:
    """What a browser does not show of the pages of a site. **Raises:** RuntimeError where the browser does not report."""
    pages = sorted(f"/{path.relative_to(site)}" for path in site.rglob("*.html") if path.name != "404.html")
    script = _SCRIPT.replace("PAGES", json.dumps(pages)).replace("WIDTHS", json.dumps(widths))
    handler = type("Handler", (_Server,), {"start": script.encode(), "done": threading.Event()})
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(handler, directory=str(site))) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
            options = [
                "--headless",
                "--no-sandbox",
                "--disable-gpu",
                f"--user-data-dir={profile}",
                "--window-size=1400,1000",
            ]
            run = subprocess.Popen(
                [str(browser()), *options, f"http://127.0.0.1:{server.server_port}/look"],
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
            reported = handler.done.wait(_SECONDS)
            run.terminate()
            run.wait()
        server.shutdown()
    if not reported:
        raise RuntimeError(f"{browser()} has not looked at {len(pages)} pages in {_SECONDS} s")
    return json.loads(handler.report)


def main(argv=None) -> int:
    """Look at the pages and print what is wrong; the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", nargs="?", type=Path, default=Path(__file__).resolve().parent.parent / "out" / "site")
    options = parser.parse_args(argv)
    found = faults(options.folder)
    print("\n".join([*found, f"{len(found)} faults of pages in a browser"]))
    return int(bool(found))


if __name__ == "__main__":
    sys.exit(main())
