# SPDX-License-Identifier: Apache-2.0
"""Draw the pictures of the report in docs/ by a headless Chromium: `python -m evaluation.report_pictures`.

Two simulated rigs of 70 s: one with dry friction, one whose arm is braked while it rises only. Other reports can be
drawn for a look: `python -m evaluation.report_pictures report.html --dark --width 400 --out picture.png`.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from aeropend_ident.diagnosis.diagnosis import Diagnosis, diagnose
from aeropend_ident.diagnosis.results import Results, document
from aeropend_ident.signals.signals import from_arrays
from aeropend_ident.testing.rigs import BENCH, recorded
from aeropend_sim.model.parameters import SAMPLE_PERIOD

ROOT = Path(__file__).resolve().parents[1]
TALL = 12_000
"""[px] Height of the window, more than a page needs (layout)."""

MARGIN = 40
"""[px] Empty rows that stay above and below a picture (layout)."""


def draw(page: str, out: Path, sections: Sequence[str] = (), width: int = 1000, scale: float = 1.4, *,
         dark: bool = False) -> None:
    """Draw a page, or some of its sections, as PNG.

    Args:
        page: HTML.
        out: the picture.
        sections: their ids, "header" for the head; none for the whole page.
        width: [px] of the window.
        scale: pixels of the picture over those of the window.
        dark: whether the browser prefers dark pages.

    Raises:
        SystemExit: there is no Chromium.
    """
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        sys.exit("report_pictures: there is no chromium; apt install chromium")
    if sections:
        others = "".join(f":not([aria-labelledby={name}])" for name in sections)
        head = "" if "header" in sections else "header,"
        page = page.replace("</head>", f"<style>{head} footer, main>section{others} {{ display: none }}</style></head>")
    with tempfile.TemporaryDirectory() as folder:
        html, png = Path(folder) / "page.html", Path(folder) / "page.png"
        html.write_text(page, encoding="utf-8")
        subprocess.run([browser, "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--hide-scrollbars",
                        "--disable-background-networking", f"--user-data-dir={folder}/profile",
                        f"--window-size={width},{round(TALL / scale)}", f"--force-device-scale-factor={scale}",
                        "--virtual-time-budget=3000", *(["--force-dark-mode"] if dark else []),
                        f"--blink-settings=preferredColorScheme={0 if dark else 1}", f"--screenshot={png}",
                        html.as_uri()], check=True, capture_output=True, timeout=120)
        _cropped(png, out)


def _cropped(png: Path, out: Path) -> None:
    """The picture without the empty rest of the window, in few colours."""
    from PIL import Image

    picture = Image.open(png).convert("RGB")
    pixels = np.asarray(picture)
    used = np.flatnonzero((pixels != pixels[-1, 0]).any(axis=(1, 2)))
    top, bottom = max(int(used[0]) - MARGIN, 0), min(int(used[-1]) + MARGIN, picture.height)
    picture.crop((0, top, picture.width, bottom)).quantize(128).save(out, optimize=True)


def _page(diagnosis: Diagnosis) -> str:
    return Results.of(diagnosis, document(diagnosis, ["my_bag"], "bench", 2.5), "diagnose my_bag").page


def pictures(folder: Path) -> None:
    """Draw the pictures of the documents.

    Args:
        folder: for the pictures.
    """
    sys.path.insert(0, str(ROOT / "src" / "aeropend_ident" / "test" / "support"))
    from one_way_arm import recorded_columns  # type: ignore[import-not-found]

    good = _page(diagnose(BENCH, [recorded(11, {"coulomb_friction": {}}, duration=70.0)], 2))
    draw(good, folder / "report.png", ["header", "gap", "where"])
    draw(good, folder / "report-traces.png", ["traces"])
    columns = recorded_columns(1, 70.0, 1.5)
    unknown = _page(diagnose(BENCH, [from_arrays(columns, SAMPLE_PERIOD, BENCH.sensing)], 2))
    draw(unknown, folder / "report-unknown.png", ["unknown"])


def main() -> None:
    """Draw the pictures of the documents, or one report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("report", nargs="?", type=Path, help="a report.html; without it, the pictures of docs/")
    parser.add_argument("--out", type=Path, default=Path("report.png"), help="the picture of a report")
    parser.add_argument("--width", type=int, default=1000, help="[px] of the window")
    parser.add_argument("--dark", action="store_true", help="as a dark page")
    options = parser.parse_args()
    if options.report is None:
        pictures(ROOT / "docs")
    else:
        draw(options.report.read_text(encoding="utf-8"), options.out, width=options.width, scale=1.0, dark=options.dark)


if __name__ == "__main__":
    main()
