"""Printing a report to PDF by a browser of this machine."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import tempfile
from pathlib import Path

from fgreg.errors import InputError
from fgreg.output.atomic_file import FileKind

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
PDF_REPORT = FileKind("a report as PDF", (b"%PDF-",), (b"fgreg report",))
PRINT_S = 120.0
_DATE = re.compile(rb"(/(?:CreationDate|ModDate) \(D:)\d{14}")


def find_browser() -> str:
    """The browser that prints.

    Raises:
        InputError: there is none.
    """
    found = next((path for name in BROWSERS if (path := shutil.which(name))), None)
    if found is None:
        raise InputError(
            "--pdf", "no Chromium on this machine", f"one of {', '.join(BROWSERS)}, or to print the HTML file"
        )
    return found


def print_pdf(html: str, browser: str) -> bytes:
    """The pages of a report. Dates of printing are left out, so that two prints of one report are the same.

    Raises:
        InputError: the browser fails, or takes longer than two minutes.
    """
    with tempfile.TemporaryDirectory(prefix="fgreg-report-") as name:
        folder = Path(name)
        page, pdf = folder / "report.html", folder / "report.pdf"
        page.write_text(html, encoding="utf-8")
        command = [browser, "--headless", "--disable-gpu", "--no-first-run", "--disable-extensions"]
        command += [f"--user-data-dir={folder / 'profile'}", "--no-pdf-header-footer", f"--print-to-pdf={pdf}"]
        if hasattr(os, "geteuid") and os.geteuid() == 0:
            command.append("--no-sandbox")  # Chromium does not start as root otherwise
        try:
            subprocess.run([*command, page.as_uri()], capture_output=True, timeout=PRINT_S, check=False)
            data = pdf.read_bytes()
        except (subprocess.TimeoutExpired, OSError):
            raise InputError("--pdf", f"{Path(browser).name}, which wrote nothing", "a Chromium that prints") from None
    return _DATE.sub(rb"\g<1>20000101000000", data)
