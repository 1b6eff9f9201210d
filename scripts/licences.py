"""The licences of everything that constraints.txt pins, as installed here, and whether Apache-2.0 software may need it.

    python scripts/licences.py          a Markdown table; exit code 1 if any licence is unknown or does not fit

Nothing of it is redistributed with this package: pip fetches each from its authors. Permissive licences and the MPL,
whose copyleft ends at its own files, fit; the GPL family is named where a wheel carries such a part.
"""

from __future__ import annotations

import re
import sys
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

CONSTRAINTS = Path(__file__).resolve().parents[1] / "constraints.txt"

# words of licences' names, in SPDX's form or people's; a licence fits where each of its parts has one
FIT = {
    "Apache": "Apache-2.0",
    "MIT-CMU": "MIT-CMU",
    "MIT": "MIT",
    "BSD-2": "BSD-2-Clause",
    "0BSD": "0BSD",
    "BSD": "BSD-3-Clause",
    "ISC": "ISC",
    "PSF": "PSF-2.0",
    "Python Software Foundation": "PSF-2.0",
    "MPL": "MPL-2.0",
    "Mozilla": "MPL-2.0",
    "Zlib": "Zlib",
    "CC0": "CC0-1.0",
    "BSL-1.0": "BSL-1.0",
    "LLVM-exception": "LLVM-exception",
    "any-OSI": "any OSI licence",
    "DFSG": "",  # says what others say of it
    "Dual License": "",
}
# what the metadata of these says less clearly than their authors do
SAID = {"tzdata": "Apache-2.0", "scikit-image": "BSD-3-Clause AND MIT AND BSD-2-Clause"}
# wheels that carry parts under another licence than the package's own, as programs or shared libraries of their own
PARTS = {
    "imageio-ffmpeg": "its wheel carries the program FFmpeg (GPL)",
    "opencv-python-headless": "its wheel carries FFmpeg's shared libraries (LGPL-2.1)",
}


class Licence(NamedTuple):
    """Of a package.

    Attributes:
        package: its name.
        version: the installed one; None: it is not installed here.
        said: what its metadata says.
        fits: what that is, in SPDX's words; None: unknown, or it does not fit.
    """

    package: str
    version: str | None
    said: str
    fits: str | None


def pinned() -> list[str]:
    """The names in constraints.txt."""
    lines = (line.split("#")[0].split("==")[0].strip() for line in CONSTRAINTS.read_text().splitlines())
    return [name for name in lines if name]


def licence_of(package: str) -> Licence:
    """What a package's metadata says of its licence: an expression, classifiers, or the first line of a text."""
    try:
        found = metadata.distribution(package)
    except metadata.PackageNotFoundError:
        return Licence(package, None, "", fitting(SAID.get(package, "")) or "not installed here")
    told = found.metadata
    classifiers = [c.rsplit(" :: ", 1)[-1] for c in told.get_all("Classifier") or [] if c.startswith("License ::")]
    line = (told.get("License") or "").strip().split("\n")[0][:60]
    said = SAID.get(package) or told.get("License-Expression") or " AND ".join(classifiers) or line
    return Licence(package, found.version, said, fitting(said))


def fitting(said: str) -> str | None:
    """A licence in SPDX's words, or None where a part of it is none of those that fit."""
    words = []
    for part in re.split(r"\b(?:AND|OR|WITH)\b", said):
        known = [word for word in FIT if word.lower() in part.lower()]
        if not known or re.search(r"\bA?L?GPL\b|GNU", part):
            return None
        words.append(FIT[known[0]])
    return " ".join(dict.fromkeys(word for word in words if word)) or None


def main() -> int:
    """Print the table."""
    licences = [licence_of(name) for name in pinned()]
    print("| package | version | licence |\n|---|---|---|")
    for one in sorted(licences, key=lambda x: x.package.lower()):
        note = f"; {PARTS[one.package]}" if one.package in PARTS else ""
        print(f"| {one.package} | {one.version or '-'} | {one.fits or 'DOES NOT FIT: ' + one.said}{note} |")
    return int(any(one.fits is None for one in licences))


if __name__ == "__main__":
    sys.exit(main())
