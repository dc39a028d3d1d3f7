# SPDX-License-Identifier: Apache-2.0
"""Shows a page in the browser of the person."""

import webbrowser
from pathlib import Path


def show(page: Path) -> str:
    """Open a page in the browser: that of `BROWSER`, else that of the desktop.

    Args:
        page: HTML file.

    Returns:
        One line that says what to do if there is no browser; "" if one was started.
    """
    try:
        if webbrowser.open(page.resolve().as_uri()):
            return ""
    except (webbrowser.Error, OSError):
        pass
    return f"no browser can be started here; open {page} on a machine with one, or set BROWSER"
