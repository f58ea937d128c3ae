"""Look through the built pages: ``python tests/docs/site.py SITE``, exit code 1 with what is wrong.

Every link, picture, script and style leads to a file of the site, from the page for lost visitors (404) as well,
nothing is loaded from another host, and what people look for is found.
"""

from __future__ import annotations

import json
import re
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

LOOKED_FOR = (
    "KITTI",
    "nuScenes",
    "Argoverse",
    "YOLO",
    "ONNX",
    "mmdet3d",
    "OpenPCDet",
    "ultralytics",
    "supervision",
    "rosbag",
    "ROS 2",
    "MCAP",
    "calibration",
    "extrinsics",
    "distortion",
    "fisheye",
    "timestamp",
    "tracking",
    "stereo",
    "segmentation",
    "occlusion",
    "false positive",
    "confidence",
    "threshold",
    "average precision",
    "NDS",
    "parquet",
    "Slurm",
    "COCO",
    "PointPillars",
    "quaternion",
    "yaw",
    "coordinate",
    "frustum",
    "GPU",
    "CUDA",
    "install",
    "overwrite",
    "resume",
    "licence",
)


class Links(HTMLParser):
    """What a page links to, what it loads, and its anchors."""

    def __init__(self) -> None:
        super().__init__()
        self.links: list[str] = []
        self.loaded: list[str] = []
        self.anchors: set[str] = set()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Collect."""
        values = {name: value or "" for name, value in attrs}
        self.anchors |= {values[name] for name in ("id", "name") if name in values}
        if tag == "a" and "href" in values:
            self.links.append(values["href"])
        elif tag in ("img", "script") and "src" in values:
            self.loaded.append(values["src"])
        elif tag == "link" and values.get("rel") in ("stylesheet", "icon") and "href" in values:
            self.loaded.append(values["href"])


def read(path: Path) -> Links:
    """The links of a page."""
    found = Links()
    found.feed(path.read_text(encoding="utf-8"))
    return found


def problems(site: Path) -> list[str]:
    """What is wrong, a sentence each."""
    pages = {path: read(path) for path in sorted(site.rglob("*.html"))}
    wrong = [] if (site / "404.html") in pages else ["there is no 404.html"]
    for path, page in pages.items():
        name = path.relative_to(site)
        wrong += [f"{name} loads {url} from another host" for url in page.loaded if urlsplit(url).netloc]
        for url in {*page.links, *page.loaded}:
            parts = urlsplit(url)
            if parts.scheme or parts.netloc or not (parts.path or parts.fragment):
                continue
            target = (site if parts.path.startswith("/") else path.parent) / unquote(parts.path).lstrip("/")
            target = path if not parts.path else target.resolve()
            target = target / "index.html" if target.is_dir() else target
            if not target.is_file():
                wrong.append(f"{name} leads to {url}, which is not there")
            elif parts.fragment and target in pages and unquote(parts.fragment) not in pages[target].anchors:
                wrong.append(f"{name} leads to {url}: no such place on that page")
    index = json.loads((site / "search" / "search_index.json").read_text(encoding="utf-8"))
    words = " ".join(f"{entry['title']} {entry['text']}" for entry in index["docs"])
    words = re.sub(r"\s+", " ", words).lower()
    return wrong + [f"nobody who looks for {term!r} finds anything" for term in LOOKED_FOR if term.lower() not in words]


if __name__ == "__main__":
    found = problems(Path(sys.argv[1]).resolve())
    print("\n".join(found) or "all links lead somewhere")
    sys.exit(bool(found))
