"""The site: `python -m benchmarks.site` (`make docs`), into out/site.

Makes the pictures of the gallery that are missing or older than their code, turns the notebooks with their outputs into
pages, builds the pages with zensical (strict), puts KaTeX beside them, which is fetched from the npm registry and kept in
out/, and the sources that pages link to, and follows every link and anchor of the pages that came out. Then a browser opens the
pages at two widths (benchmarks/browser.py). Without npm the pages take KaTeX from the net when they are read, and without a
browser nobody looks at them; a line says so.
"""

import argparse
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

from benchmarks import browser, gallery

ROOT = Path(__file__).resolve().parent.parent
SITE = ROOT / "out" / "site"
KATEX = "0.16.22"  # as in docs/javascripts/katex.js
_WANTED = ("katex.min.js", "katex.min.css", "contrib/auto-render.min.js")


def katex(folder: Path) -> str:
    """Put the files of KaTeX into a folder; returns why it was not possible, or an empty text."""
    if all((folder / name).exists() for name in _WANTED):
        return ""
    npm = shutil.which("npm")
    if npm is None:
        return "npm is not installed"
    with tempfile.TemporaryDirectory() as scratch:
        ended = subprocess.run(
            [npm, "pack", f"katex@{KATEX}", "--silent"], cwd=scratch, capture_output=True, text=True, check=False
        )
        packed = list(Path(scratch).glob("katex-*.tgz"))
        if ended.returncode or not packed:
            return f"npm could not fetch it: {' '.join(ended.stderr.split())[:200]}"
        with tarfile.open(packed[0]) as archive:
            archive.extractall(scratch, filter="data")
        dist = Path(scratch) / "package" / "dist"
        for name in (*_WANTED, *(f"fonts/{path.name}" for path in (dist / "fonts").glob("*.woff2"))):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(dist / name, folder / name)
    return ""


class _Page(HTMLParser):
    """What a page links to, and the names of its places."""

    def __init__(self, text: str):
        super().__init__()
        self.links: list[str] = []
        self.places: set[str] = {""}
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        """Collect targets and names."""
        given = dict(attrs)
        self.links += [given[key] or "" for key in ("href", "src") if given.get(key)]
        self.places |= {given[key] or "" for key in ("id", "name") if given.get(key)}


def dead_links(site: Path) -> tuple[int, list[str]]:
    """How many links the pages have within the site, and those that lead nowhere."""
    pages = {path: _Page(path.read_text(encoding="utf-8")) for path in site.rglob("*.html")}
    count, dead = 0, []
    for path, page in pages.items():
        for link in page.links:
            parts = urlsplit(link)
            if parts.scheme or parts.netloc or path.name == "404.html":
                continue  # other sites; the page of errors has paths from the root of wherever the site will stand
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            target = target / "index.html" if target.is_dir() else target
            count += 1
            if not target.exists():
                dead.append(f"{path.relative_to(site)}: {link}")
            elif parts.fragment and target in pages and unquote(parts.fragment) not in pages[target].places:
                dead.append(f"{path.relative_to(site)}: {link} (no such place)")
    return count, dead


def notebooks(folder: Path) -> int:
    """Write the notebooks of the repository, with the outputs that they hold, as pages into a folder; their number."""
    # Imported on use: it is an extra of the site.
    import nbformat  # pyright: ignore[reportMissingImports]
    from nbconvert import MarkdownExporter  # pyright: ignore[reportMissingImports]

    folder.mkdir(parents=True, exist_ok=True)
    paths = sorted((ROOT / "notebooks").glob("*.ipynb"))
    for path in paths:
        names = {"unique_key": path.stem, "output_files_dir": f"{path.stem}_files"}
        notebook = nbformat.read(path, as_version=4)
        for output in (output for cell in notebook.cells for output in cell.get("outputs", ())):
            # The page of an xarray dataset needs its own styles and is wider than a telephone; its text is not.
            if "xr-wrap" in output.get("data", {}).get("text/html", ""):
                del output.data["text/html"]
        body, extras = MarkdownExporter().from_notebook_node(notebook, resources=names)
        # Beside the pages, which a notebook finds in a folder beside its own.
        (folder / f"{path.stem}.md").write_text(body.replace("](../docs/", "](../"), encoding="utf-8")
        for name, data in extras["outputs"].items():
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / name).write_bytes(data)
    return len(paths)


# Names of other packages in the prose of a page, whose first mention leads to their documentation.
_PEERS = {
    "diffrax": "https://docs.kidger.site/diffrax/",
    "equinox": "https://docs.kidger.site/equinox/",
    "MuJoCo": "https://mujoco.readthedocs.io/",
    "Pinocchio": "https://github.com/stack-of-tasks/pinocchio",
}
_UNLINKED = {"a", "pre", "h1", "h2", "h3", "h4", "h5", "script", "title", "nav"}


def link_names(site: Path) -> int:
    """Let `jd.NAME` in the prose of the pages lead to its entry of the reference, and packages to their pages; the links."""
    places = {}
    for path in sorted((site / "reference").glob("*.html")):
        for place in _Page(path.read_text(encoding="utf-8")).places:
            if place.startswith("jaxdyn."):
                places[place.removeprefix("jaxdyn.")] = f"reference/{path.name}"
    count = 0
    for path in site.rglob("*.html"):
        up = "../" * len(path.relative_to(site).parent.parts)
        head, mark, body = path.read_text(encoding="utf-8").partition("<article")
        open_tags: list[str] = []
        parts, peers = re.split(r"(<[^>]+>)", body), dict(_PEERS)
        for i, part in enumerate(parts):
            if tag := re.match(r"<(/?)(\w+)", part):
                if tag[2] in _UNLINKED and not tag[1]:
                    open_tags.append(tag[2])
                elif tag[2] in open_tags:
                    open_tags.remove(tag[2])
                continue
            if open_tags or not part.strip():
                continue
            name = re.match(r"jd\.([A-Za-z_][\w.]*)", part)
            if name and parts[i - 1] == "<code>" and name[1] in places:
                parts[i] = f'<a href="{up}{places[name[1]]}#jaxdyn.{name[1]}">{part}</a>'
                count += 1
            elif parts[i - 1] != "<code>" and (found := [peer for peer in peers if re.search(rf"\b{peer}\b", part)]):
                for peer in found:
                    parts[i] = re.sub(rf"\b{peer}\b", f'<a href="{peers.pop(peer)}">{peer}</a>', parts[i], count=1)
                count += len(found)
        path.write_text(head + mark + "".join(parts), encoding="utf-8")
    return count


def bring_sources(site: Path) -> int:
    """Copy the repository's files that pages link to into SITE/source, as plain text, and let the links lead there."""
    brought = set()
    for path in site.rglob("*.html"):
        text, depth = path.read_text(encoding="utf-8"), path.relative_to(site).parent
        changed = text
        for link in set(_Page(text).links):
            parts = urlsplit(link)
            if parts.scheme or parts.netloc or not parts.path or (path.parent / unquote(parts.path)).exists():
                continue
            source = (ROOT / "docs" / depth / unquote(parts.path)).resolve()
            if not source.is_file() or not source.is_relative_to(ROOT):
                continue
            ending = "" if source.suffix in (".ipynb", ".cff") else ".txt"
            place = Path("source", f"{source.relative_to(ROOT)}{ending}")
            (site / place).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source, site / place)
            brought.add(place)
            up = "/".join([".."] * len(depth.parts))
            changed = changed.replace(f'href="{link}"', f'href="{f"{up}/" if up else ""}{place.as_posix()}"')
        if changed != text:
            path.write_text(changed, encoding="utf-8")
    return len(brought)


def main(argv=None) -> int:
    """Build and check; the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--no-gallery", action="store_true", help="make no pictures; their places stay empty")
    options = parser.parse_args(argv)
    if not options.no_gallery:
        gallery.main([])
    print(f"{notebooks(ROOT / 'docs' / 'notebooks')} notebooks are pages")
    strict = [] if options.no_gallery else ["--strict"]
    zensical = Path(sys.executable).with_name("zensical")
    if subprocess.run([zensical, "build", "--clean", "-f", "mkdocs.yml", *strict], cwd=ROOT, check=False).returncode:
        return 1
    kept = ROOT / "out" / "katex"
    if fault := katex(kept):
        print(f"KaTeX is not part of the site ({fault}): its formulas need the net when they are read")
    else:
        shutil.copytree(kept, SITE / "javascripts" / "katex", dirs_exist_ok=True)
    print(f"{link_names(SITE)} names in the prose are links")
    print(f"{bring_sources(SITE)} files of the repository that pages link to are beside them")
    count, dead = dead_links(SITE)
    dead = [link for link in dead if not options.no_gallery or "gallery/" not in link]
    print(f"{len(list(SITE.rglob('*.html')))} pages, {count} links within the site, {len(dead)} of them dead")
    for link in dead:
        print(f"  {link}")
    if options.no_gallery or browser.browser() is None:
        print("no browser has looked at the pages" + ("" if options.no_gallery else ": none is installed"))
        return int(bool(dead))
    faults = browser.faults(SITE)
    print("\n  ".join([f"a browser has looked at the pages at {browser.WIDTHS} pixels: {len(faults)} faults", *faults]))
    return int(bool(dead or faults))


if __name__ == "__main__":
    sys.exit(main())
