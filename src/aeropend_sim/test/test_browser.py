# SPDX-License-Identifier: Apache-2.0
"""A page in the browser: a program of the person's choice, or one line."""

import os
import subprocess
import sys
from pathlib import Path

CODE = "import sys; from pathlib import Path; from aeropend_sim.cli.browser import show; print(show(Path(sys.argv[1])))"


def shown(page: Path, **environment: str) -> str:
    """What is said in a process of its own: the module webbrowser looks for browsers once."""
    kept = {name: x for name, x in os.environ.items() if name not in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER", "PATH")}
    done = subprocess.run([sys.executable, "-c", CODE, str(page)], env={**kept, **environment}, capture_output=True,
                          text=True, check=True)
    return done.stdout.strip()


def test_a_page_is_given_to_the_browser_of_the_person(tmp_path):
    browser = tmp_path / "browser"
    browser.write_text(f'#!/bin/sh\necho "$1" > {tmp_path}/opened\n')
    browser.chmod(0o755)
    page = tmp_path / "a report.html"
    page.touch()
    assert shown(page, BROWSER=f"{browser} %s", PATH=os.environ["PATH"]) == ""
    assert (tmp_path / "opened").read_text().strip() == page.as_uri()


def test_without_a_browser_one_line_says_what_to_do(tmp_path):
    page = tmp_path / "report.html"
    assert shown(page, PATH=str(tmp_path)) == (
        f"no browser can be started here; open {page} on a machine with one, or set BROWSER")
